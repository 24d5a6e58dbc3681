"""Fusion: the boxes that several cameras lifted become one box a vehicle.

Cameras join one after another; each assigns its boxes to the clusters so far in bird's-eye view. A cluster is then combined
by information (inverse covariance), with two corrections for errors that the boxes' covariances do not know:

- calibration: every camera's positions are inflated with its distance, independently of the other cameras;
- size: all cameras run the same network on the same kind of car, so its size errors are shared and more cameras do not
  average them away. Size therefore counts as in covariance intersection with equal weights: n cameras know it no better
  than one of them does on average.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.association import Index, best_of_duplicates, gated_assignment, inverse_2x2, mahalanobis_cost
from service.geometry.boxes import STATE_DIM, Boxes, box_states
from service.geometry.camera import Camera
from service.geometry.transforms import Array, wrap_angle
from service.views import whole_in_view

_DIMS = slice(3, 6)


@dataclass(frozen=True, eq=False)
class CameraParts:
    """What the cameras contributed to M fused boxes: K boxes, one a camera and vehicle."""

    boxes: Boxes
    """K boxes; their covariances include what calibration leaves open, and the shared part of the size's error."""
    row: Index
    """(K,) the fused box that each went into."""
    camera: Index
    """(K,) the camera that each came from."""
    captured_at_ns: Index | None = None
    """(K,) when, nanoseconds since 1970 (UTC); None: all at the set's time."""

    def of_rows(self, keep: NDArray[np.bool_]) -> CameraParts:
        """The parts of the fused boxes that a mask (M,) keeps, under the rows that these then have."""
        mine = keep[self.row]
        times = None if self.captured_at_ns is None else self.captured_at_ns[mine]
        return CameraParts(self.boxes.take(mine), (np.cumsum(keep) - 1)[self.row[mine]], self.camera[mine], times)


@dataclass(frozen=True, eq=False)
class FusedBoxes:
    """M vehicles out of N boxes of C cameras."""

    boxes: Boxes
    """M boxes, best score first."""
    members: NDArray[np.bool_]
    """(M, C) which cameras contributed."""
    source: Index
    """(N,) the row of ``boxes`` that each input box went into (duplicates: the row of the one that was kept)."""
    parts: CameraParts | None = None
    """The cameras' own measurements, for the tracker; None where they are not known."""


@dataclass(frozen=True)
class FusionSettings:
    """Tuning of association and fusion."""

    gate: float = 9.21
    """Largest squared Mahalanobis distance of a match: 99 % of a chi-square with 2 degrees of freedom."""
    max_distance_m: float = 3.0
    """Boxes farther apart are two vehicles, however vague they are: adjacent lanes stay apart."""
    calibration_sigma_m: float = 0.05
    """What surveying and pose leave open near the camera, metres (one sigma)."""
    calibration_sigma_rad: float = 0.003
    """What the camera's orientation leaves open: metres a metre of distance."""
    duplicate_iou: float = 0.1
    """Bird's-eye IoU above which two boxes are one vehicle: solid bodies do not overlap. Cars in adjacent lanes that are both
    0.85 m off towards each other reach it."""
    duplicate_distance_m: float = 1.0
    """Centres nearer than this are one vehicle, metres."""
    silence_ratio: float = 0.8
    """How much likelier a camera is silent about a real vehicle in its full view than about a false alarm of another camera.
    Near 1, for another vehicle may hide it."""
    view_range_m: float = 40.0
    """A camera is expected to report vehicles up to this distance, metres."""


def fuse(boxes: Boxes, camera_index: Index, cameras: Sequence[Camera], settings: FusionSettings | None = None) -> FusedBoxes:
    """One box a vehicle from N boxes, ``camera_index`` (N,) saying which of the ``cameras`` lifted each.

    Score: 1 - prod(1 - s) over the cameras that contributed (false alarms of different cameras rarely coincide); then each
    camera that should see the vehicle and is silent multiplies the odds by ``silence_ratio``.
    """
    settings = settings or FusionSettings()
    if len(boxes) == 0:
        return FusedBoxes(Boxes.empty(), np.zeros((0, len(cameras)), dtype=bool), np.zeros(0, np.int64))
    keeper = best_of_duplicates(boxes, camera_index, settings.duplicate_iou, settings.duplicate_distance_m)
    kept = np.flatnonzero(keeper == np.arange(len(boxes)))
    single, owner = boxes.take(kept), camera_index[kept]
    error = _calibration_covariance(single, owner, cameras, settings)
    cluster = _cluster(single, owner, error, settings)
    fused, parts, cluster = _fuse_and_merge(single, owner, error, cluster, settings)
    members = np.zeros((len(fused), len(cameras)), dtype=bool)
    members[parts.row, parts.camera] = True
    score = _discounted(fused.score, _silences(fused, members, cameras, settings), settings.silence_ratio)
    order = np.argsort(-score, kind="stable")
    rank = np.argsort(order)
    position = np.zeros(len(boxes), np.int64)
    position[kept] = np.arange(len(kept))
    ranked = _with_score(fused, score).take(order)
    parts = CameraParts(parts.boxes, rank[parts.row], parts.camera)
    return FusedBoxes(ranked, members[order], rank[cluster][position[keeper]], parts)


def _calibration_covariance(boxes: Boxes, owner: Index, cameras: Sequence[Camera], settings: FusionSettings) -> Array:
    """Covariances (N, 7, 7) to add to the boxes for what calibration leaves open; height rests on the ground plane."""
    origin = np.stack([camera.position_m[:2] for camera in cameras])
    offset = boxes.center[:, :2] - origin[owner]
    error = np.zeros((len(boxes), STATE_DIM, STATE_DIM))
    error[:, 2, 2] = settings.calibration_sigma_m**2
    error[:, 0, 0] = error[:, 1, 1] = error[:, 2, 2] + settings.calibration_sigma_rad**2 * (offset * offset).sum(1)
    return error


def _cluster(boxes: Boxes, owner: Index, error: Array, settings: FusionSettings) -> Index:
    """Cluster numbers (N,), 0 and up. The camera with most confidence starts; the others join one after another."""
    # Relative to one box: world coordinates may be large, and information times them would round.
    xy = boxes.center[:, :2] - boxes.center[0, :2]
    covariance = boxes.covariance[:, :2, :2] + error[:, :2, :2]
    information = inverse_2x2(covariance)
    weighted = (information @ xy[..., None])[..., 0]
    total = np.bincount(owner, weights=boxes.score)
    cluster = np.full(len(boxes), -1, np.int64)
    count = 0
    sum_information, sum_weighted = np.zeros_like(information), np.zeros_like(weighted)
    for camera in np.argsort(-total, kind="stable"):
        mine = np.flatnonzero(owner == camera)
        if count and len(mine):
            known = inverse_2x2(sum_information[:count])
            known_xy = (known @ sum_weighted[:count, :, None])[..., 0]
            distance_sq, cost, distance_m = mahalanobis_cost(xy[mine], covariance[mine], known_xy, known)
            rows, columns = gated_assignment(distance_sq, cost, distance_m, settings.gate, settings.max_distance_m)
            cluster[mine[rows]] = columns
        new = mine[cluster[mine] < 0]
        cluster[new] = count + np.arange(len(new))
        count += len(new)
        sum_information[cluster[mine]] += information[mine]
        sum_weighted[cluster[mine]] += weighted[mine]
    return cluster


def _fuse_and_merge(
    boxes: Boxes, owner: Index, error: Array, cluster: Index, settings: FusionSettings
) -> tuple[Boxes, CameraParts, Index]:
    """Fused boxes, their parts and clusters (N,); clusters that turn out to be one vehicle become one."""
    used = _best_per_camera(boxes, owner, cluster)
    parts = _parts(boxes.take(used), error[used], cluster[used])
    fused = _combine(parts, cluster[used])
    while True:
        everyone = np.zeros(len(fused), np.int64)
        keeper = best_of_duplicates(fused, everyone, settings.duplicate_iou, settings.duplicate_distance_m)
        survivors, renumbered = np.unique(keeper, return_inverse=True)
        if len(survivors) == len(fused):
            return fused, CameraParts(parts, cluster[used], owner[used]), cluster
        cluster = renumbered[cluster].astype(np.int64)
        used = _best_per_camera(boxes, owner, cluster)
        parts = _parts(boxes.take(used), error[used], cluster[used])
        # Only what has changed is combined again: the inverses are the dearest step.
        changed = np.flatnonzero(np.bincount(renumbered) > 1)
        mine = np.isin(cluster[used], changed)
        again = _combine(parts.take(mine), np.searchsorted(changed, cluster[used][mine]))
        row = np.arange(len(survivors))
        row[changed] = len(survivors) + np.arange(len(changed))
        fused = Boxes.concatenate([fused.take(survivors), again]).take(row)


def _best_per_camera(boxes: Boxes, owner: Index, cluster: Index) -> Index:
    """Rows that count: of each camera's boxes in a cluster the best-scored one."""
    order = np.lexsort((-boxes.score, owner, cluster))
    pair = np.stack([cluster[order], owner[order]], 1)
    first = np.ones(len(order), dtype=bool)
    first[1:] = np.any(pair[1:] != pair[:-1], axis=1)
    return np.sort(order[first])


def _parts(boxes: Boxes, error: Array, cluster: Index) -> Boxes:
    """The boxes with covariances that may be added up as information: size n-fold, as n cameras share its error."""
    covariance = boxes.covariance + error
    others = np.bincount(cluster)[cluster] - 1.0
    covariance[:, _DIMS, _DIMS] += others[:, None, None] * boxes.covariance[:, _DIMS, _DIMS]
    return Boxes(boxes.center, boxes.dims_lwh, boxes.yaw, boxes.score, boxes.cls, covariance, boxes.flip_log_odds)


def _combine(boxes: Boxes, cluster: Index) -> Boxes:
    """One box a cluster (numbered 0 .. M-1 without gaps) by information."""
    rows = int(cluster.max()) + 1
    information = np.linalg.inv(boxes.covariance)
    axis = _circular_axis(boxes.yaw, 1.0 / boxes.covariance[:, 6, 6], cluster, rows)
    aligned = np.cos(boxes.yaw - axis[cluster]) >= 0
    evidence = np.bincount(cluster, np.where(aligned, 1.0, -1.0) * boxes.flip_log_odds, rows)
    state = box_states(boxes)
    state[:, 6] = wrap_angle(boxes.yaw - axis[cluster] + np.where(aligned, 0.0, np.pi))
    # Relative to the cluster's first member: world coordinates may be large, differences within a cluster are not.
    reference = np.zeros((rows, STATE_DIM))
    reference[cluster[::-1], :3] = state[::-1, :3]
    state -= reference[cluster]
    # One product adds up the clusters, several times quicker than ``np.add.at``.
    belongs = (np.arange(rows)[:, None] == cluster).astype(np.float64)
    sum_information = (belongs @ information.reshape(-1, STATE_DIM**2)).reshape(rows, STATE_DIM, STATE_DIM)
    sum_weighted = belongs @ (information @ state[..., None])[..., 0]
    fused_covariance = np.linalg.inv(sum_information)
    fused = (fused_covariance @ sum_weighted[..., None])[..., 0] + reference
    return Boxes(
        center=fused[:, :3],
        dims_lwh=fused[:, _DIMS],
        yaw=wrap_angle(axis + fused[:, 6] + np.where(evidence < 0, np.pi, 0.0)),
        score=1.0 - np.exp(np.bincount(cluster, np.log1p(-np.clip(boxes.score, 0.0, 1.0 - 1e-9)), rows)),
        cls=_voted_class(boxes, cluster, rows),
        covariance=0.5 * (fused_covariance + fused_covariance.transpose(0, 2, 1)),
        flip_log_odds=np.abs(evidence),
    )


def _circular_axis(yaw: Array, weight: Array, cluster: Index, rows: int) -> Array:
    """Weighted mean axes (M,) of headings (N,), which may be flipped by pi: in [-pi/2, pi/2]."""
    sine = np.bincount(cluster, weight * np.sin(2 * yaw), rows)
    cosine = np.bincount(cluster, weight * np.cos(2 * yaw), rows)
    axis: Array = 0.5 * np.arctan2(sine, cosine)
    return axis


def _voted_class(boxes: Boxes, cluster: Index, rows: int) -> Index:
    classes = int(boxes.cls.max()) + 1
    votes = np.bincount(cluster * classes + boxes.cls, boxes.score, rows * classes).reshape(rows, classes)
    winner: Index = votes.argmax(1).astype(np.int64)
    return winner


def _silences(fused: Boxes, members: NDArray[np.bool_], cameras: Sequence[Camera], settings: FusionSettings) -> Array:
    """Cameras (M,) that have each box in full view, within range, and do not report it."""
    silent = whole_in_view(fused, cameras, settings.view_range_m) & ~members
    count: Array = silent.sum(1).astype(np.float64)
    return count


def _discounted(score: Array, silences: Array, ratio: float) -> Array:
    """Scores (M,) after ``silences`` (M,) likelihood ratios of ``ratio`` each: odds times ratio^silences."""
    kept = score * ratio**silences
    discounted: Array = kept / (kept + 1.0 - score)
    return discounted


def _with_score(boxes: Boxes, score: Array) -> Boxes:
    return Boxes(boxes.center, boxes.dims_lwh, boxes.yaw, score, boxes.cls, boxes.covariance, boxes.flip_log_odds)
