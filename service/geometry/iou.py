"""Intersection over union of 2D boxes, of rotated boxes in bird's-eye view, and of 3D boxes; float64, all pairs at once.

Rotated rectangles are clipped against each other by Sutherland and Hodgman's algorithm, vectorised over pairs: a
rectangle clipped by four half planes has at most eight vertices, so every pair fits an array of fixed width.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from service.geometry.transforms import Array

_MAX_VERTICES = 8
_RECT_SIGNS = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]], dtype=np.float64)


def iou_2d(a_xyxy: ArrayLike, b_xyxy: ArrayLike) -> Array:
    """IoU (N, M) of axis-aligned boxes (N, 4) and (M, 4) in px, as continuous coordinates."""
    a, b = np.asarray(a_xyxy, dtype=np.float64), np.asarray(b_xyxy, dtype=np.float64)
    top_left = np.maximum(a[:, None, :2], b[None, :, :2])
    bottom_right = np.minimum(a[:, None, 2:], b[None, :, 2:])
    intersection = np.prod(np.maximum(bottom_right - top_left, 0.0), axis=-1)
    area_a, area_b = np.prod(a[:, 2:] - a[:, :2], axis=-1), np.prod(b[:, 2:] - b[:, :2], axis=-1)
    return _ratio(intersection, area_a[:, None] + area_b[None, :] - intersection)


def rectangle_corners(xy: ArrayLike, lw: ArrayLike, yaw: ArrayLike) -> Array:
    """Corners (N, 4, 2), counter-clockwise, of rectangles with centres (N, 2), length and width (N, 2), yaw (N,)."""
    xy, lw, yaw = (np.asarray(v, dtype=np.float64) for v in (xy, lw, yaw))
    offsets = 0.5 * _RECT_SIGNS * lw[:, None, :]
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x, y = offsets[..., 0], offsets[..., 1]
    return xy[:, None, :] + np.stack([c * x - s * y, s * x + c * y], -1)


def clip_convex_pairs(subject: Array, clip: Array) -> Array:
    """Areas (P,) of the intersections of P pairs of convex quadrilaterals (P, 4, 2), corners counter-clockwise."""
    pairs = len(subject)
    vertices = np.zeros((pairs, _MAX_VERTICES, 2))
    vertices[:, :4] = subject
    count = np.full(pairs, 4)
    slots = np.arange(_MAX_VERTICES)
    rows = np.arange(pairs)[:, None]
    for edge in range(4):
        start = clip[:, edge]
        direction = clip[:, (edge + 1) % 4] - start
        valid = slots < count[:, None]
        following = np.where(slots + 1 < count[:, None], slots + 1, 0)
        nxt = vertices[rows, following]
        side = _cross(direction[:, None], vertices - start[:, None])
        side_next = side[rows, following]
        inside, inside_next = side >= 0, side_next >= 0
        crosses = valid & (inside != inside_next)
        with np.errstate(divide="ignore", invalid="ignore"):
            fraction = np.where(crosses, side / (side - side_next), 0.0)
        crossing = vertices + fraction[..., None] * (nxt - vertices)
        # Each edge of the subject yields its start (if inside), then its crossing (if any): 16 candidates, packed left.
        candidates = np.stack([vertices, crossing], 2).reshape(pairs, 2 * _MAX_VERTICES, 2)
        keep = np.stack([valid & inside, crosses], 2).reshape(pairs, 2 * _MAX_VERTICES)
        order = np.argsort(~keep, axis=1, kind="stable")[:, :_MAX_VERTICES]
        vertices = candidates[rows, order]
        count = np.minimum(keep.sum(1), _MAX_VERTICES)
    valid = slots < count[:, None]
    vertices = np.where(valid[..., None], vertices, vertices[:, :1])
    origin = vertices[:, :1]
    relative = vertices - origin
    area: Array = 0.5 * np.abs(_cross(relative[:, :-1], relative[:, 1:]).sum(1))
    return area


def intersection_bev(
    a_xy: ArrayLike, a_lw: ArrayLike, a_yaw: ArrayLike, b_xy: ArrayLike, b_lw: ArrayLike, b_yaw: ArrayLike
) -> Array:
    """Intersection areas (N, M) in m^2 of rotated rectangles a (N) and b (M) in bird's-eye view."""
    corners_a, corners_b = rectangle_corners(a_xy, a_lw, a_yaw), rectangle_corners(b_xy, b_lw, b_yaw)
    area = np.zeros((len(corners_a), len(corners_b)))
    if area.size == 0:
        return area
    centers_a, centers_b = corners_a.mean(1), corners_b.mean(1)
    reach_a = np.linalg.norm(corners_a - centers_a[:, None], axis=-1).max(1)
    reach_b = np.linalg.norm(corners_b - centers_b[:, None], axis=-1).max(1)
    distance = np.linalg.norm(centers_a[:, None] - centers_b[None], axis=-1)
    i, j = np.nonzero(distance <= reach_a[:, None] + reach_b[None])
    if len(i):
        area[i, j] = clip_convex_pairs(corners_a[i], corners_b[j])
    return area


def iou_bev(a: Array, b: Array) -> Array:
    """Bird's-eye IoU (N, M) of boxes as states (N, 7) and (M, 7): x y z l w h yaw, metres and radians."""
    a, b = _states(a), _states(b)
    intersection = intersection_bev(a[:, :2], a[:, 3:5], a[:, 6], b[:, :2], b[:, 3:5], b[:, 6])
    area_a, area_b = a[:, 3] * a[:, 4], b[:, 3] * b[:, 4]
    return _ratio(intersection, area_a[:, None] + area_b[None, :] - intersection)


def iou_3d(a: Array, b: Array) -> Array:
    """Volume IoU (N, M) of upright boxes as states (N, 7) and (M, 7): x y z l w h yaw, metres and radians."""
    a, b = _states(a), _states(b)
    base = intersection_bev(a[:, :2], a[:, 3:5], a[:, 6], b[:, :2], b[:, 3:5], b[:, 6])
    top = np.minimum((a[:, 2] + a[:, 5] / 2)[:, None], (b[:, 2] + b[:, 5] / 2)[None])
    bottom = np.maximum((a[:, 2] - a[:, 5] / 2)[:, None], (b[:, 2] - b[:, 5] / 2)[None])
    intersection = base * np.maximum(top - bottom, 0.0)
    volume_a, volume_b = np.prod(a[:, 3:6], axis=1), np.prod(b[:, 3:6], axis=1)
    return _ratio(intersection, volume_a[:, None] + volume_b[None, :] - intersection)


def _states(states: ArrayLike) -> Array:
    return np.asarray(states, dtype=np.float64).reshape(-1, 7)


def _cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _ratio(intersection: NDArray[np.float64], union: NDArray[np.float64]) -> Array:
    return np.divide(intersection, union, out=np.zeros_like(intersection), where=union > 0)
