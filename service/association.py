"""Who belongs to whom: gated assignment of boxes to clusters or tracks in bird's-eye view."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from service.geometry.boxes import Boxes
from service.geometry.iou import clip_convex_pairs, rectangle_corners
from service.geometry.transforms import Array

Index = NDArray[np.int64]


def mahalanobis_cost(a_xy: Array, a_cov: Array, b_xy: Array, b_cov: Array) -> tuple[Array, Array, Array]:
    """Squared Mahalanobis distance, d^2 + ln det S, and distance in metres: each (N, M), for points (N, 2) and (M, 2).

    S is the sum of both covariances (N, 2, 2) and (M, 2, 2), which must be positive definite. The determinant keeps a far,
    vague box from taking the place of a near, exact one (algorithms: fusion).
    """
    dx, dy = np.moveaxis(a_xy[:, None] - b_xy[None], -1, 0)
    S = a_cov[:, None] + b_cov[None]
    xx, xy, yy = S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]
    determinant = xx * yy - xy * xy
    squared = (yy * dx * dx - 2.0 * xy * dx * dy + xx * dy * dy) / determinant
    return squared, squared + np.log(determinant), np.hypot(dx, dy)


def gated_assignment(
    distance_sq: Array, cost: Array, distance_m: Array, gate: float, max_distance_m: float
) -> tuple[Index, Index]:
    """Rows and columns matched one to one, at the least total cost over the pairs inside both gates.

    Staying alone costs as much as the worst pair that the gate lets through, so a box does not push another one out of a
    good match just to have a bad one itself.
    """
    allowed = (distance_sq < gate) & (distance_m < max_distance_m)
    if not allowed.any():
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    n, m = cost.shape
    alone = gate + float((cost - distance_sq)[allowed].max())
    table = np.full((n, m + n), alone)
    table[:, :m] = np.where(allowed, cost, alone + 1e6)
    rows, columns = linear_sum_assignment(table)
    matched = columns < m
    return rows[matched].astype(np.int64), columns[matched].astype(np.int64)


def best_of_duplicates(boxes: Boxes, group: Index, iou: float, distance_m: float) -> Index:
    """For each box (N,) the row of the best-scored box of its group that it duplicates; its own row where it stays.

    Two boxes are one vehicle when their bird's-eye IoU is above ``iou`` or their centres are nearer than ``distance_m``.
    Boxes of different ``group`` (N,) are never compared.
    """
    keeper = np.arange(len(boxes))
    first, second = _same_vehicle(boxes, group, iou, distance_m)
    if len(first) == 0:
        return keeper
    same = np.eye(len(boxes), dtype=bool)
    same[first, second] = same[second, first] = True
    free = np.ones(len(boxes), dtype=bool)
    for row in np.argsort(-boxes.score, kind="stable"):
        if free[row]:
            mine = same[row] & free
            keeper[mine] = row
            free &= ~mine
    return keeper


def _same_vehicle(boxes: Boxes, group: Index, iou: float, distance_m: float) -> tuple[Index, Index]:
    """Pairs of rows, each pair once, of boxes of a group that are the same vehicle."""
    xy, lw = boxes.center[:, :2], boxes.dims_lwh[:, :2]
    apart = np.linalg.norm(xy[:, None] - xy[None], axis=-1)
    reach = 0.5 * np.linalg.norm(lw, axis=1)
    near = (group[:, None] == group[None]) & (apart < np.maximum(reach[:, None] + reach[None], distance_m))
    first, second = np.nonzero(np.triu(near, 1))
    if len(first):
        corners = rectangle_corners(xy, lw, boxes.yaw)
        shared = clip_convex_pairs(corners[first], corners[second])
        area = np.prod(lw, axis=1)
        same = (shared > iou * (area[first] + area[second] - shared)) | (apart[first, second] < distance_m)
        first, second = first[same], second[same]
    return first, second
