"""Lifting and two-camera fusion on a real intersection: true boxes projected into both cameras, with noise.

The road there is not flat, so a plane and a height grid stand side by side as its ground, both fitted to the bottoms of
other scans' vehicles than those that are scored. Sizes are the means of those scans' cars and vans.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.geometry_intersection import CLASSES, LIDARS, Intersection, Scan, load_intersection, sequences_of, wholly_inside
from benchmarks.geometry_scores import Row, Sigmas, lift_with, measurements_of, score
from service.fusion import FusionSettings, fuse
from service.geometry.boxes import Boxes
from service.geometry.ground import Ground, fit_grid, fit_plane
from service.geometry.transforms import Array
from service.lifting import LiftSettings
from service.measurements import Measurements
from service.residuals import BoxProblem

PIXEL_SIGMA = 2.0
YAW_SIGMA_RAD = float(np.deg2rad(4.0))
MARGIN_PX = 6.0
"""A vehicle is wholly inside an image when it keeps this far from the border: three sigmas of the noise."""
CELL_M, BEND = 4.0, 100.0
CLIP_SIGMAS = 3.0
_MAD_TO_SIGMA = 1.4826
FUSION = FusionSettings(calibration_sigma_m=0.02, calibration_sigma_rad=0.0, max_distance_m=6.0)
"""The boxes were projected with the very calibration that lifts them; vehicles that both cameras see whole are 45 to 95 m away,
where two boxes of one vehicle often lie more than the usual 3 m apart."""

VARIANTS = (("paper", "none"), ("map", "plane"), ("map", "grid"))
"""Ways of lifting, each with the ground it is given."""


@dataclass(frozen=True, eq=False)
class Views:
    """All views of vehicles that lie wholly in an image: V views, by scan, then camera."""

    scan: NDArray[np.int64]
    """(V,)."""
    vehicle: NDArray[np.int64]
    """(V,) row of the vehicle in its scan."""
    camera: NDArray[np.int64]
    """(V,)."""
    truth: Array
    """(V, 7)."""
    measurements: Measurements

    def seen_by_both(self) -> NDArray[np.bool_]:
        """(V,) whether the other camera has the vehicle too."""
        _, inverse, count = np.unique(self.scan * 1000 + self.vehicle, return_inverse=True, return_counts=True)
        both: NDArray[np.bool_] = count[inverse] > 1
        return both


def views_of(place: Intersection, scans: list[Scan], dims: tuple[Array, Array], rng: np.random.Generator) -> Views:
    """What the cameras measure in the scans. dims: means and deviations of the sizes (2, 3) of ``CLASSES``."""
    parts = []
    for number, scan in enumerate(scans):
        for index, camera in enumerate(place.cameras):
            xyxy, inside = wholly_inside(camera, scan.truth, MARGIN_PX)
            rows = np.flatnonzero(inside)
            where = np.full((3, len(rows)), [[number], [0], [index]])
            where[1] = rows
            parts.append((where.T, scan.truth[rows], xyxy[rows], scan.cls[rows]))
    where, truth, xyxy, cls = (np.concatenate(part) for part in zip(*parts, strict=True))
    noise = rng.normal(size=(len(truth), 5))
    measured = measurements_of(
        where[:, 2],
        xyxy + PIXEL_SIGMA * noise[:, :4],
        dims[0][cls],
        truth[:, 6] + YAW_SIGMA_RAD * noise[:, 4],
        Sigmas(np.array(PIXEL_SIGMA), dims[1][cls], YAW_SIGMA_RAD),
    )
    return Views(where[:, 0], where[:, 1], where[:, 2], truth, measured)


def class_dims(scans: list[Scan]) -> tuple[Array, Array]:
    """Means and standard deviations (2, 3) of length, width and height by class."""
    truth, cls = np.concatenate([s.truth for s in scans]), np.concatenate([s.cls for s in scans])
    groups = [truth[cls == number, 3:6] for number in range(len(CLASSES))]
    return np.stack([g.mean(0) for g in groups]), np.stack([g.std(0) for g in groups])


def bottoms_of(scans: list[Scan]) -> Array:
    """Bottom centres (N, 3) of all vehicles."""
    truth = np.concatenate([s.truth for s in scans])
    return truth[:, :3] - 0.5 * truth[:, 5:6] * [0.0, 0.0, 1.0]


def ground_settings(ground: Ground, bottoms: Array) -> LiftSettings:
    """The lift told how well a ground fits the bottoms (N, 3) that it was fitted to: rms, the tails clipped."""
    miss = np.abs(bottoms[:, 2] - ground.height_at(bottoms))
    clip = CLIP_SIGMAS * _MAD_TO_SIGMA * float(np.median(miss))
    return LiftSettings(ground_sigma_m=float(np.sqrt(np.mean(np.minimum(miss, clip) ** 2))), ground_sigma_per_m=0.0)


def halves(place: Intersection) -> dict[str, list[tuple[list[Scan], list[Scan]]]]:
    """Ways to part the scans in two, each as (fitted to, scored on), both ways round.

    Alternate scans of one sequence hold the same vehicles a tenth of a second apart; whole sequences (other days) do not.
    """
    sequences = sequences_of(place.scans)
    alternate = (place.scans[::2], place.scans[1::2])
    days = ([s for q in sequences[::2] for s in q], [s for q in sequences[1::2] for s in q])
    return {"alternate scans": [alternate, alternate[::-1]], "whole sequences": [days, days[::-1]]}


def run_roadside(seed: int = 0, every: int = 1) -> dict[str, dict[str, Row]]:
    """Tables by way of parting the scans; rows by method, ground and camera. Every n-th scan is scored."""
    places = [load_intersection(lidar) for lidar in LIDARS]
    tables: dict[str, dict[str, Row]] = {}
    for name in halves(places[0]):
        folds = [(place, (a, b[::every])) for place in places for a, b in halves(place)[name]]
        tables[f"ground from the other half ({name})"] = _table(folds, seed)
    return tables


def _table(folds: list[tuple[Intersection, tuple[list[Scan], list[Scan]]]], seed: int) -> dict[str, Row]:
    rows: dict[str, Row] = {}
    for method, ground_name in VARIANTS:
        rng = np.random.default_rng(seed)
        lifted, fused = [], []
        for place, (fitted, scored) in folds:
            bottoms = bottoms_of(fitted)
            ground: Ground = fit_grid(bottoms, CELL_M, BEND) if ground_name == "grid" else fit_plane(bottoms)
            views = views_of(place, scored, class_dims(fitted), rng)
            settings = ground_settings(ground, bottoms)
            boxes, terms = lift_with(method, place.cameras, ground, views.measurements, settings)
            lifted.append((boxes, views))
            fused.append(_fused(place, boxes, terms, views))
        label = f"{method}, ground: {ground_name}"
        for index, camera in enumerate(folds[0][0].cameras):
            single = [(boxes.take(v.camera == index), v.truth[v.camera == index]) for boxes, v in lifted]
            rows[f"{label}, {camera.id}"] = _joined(single)
        rows[f"{label}, fused"] = {**_joined([(f.boxes, f.truth) for f in fused]), **_association(fused)}
    return rows


def _joined(parts: list[tuple[Boxes, Array]]) -> Row:
    return score(Boxes.concatenate([boxes for boxes, _ in parts]), np.concatenate([truth for _, truth in parts]))


@dataclass(frozen=True, eq=False)
class Fused:
    """Fused boxes of the vehicles wholly inside both cameras, their truth, and how the cameras' boxes were paired."""

    boxes: Boxes
    truth: Array
    joined: int
    """Pairs of boxes of two cameras that were fused."""
    rightly: int
    """Those that are of one vehicle."""


def _fused(place: Intersection, boxes: Boxes, terms: BoxProblem | None, views: Views) -> Fused:
    """Every scan fused by itself, with all boxes of it; a vehicle's fused box is the one its first camera went into."""
    parts, joined, rightly = [], 0, 0
    both = views.seen_by_both()
    for number in np.unique(views.scan):
        rows = np.flatnonzero(views.scan == number)
        mine = None if terms is None else terms.take(rows)
        result = fuse(boxes.take(rows), views.camera[rows], place.cameras, FUSION, mine)
        first, second = rows[views.camera[rows] == 0], rows[views.camera[rows] == 1]
        into = np.zeros(len(boxes), dtype=np.int64)
        into[rows] = result.source
        together = into[first][:, None] == into[second]
        joined += int(together.sum())
        rightly += int((together & (views.vehicle[first][:, None] == views.vehicle[second])).sum())
        seen = first[both[first]]
        parts.append((result.boxes.take(into[seen]), views.truth[seen]))
    return Fused(Boxes.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts]), joined, rightly)


def _association(parts: list[Fused]) -> Row:
    joined, rightly = sum(p.joined for p in parts), sum(p.rightly for p in parts)
    return {
        "association_precision": round(rightly / max(joined, 1), 4),
        "association_recall": round(rightly / max(sum(len(p.boxes) for p in parts), 1), 4),
    }
