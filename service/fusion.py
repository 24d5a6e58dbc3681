"""Fusion: the boxes that several cameras lifted become one box a vehicle.

Cameras join one after another; each assigns its boxes to the clusters so far in bird's-eye view. A cluster is then one box:
solved from the terms of all its cameras (:mod:`service.joint`) where those are known, else combined by information (inverse
covariance). Two errors that the boxes' covariances do not know are added:

- calibration: every camera's positions are inflated with its distance, independently of the other cameras;
- size: all cameras run the same network on the same kind of car, so its size errors are shared and more cameras do not
  average them away. Size therefore counts as in covariance intersection with equal weights: n cameras know it no better
  than one of them does on average.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from service.association import Index, best_of_duplicates, gated_assignment, mahalanobis_cost
from service.combination import combine, summable
from service.confidence import Confidence, evidence
from service.geometry.boxes import Boxes
from service.geometry.camera import Camera
from service.geometry.transforms import Array, inverse_2x2
from service.joint import shared_covariance
from service.residuals import BoxProblem
from service.solver import SolverSettings
from service.views import whole_in_view

_XY = np.array([0, 1])


@dataclass(frozen=True, eq=False)
class CameraParts:
    """What the cameras contributed to M fused boxes: K boxes, one a camera and vehicle."""

    boxes: Boxes
    """K boxes as lifted; their covariances include what calibration leaves open, and the shared part of the size's error."""
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
    view_range_m: float = 40.0
    """A camera is expected to report vehicles up to this distance, metres."""
    confidence: Confidence = field(default_factory=Confidence)
    """What makes a fused box's score."""
    solver: SolverSettings = field(default_factory=SolverSettings)
    """For vehicles of several cameras."""
    tail_share: float = 1.0
    """For these, how far out (in sigmas) the tails of the cameras' readings begin, over where they do for one camera: a camera
    that contradicts a surer one errs as a whole, and should give way."""


def fuse(
    boxes: Boxes,
    camera_index: Index,
    cameras: Sequence[Camera],
    settings: FusionSettings | None = None,
    terms: BoxProblem | None = None,
) -> FusedBoxes:
    """One box a vehicle from N boxes, ``camera_index`` (N,) saying which of the ``cameras`` lifted each.

    terms: what the N boxes were solved from (:func:`service.lifting.lift_with_terms`). With them a vehicle of several cameras
    is solved anew from everything that these saw; without, their boxes are combined by covariance, which is less exact.
    Scores are the settings' ``confidence``.
    """
    settings = settings or FusionSettings()
    if len(boxes) == 0:
        return FusedBoxes(Boxes.empty(), np.zeros((0, len(cameras)), dtype=bool), np.zeros(0, np.int64))
    keeper = best_of_duplicates(boxes, camera_index, settings.duplicate_iou, settings.duplicate_distance_m)
    kept = np.flatnonzero(keeper == np.arange(len(boxes)))
    owner = camera_index[kept]
    if len(kept) < len(boxes):
        single, terms = boxes.take(kept), None if terms is None else terms.take(kept)
    else:
        single = boxes
    single, terms = _loosened(single, terms, owner, cameras, settings)
    cluster = _cluster(single, owner, terms, settings)
    fused, parts, cluster = _fuse_and_merge(single, owner, terms, cluster, settings)
    members = np.zeros((len(fused), len(cameras)), dtype=bool)
    members[parts.row, parts.camera] = True
    silences = silent_cameras(fused, members, cameras, settings.view_range_m)
    score = settings.confidence.of(evidence(fused, members.sum(1), silences))
    order = np.argsort(-score, kind="stable")
    rank = np.argsort(order)
    position = np.zeros(len(boxes), np.int64)
    position[kept] = np.arange(len(kept))
    ranked = replace(fused, score=score).take(order)
    parts = CameraParts(parts.boxes, rank[parts.row], parts.camera)
    return FusedBoxes(ranked, members[order], rank[cluster][position[keeper]], parts)


def _loosened(
    boxes: Boxes, terms: BoxProblem | None, owner: Index, cameras: Sequence[Camera], settings: FusionSettings
) -> tuple[Boxes, BoxProblem | None]:
    """Boxes and terms that know what calibration leaves open, each camera on its own.

    Boxes are displaced; height rests on the ground. Pictures are shifted, by the same angle and displacement.
    """
    origin = np.array([camera.position_m for camera in cameras])
    offset = boxes.center - origin[owner]
    near, angle = settings.calibration_sigma_m**2, settings.calibration_sigma_rad**2
    squared = offset * offset
    covariance = boxes.covariance.copy()
    covariance[:, _XY, _XY] += (near + angle * (squared[:, 0] + squared[:, 1]))[:, None]
    covariance[:, 2, 2] += near
    if terms is not None and near + angle > 0:
        terms = replace(terms, shift_sigma=np.sqrt(angle + near / squared.sum(1)))
    return replace(boxes, covariance=covariance), terms


def _cluster(boxes: Boxes, owner: Index, terms: BoxProblem | None, settings: FusionSettings) -> Index:
    """Cluster numbers (N,), 0 and up. The camera with most confidence starts; the others join one after another."""
    covariance = boxes.covariance[:, :2, :2]
    if terms is not None:
        covariance = covariance + shared_covariance(boxes.covariance, terms)
    # Relative to one box: world coordinates may be large, and information times them would round.
    xy = boxes.center[:, :2] - boxes.center[0, :2]
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
    boxes: Boxes, owner: Index, terms: BoxProblem | None, cluster: Index, settings: FusionSettings
) -> tuple[Boxes, CameraParts, Index]:
    """Fused boxes, their parts and clusters (N,); clusters that turn out to be one vehicle become one."""
    used = _best_per_camera(boxes, owner, cluster)
    parts = summable(boxes.take(used), cluster[used])
    fused = combine(parts, cluster[used], None if terms is None else terms.take(used), settings.solver, settings.tail_share)
    while True:
        everyone = np.zeros(len(fused), np.int64)
        keeper = best_of_duplicates(fused, everyone, settings.duplicate_iou, settings.duplicate_distance_m)
        if (keeper == np.arange(len(fused))).all():
            return fused, CameraParts(parts, cluster[used], owner[used]), cluster
        survivors, renumbered = np.unique(keeper, return_inverse=True)
        cluster = renumbered[cluster].astype(np.int64)
        used = _best_per_camera(boxes, owner, cluster)
        parts = summable(boxes.take(used), cluster[used])
        # Only what has changed is combined again: that is the dearest step.
        changed = np.flatnonzero(np.bincount(renumbered) > 1)
        mine = np.isin(cluster[used], changed)
        its_terms = None if terms is None else terms.take(used[mine])
        again = combine(
            parts.take(mine), np.searchsorted(changed, cluster[used][mine]), its_terms, settings.solver, settings.tail_share
        )
        row = np.arange(len(survivors))
        row[changed] = len(survivors) + np.arange(len(changed))
        fused = Boxes.concatenate([fused.take(survivors), again]).take(row)


def _best_per_camera(boxes: Boxes, owner: Index, cluster: Index) -> Index:
    """Rows that count, by cluster: of each camera's boxes in a cluster the best-scored one."""
    pair = cluster * (int(owner.max()) + 1) + owner
    order = np.lexsort((-boxes.score, pair))
    first = np.ones(len(order), dtype=bool)
    first[1:] = np.diff(pair[order]) > 0
    best: Index = order[first]
    return best


def silent_cameras(fused: Boxes, members: NDArray[np.bool_], cameras: Sequence[Camera], range_m: float) -> Array:
    """How many cameras (M,) have each box in full view, within range, and do not report it."""
    silent = whole_in_view(fused, cameras, range_m) & ~members
    count: Array = silent.sum(1).astype(np.float64)
    return count
