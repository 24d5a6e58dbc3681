"""Weighted box fusion as in the source paper (eq. 8-13), kept beside the default for comparison.

Boxes go by falling score. Each joins the fused box that it overlaps most, if by an IoU strictly above the threshold, or
starts one; the fused box is the score-weighted mean of its members and moves with every one that joins. Three readings of
the paper are settled (docs/fusion.md): the threshold is 0.7 ("1.7" is a misprint); N counts the cameras that have the place in
view, for with all cameras counted eq. 12 and 13 would punish what three of four cannot see; and centre, size and yaw are
averaged, never corners, which a heading off by pi would collapse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.association import Index
from service.fusion import FusedBoxes
from service.geometry.boxes import STATE_DIM, Boxes, box_states
from service.geometry.camera import Camera
from service.geometry.iou import iou_3d
from service.geometry.transforms import Array, wrap_angle
from service.views import whole_in_view

_MIN_WEIGHT = 1e-9


@dataclass(frozen=True)
class PaperFusionSettings:
    """Tuning of the paper's fusion."""

    iou: float = 0.7
    """Volume IoU with the fused box that a box must exceed to join it."""
    overflow: bool = False
    """False: scores scale by min(T, N) / N (eq. 12); True: by T / N (eq. 13), cut at 1."""
    view_range_m: float = 60.0
    """A camera's view reaches this far, metres."""


@dataclass(frozen=True, eq=False)
class WeightedClusters:
    """K clusters of N boxes, in the order of their first members."""

    cluster: Index
    """(N,) the cluster of each box."""
    state: Array
    """(K, 7) fused x y z l w h yaw."""
    mean_score: Array
    """(K,) mean score of the members."""
    count: Index
    """(K,) members, the T of eq. 12 and 13."""


def fuse_paper(
    boxes: Boxes, camera_index: Index, cameras: Sequence[Camera], settings: PaperFusionSettings | None = None
) -> FusedBoxes:
    """One box a vehicle from N boxes, ``camera_index`` (N,) saying which of the ``cameras`` lifted each.

    The covariance of a fused box is the score-weighted mean of its members': it holds whatever their errors share.
    """
    settings = settings or PaperFusionSettings()
    if len(boxes) == 0:
        return FusedBoxes(Boxes.empty(), np.zeros((0, len(cameras)), dtype=bool), np.zeros(0, np.int64))
    clusters = weighted_clusters(box_states(boxes), boxes.score, boxes.cls, settings.iou)
    cluster, rows = clusters.cluster, len(clusters.state)
    weight = np.maximum(boxes.score, _MIN_WEIGHT)
    weight = weight / np.bincount(cluster, weight)[cluster]
    aligned = np.where(np.cos(boxes.yaw - clusters.state[cluster, 6]) >= 0, 1.0, -1.0)
    evidence = np.bincount(cluster, aligned * boxes.flip_log_odds, rows)
    covariance = np.zeros((rows, STATE_DIM, STATE_DIM))
    np.add.at(covariance, cluster, weight[:, None, None] * boxes.covariance)
    first = np.unique(cluster, return_index=True)[1]
    fused = Boxes(
        center=clusters.state[:, :3],
        dims_lwh=clusters.state[:, 3:6],
        yaw=wrap_angle(clusters.state[:, 6] + np.where(evidence < 0, np.pi, 0.0)),
        score=clusters.mean_score,
        cls=boxes.cls[first],
        covariance=covariance,
        flip_log_odds=np.abs(evidence),
    )
    members = np.zeros((rows, len(cameras)), dtype=bool)
    members[cluster, camera_index] = True
    views = (whole_in_view(fused, cameras, settings.view_range_m) | members).sum(1)
    score = rescaled_score(clusters.mean_score, clusters.count, views, overflow=settings.overflow)
    order = np.argsort(-score, kind="stable")
    ranked = Boxes(**{**vars(fused), "score": score}).take(order)
    return FusedBoxes(ranked, members[order], np.argsort(order)[cluster])


def weighted_clusters(states: Array, score: Array, cls: NDArray[np.int64], iou: float) -> WeightedClusters:
    """Clusters of boxes as states (N, 7) with scores and classes (N,); boxes of different classes never meet.

    One box after another by the definition of the method: each must meet the means that those before it have made.
    """
    cluster = np.zeros(len(states), np.int64)
    fused = np.zeros((len(states), STATE_DIM))
    fused_cls = np.zeros(len(states), np.int64)
    members: list[list[int]] = []
    for row in np.argsort(-score, kind="stable"):
        known = len(members)
        overlap = iou_3d(fused[:known], states[row : row + 1])[:, 0] * (fused_cls[:known] == cls[row])
        best = int(overlap.argmax()) if known else 0
        if known and overlap[best] > iou:
            members[best].append(int(row))
            fused[best] = _weighted_mean(states[members[best]], score[members[best]])
        else:
            best = known
            members.append([int(row)])
            fused[best], fused_cls[best] = states[row], cls[row]
        cluster[row] = best
    count = np.bincount(cluster, minlength=len(members))
    mean = np.bincount(cluster, score, len(members)) / np.maximum(count, 1)
    return WeightedClusters(cluster, fused[: len(members)], mean, count)


def rescaled_score(mean_score: Array, count: Index, views: Index, *, overflow: bool = False) -> Array:
    """Scores (K,) after eq. 12, or eq. 13 with ``overflow``: T = ``count`` (K,), N = ``views`` (K,), at least 1."""
    n = np.maximum(views, 1)
    scaled: Array = np.minimum(mean_score * (count if overflow else np.minimum(count, n)) / n, 1.0)
    return scaled


def _weighted_mean(states: Array, score: Array) -> Array:
    """Score-weighted mean (7,) of states (T, 7): yaw as an axis, for headings may be flipped, on the best member's side."""
    weight = np.maximum(score, _MIN_WEIGHT)
    mean: Array = weight @ states / weight.sum()
    double = 2.0 * states[:, 6]
    axis = 0.5 * np.arctan2(weight @ np.sin(double), weight @ np.cos(double))
    mean[6] = wrap_angle(axis if np.cos(axis - states[0, 6]) >= 0 else axis + np.pi)
    return mean
