"""Who belongs to whom: gated assignment of boxes to clusters or tracks in bird's-eye view."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from service.geometry.boxes import Boxes
from service.geometry.iou import clip_convex_pairs, rectangle_corners
from service.geometry.transforms import Array

Index = NDArray[np.int64]


def mahalanobis_cost(a_xy: Array, a_cov: Array, b_xy: Array, b_cov: Array) -> tuple[Array, Array, Array]:
    """Squared Mahalanobis distance, d^2 + ln det S, and distance in metres: each (N, M), for points (N, 2) and (M, 2).

    S is the sum of both covariances (N, 2, 2) and (M, 2, 2), which must be positive definite. The determinant keeps a far,
    vague box from taking the place of a near, exact one (algorithms: fusion).
    """
    dx, dy = a_xy[:, None, 0] - b_xy[:, 0], a_xy[:, None, 1] - b_xy[:, 1]
    xx, xy, yy = (a_cov[:, None, i, j] + b_cov[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
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
    rows, columns = np.nonzero(allowed)
    n, m = cost.shape
    if len(rows) == 0 or max(np.bincount(rows).max(), np.bincount(columns).max()) == 1:
        # Nobody has a choice, and every pair inside the gates is better than two alone.
        return rows, columns
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
    rank = np.empty(len(boxes), np.int64)
    rank[np.argsort(-boxes.score, kind="stable")] = keeper
    swap = rank[first] > rank[second]
    better, worse = np.where(swap, second, first), np.where(swap, first, second)
    # A box stays when all better ones that it meets are gone, and goes when one of them stays; at least the best undecided box
    # is settled in each round.
    stays, goes = np.zeros(len(boxes), dtype=bool), np.zeros(len(boxes), dtype=bool)
    while True:
        blocked = np.zeros(len(boxes), dtype=bool)
        blocked[worse[~goes[better]]] = True
        stays |= ~blocked & ~goes
        goes[worse[stays[better]]] = True
        if (stays | goes).all():
            break
    settled = stays[better]
    best = np.full(len(boxes), len(boxes))
    np.minimum.at(best, worse[settled], rank[better[settled]])
    at_rank = np.argsort(rank)
    keeper[goes] = at_rank[best[goes]]
    return keeper


def _same_vehicle(boxes: Boxes, group: Index, iou: float, distance_m: float) -> tuple[Index, Index]:
    """Pairs of rows, each pair once, of boxes of a group that are the same vehicle."""
    xy, lw = boxes.center[:, :2], boxes.dims_lwh[:, :2]
    reach = np.maximum(0.5 * np.hypot(lw[:, 0], lw[:, 1]), 0.5 * distance_m)
    largest = 2.0 * float(reach.max()) if len(reach) else 0.0
    # Groups lie apart on a third axis, so that the tree pairs within groups only.
    points = np.empty((len(boxes), 3))
    points[:, :2], points[:, 2] = xy, group * (2.0 * largest + 1.0)
    first, second = cKDTree(points).query_pairs(largest, output_type="ndarray").T if len(boxes) else np.zeros((2, 0), np.int64)
    apart = np.hypot(xy[first, 0] - xy[second, 0], xy[first, 1] - xy[second, 1])
    near = apart < reach[first] + reach[second]
    if not near.any():
        return first[:0], second[:0]
    first, second = first[near], second[near]
    close = apart[near] < distance_m
    area = lw[:, 0] * lw[:, 1]
    total = area[first] + area[second]
    # Clipping polygons is dear: it is left to the pairs that neither distance nor a bound on the shared area settles.
    bounds = _shared_bound(boxes, np.concatenate([first, second]), np.concatenate([second, first]))
    bound = np.minimum(bounds[: len(first)], bounds[len(first) :])
    open_ = np.flatnonzero(~close & (bound > iou * (total - bound)))
    if len(open_):
        corners = rectangle_corners(xy, lw, boxes.yaw)
        shared = clip_convex_pairs(corners[first[open_]], corners[second[open_]])
        close[open_] = shared > iou * (total[open_] - shared)
    return first[close], second[close]


def _shared_bound(boxes: Boxes, a: Index, b: Index) -> Array:
    """Upper bounds (P,) on the area that rectangles a and b share: b's extent along a's sides, cut to a."""
    c, s = np.cos(boxes.yaw[a]), np.sin(boxes.yaw[a])
    offset = boxes.center[b, :2] - boxes.center[a, :2]
    turn = boxes.yaw[b] - boxes.yaw[a]
    cosine, sine = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    (length_a, width_a), (length_b, width_b) = boxes.dims_lwh[a, :2].T, boxes.dims_lwh[b, :2].T
    along = _shared_length(c * offset[:, 0] + s * offset[:, 1], length_a, length_b * cosine + width_b * sine)
    across = _shared_length(c * offset[:, 1] - s * offset[:, 0], width_a, length_b * sine + width_b * cosine)
    bound: Array = along * across
    return bound


def _shared_length(offset: Array, a: Array, b: Array) -> Array:
    """Length that intervals of lengths a and b share, their middles ``offset`` apart."""
    shared: Array = np.minimum(np.minimum(a, b), np.maximum(0.5 * (a + b) - np.abs(offset), 0.0))
    return shared
