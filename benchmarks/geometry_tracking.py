"""Tracking on the recorded intersection: its true boxes, noised camera by camera, fused and tracked at 10 Hz.

The noise is that of roadside lifting: 0.3 m + 0.6 % of the distance along the ray, 0.1 m across it, 5 cm in height, sizes by
(0.20, 0.06, 0.06) m, yaw by 4 degrees and turned about in 3 %; each camera misses 10 % of the vehicles that it has wholly in
view, and 5 % of its boxes stand on nothing. Labels carry no identities, so true boxes are linked from scan to scan first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from benchmarks.geometry_intersection import Scan, load_intersection, sequences_of
from benchmarks.scored_sets import Found, Wanted
from benchmarks.tracking_scores import MIN_IOU, count_scene, moments, no_counts
from service.fusion import fuse
from service.geometry.boxes import Boxes, box_states
from service.geometry.camera import Camera
from service.geometry.iou import iou_3d
from service.geometry.transforms import Array, wrap_angle
from service.tracking import TrackedBoxes, Tracker
from service.views import whole_in_view

MISS_SHARE, FALSE_SHARE, FLIP_SHARE = 0.10, 0.05, 0.03
CONFIRMED = 0.99
"""Probability of existence from which a track counts as confirmed."""
STOPPED_MPS = 0.5
AWAY_S, AWAY_FOR_S = 10.0, 3.0
"""When in each sequence the second camera leaves, and for how long, in the run in which it does."""
RANGE_M = 120.0
_LINK_M, _LINK_S, _SPEED_SPAN_S = 3.0, 0.6, 0.35
_SIGMA_REST = np.array([0.05, 0.2, 0.06, 0.06, np.deg2rad(4.0)])


@dataclass(frozen=True, eq=False)
class Moment:
    """One scan's vehicles with identities and true speeds, and what was tracked of them."""

    wanted: Wanted
    speed: Array
    """(N,) m/s along the ground; NaN where neighbours in time are lacking."""
    tracked: TrackedBoxes
    in_view: NDArray[np.bool_]
    """(M,) whether a present camera has the tracked box wholly in view."""


def run_tracking(seed: int = 0, sequences: int | None = None) -> dict[str, dict[str, dict[str, float | int | None]]]:
    """Scores of the southern LiDAR's sequences (all, or the first few), with both cameras and with one that is away a while."""
    site = load_intersection("south")
    runs = {"both cameras": False, "one away for 3 s": True}
    scenes = sequences_of(site.scans)[:sequences]
    result = {}
    for name, away in runs.items():
        rng = np.random.default_rng(seed)
        tracked = [_run_scene(scene, site.cameras, rng, away=away) for scene in scenes]
        result[name] = _scores(tracked, 0.0) | _errors(tracked)
        result[f"{name}, confirmed"] = _scores(tracked, CONFIRMED)
    return {"tracking": result}


def linked_ids(scans: Sequence[Scan]) -> list[NDArray[np.int64]]:
    """Identities (N,) of each scan's true boxes: nearest to where its last two places lead, and of the same size."""
    ids: list[NDArray[np.int64]] = []
    number, last, velocity, seen_s = (np.zeros(0, np.int64), np.zeros((0, 7)), np.zeros((0, 2)), np.zeros(0))
    count = 0
    for scan in scans:
        elapsed = scan.time_s - seen_s
        expected = last[:, :2] + velocity * elapsed[:, None]
        distance = np.linalg.norm(scan.truth[:, None, :2] - expected[None], axis=-1)
        cost = distance + 5.0 * np.abs(scan.truth[:, None, 3:6] - last[None, :, 3:6]).sum(-1)
        rows, columns = linear_sum_assignment(np.minimum(cost, 2.0 * _LINK_M))
        good = cost[rows, columns] < _LINK_M
        rows, columns = rows[good], columns[good]
        mine = np.full(len(scan.truth), -1, np.int64)
        mine[rows] = number[columns]
        fresh = mine < 0
        mine[fresh] = count + np.arange(fresh.sum())
        count += int(fresh.sum())
        now_velocity = np.zeros((len(mine), 2))
        now_velocity[rows] = (scan.truth[rows, :2] - last[columns, :2]) / np.maximum(elapsed[columns], 1e-3)[:, None]
        kept = np.flatnonzero(~np.isin(number, mine) & (elapsed < _LINK_S))
        number, last = np.concatenate([mine, number[kept]]), np.concatenate([scan.truth, last[kept]])
        velocity = np.concatenate([now_velocity, velocity[kept]])
        seen_s = np.concatenate([np.full(len(mine), scan.time_s), seen_s[kept]])
        ids.append(mine)
    return ids


def true_speeds(scans: Sequence[Scan], ids: Sequence[NDArray[np.int64]]) -> list[Array]:
    """Speeds (N,) by the way between the scans about ``_SPEED_SPAN_S`` before and after, m/s; NaN without such scans."""
    times = np.array([scan.time_s for scan in scans])
    speeds = []
    for row, scan in enumerate(scans):
        a = int(np.searchsorted(times, scan.time_s - _SPEED_SPAN_S))
        b = int(np.searchsorted(times, scan.time_s + _SPEED_SPAN_S, side="right")) - 1
        before, after = (dict(zip(ids[k].tolist(), scans[k].truth[:, :2], strict=True)) for k in (a, b))
        span = max(times[b] - times[a], 1e-3)
        whole = a < row < b
        speed = [
            float(np.linalg.norm(after[i] - before[i])) / span if whole and i in before and i in after else np.nan
            for i in ids[row].tolist()
        ]
        speeds.append(np.array(speed))
    return speeds


def measured_boxes(truth: Array, camera: Camera, rng: np.random.Generator) -> Boxes:
    """What a camera that has vehicles (N, 7) wholly in view says of them, misses, false boxes and covariances included."""
    false = truth[rng.random(len(truth)) < FALSE_SHARE / (1.0 - FALSE_SHARE)].copy()
    false[:, :2] += rng.uniform(5.0, 15.0, (len(false), 1)) * _directions(rng.uniform(-np.pi, np.pi, len(false)))
    states = np.concatenate([truth[rng.random(len(truth)) >= MISS_SHARE], false])
    count = len(states)
    ray = states[:, :2] - camera.position_m[:2]
    distance = np.linalg.norm(ray, axis=1)
    ray /= distance[:, None]
    across = np.stack([-ray[:, 1], ray[:, 0]], 1)
    sigma = np.stack([0.3 + 0.006 * distance, np.full(count, 0.1)], 1)
    axes = np.stack([ray, across], 2)
    covariance = np.zeros((count, 7, 7))
    covariance[:, :2, :2] = axes @ (sigma[:, :, None] ** 2 * axes.transpose(0, 2, 1))
    rest = np.arange(2, 7)
    covariance[:, rest, rest] = _SIGMA_REST**2
    noisy = states.copy()
    noisy[:, :2] += (axes @ (sigma * rng.normal(size=(count, 2)))[..., None])[..., 0]
    noisy[:, 2:] += _SIGMA_REST * rng.normal(size=(count, 5))
    flipped = rng.random(count) < FLIP_SHARE
    return Boxes(
        center=noisy[:, :3],
        dims_lwh=np.maximum(noisy[:, 3:6], 0.5),
        yaw=wrap_angle(noisy[:, 6] + np.pi * flipped),
        score=np.concatenate([rng.uniform(0.5, 0.95, count - len(false)), rng.uniform(0.3, 0.7, len(false))]),
        cls=np.zeros(count, np.int64),
        covariance=covariance,
        flip_log_odds=np.where(flipped, 0.5, 2.2),
    )


def _directions(angle: Array) -> Array:
    return np.stack([np.cos(angle), np.sin(angle)], 1)


def _run_scene(scans: Sequence[Scan], cameras: list[Camera], rng: np.random.Generator, *, away: bool) -> list[Moment]:
    ids = linked_ids(scans)
    speeds = true_speeds(scans, ids)
    tracker, result = Tracker(), []
    for scan, mine, speed in zip(scans, ids, speeds, strict=True):
        gone = away and 0.0 <= scan.time_s - scans[0].time_s - AWAY_S < AWAY_FOR_S
        present = cameras[:1] if gone else cameras
        views = whole_in_view(_as_boxes(scan.truth), present, RANGE_M)
        parts = [measured_boxes(scan.truth[views[:, row]], camera, rng) for row, camera in enumerate(present)]
        owner = np.repeat(np.arange(len(present)), [len(part) for part in parts])
        fused = fuse(Boxes.concatenate(parts), owner, present)
        tracked = tracker.update(fused, round(scan.time_s * 1e9))
        nearest = np.linalg.norm(scan.truth[:, None, :3] - np.stack([c.position_m for c in present]), axis=-1)
        distance = np.where(views, nearest, np.inf).min(1)
        in_view = whole_in_view(tracked.boxes, present, RANGE_M).any(1)
        result.append(Moment(Wanted(scan.truth, views.any(1), distance, mine), speed, tracked, in_view))
    return result


def _as_boxes(states: Array) -> Boxes:
    count = len(states)
    zero = np.zeros(count)
    return Boxes(states[:, :3], states[:, 3:6], states[:, 6], zero, np.zeros(count, np.int64), np.zeros((count, 7, 7)), zero)


def _scores(scenes: Sequence[Sequence[Moment]], least_existence: float) -> dict[str, float | int | None]:
    """MOTA, IDF1 and the like over tracks that exist with at least a given probability."""
    counts = no_counts()
    for scene in scenes:
        found = []
        for moment in scene:
            tracked, existence = moment.tracked, moment.tracked.existence
            sure = np.flatnonzero(existence >= least_existence) if existence is not None else np.arange(len(tracked.boxes))
            everything = Found(box_states(tracked.boxes), tracked.boxes.score, moment.in_view, tuple(tracked.track_id))
            found.append(everything.take(sure).forgiven(moment.wanted))
        counts += count_scene(moments(found, [moment.wanted for moment in scene]))
    shares = {
        "missed_percent": round(100.0 * counts.missed / max(counts.vehicles, 1), 2),
        "false_percent": round(100.0 * counts.false / max(counts.boxes, 1), 2),
    }
    return {"vehicles": counts.vehicles, **counts.summary(), **shares}


def _errors(scenes: Sequence[Sequence[Moment]]) -> dict[str, float | int | None]:
    """Errors of speed and of the heading of stopped vehicles, over matches of IoU 0.5 and above."""
    speed, sigmas, heading = [], [], []
    for moment in (moment for scene in scenes for moment in scene):
        overlap = iou_3d(moment.wanted.states, box_states(moment.tracked.boxes))
        rows, columns = linear_sum_assignment(-overlap)
        good = overlap[rows, columns] >= MIN_IOU
        rows, columns = rows[good], columns[good]
        error = np.linalg.norm(moment.tracked.velocity[columns], axis=1) - moment.speed[rows]
        known = np.isfinite(error)
        speed.append(error[known])
        if moment.tracked.speed_sigma is not None:
            sigmas.append(error[known] / moment.tracked.speed_sigma[columns][known])
        stopped = moment.speed[rows] < STOPPED_MPS
        turn = moment.tracked.boxes.yaw[columns[stopped]] - moment.wanted.states[rows[stopped], 6]
        heading.append(np.abs(wrap_angle(turn)))
    speeds, headings = np.abs(np.concatenate(speed)), np.rad2deg(np.concatenate(heading))
    upright = headings[headings < 90.0]
    return {
        "speed_error_median_mps": round(float(np.median(speeds)), 3),
        "speed_error_p90_mps": round(float(np.percentile(speeds, 90)), 3),
        "speed_within_2_sigma_percent": round(100.0 * float(np.mean(np.abs(np.concatenate(sigmas)) < 2.0)), 1),
        "stopped_boxes": len(headings),
        "stopped_heading_median_deg": round(float(np.median(upright)), 2),
        "stopped_heading_p90_deg": round(float(np.percentile(upright, 90)), 2),
        "stopped_heading_opposite_percent": round(100.0 * float(np.mean(headings >= 90.0)), 2),
    }
