"""The road surface of a site in the world frame: a plane, or a grid of heights where the road is not flat."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array, csr_array, eye_array, vstack
from scipy.sparse.linalg import spsolve

from service.errors import InputError
from service.geometry.transforms import Array

_UP = np.array([0.0, 0.0, 1.0])
_TANGENT_STEPS = 8
_ON_GROUND_M = 0.02
MAX_NODES = 250_000
"""Largest number of heights in a grid: half a kilometre square at 1 m."""


@dataclass(frozen=True, eq=False)
class GroundPlane:
    """The plane ``normal . p = offset`` in the world, metres; the default is z = 0."""

    normal: Array = field(default_factory=lambda: _UP.copy())
    """Unit normal (3,), pointing up (z > 0)."""
    offset: float = 0.0
    """Distance of the plane from the origin along the normal, metres."""

    def height_at(self, xy: ArrayLike) -> Array:
        """Heights z (...) of the ground under world positions (..., 2 or more), metres."""
        xy = np.asarray(xy, dtype=np.float64)
        height: Array = (self.offset - xy[..., :2] @ self.normal[:2]) / self.normal[2]
        return height

    def normal_at(self, xy: ArrayLike) -> Array:
        """Unit normals (..., 3) of the ground at world positions (..., 2 or more)."""
        return np.broadcast_to(self.normal, (*np.shape(xy)[:-1], 3))

    def tangent_at(self, xy: ArrayLike) -> tuple[Array, Array]:
        """Normals, (..., 3) or (3,), and offsets, (...) or (), of the planes that touch the ground at (..., 2 or more)."""
        return self.normal, np.asarray(self.offset)

    def intersect(self, origin_m: ArrayLike, directions: ArrayLike) -> Array:
        """Where rays from ``origin_m`` (3,) or (..., 3) along ``directions`` (..., 3) meet the ground: points (..., 3).

        NaN where a ray runs parallel to the ground or meets it behind its origin.
        """
        return _meet(np.asarray(origin_m, dtype=np.float64), np.asarray(directions, dtype=np.float64), self.normal, self.offset)


@dataclass(frozen=True, eq=False)
class GroundGrid:
    """Heights on a regular grid, bilinear between them; outside, the border's heights go on."""

    origin_xy: Array
    """(2,) world position of ``heights[0, 0]``, metres."""
    cell_m: float
    """Distance between neighbours, metres."""
    heights: Array
    """(R, C), both at least 2: z of the road, rows along y, columns along x, metres."""

    def height_at(self, xy: ArrayLike) -> Array:
        """Heights z (...) of the ground under world positions (..., 2 or more), metres."""
        return self._height_and_slope(np.asarray(xy, dtype=np.float64))[0]

    def normal_at(self, xy: ArrayLike) -> Array:
        """Unit normals (..., 3) of the ground at world positions (..., 2 or more)."""
        _, slope = self._height_and_slope(np.asarray(xy, dtype=np.float64))
        up = np.concatenate([-slope, np.ones_like(slope[..., :1])], -1)
        normal: Array = up / np.sqrt((up * up).sum(-1, keepdims=True))
        return normal

    def tangent_at(self, xy: ArrayLike) -> tuple[Array, Array]:
        """Unit normals (..., 3) and offsets (...) of the planes that touch the ground at world positions (..., 2 or more)."""
        xy = np.asarray(xy, dtype=np.float64)[..., :2]
        height, slope = self._height_and_slope(xy)
        scale = 1.0 / np.sqrt(1.0 + (slope * slope).sum(-1))
        normal = np.concatenate([-slope, np.ones_like(slope[..., :1])], -1) * scale[..., None]
        return normal, (height - (slope * xy).sum(-1)) * scale

    def intersect(self, origin_m: ArrayLike, directions: ArrayLike) -> Array:
        """Where rays from ``origin_m`` (3,) or (..., 3) along ``directions`` (..., 3) meet the ground: points (..., 3).

        By tangent planes, from the mean height on. NaN where a ray never meets the ground in front of its origin, or so
        flat that the tangents do not settle.
        """
        origin, directions = np.asarray(origin_m, dtype=np.float64), np.asarray(directions, dtype=np.float64)
        points = _meet(origin, directions, _UP, float(self.heights.mean()))
        for _ in range(_TANGENT_STEPS):
            points = _meet(origin, directions, *self.tangent_at(np.nan_to_num(points, posinf=0.0, neginf=0.0)))
        gap = np.abs(points[..., 2] - self.height_at(np.nan_to_num(points)))
        return np.where((gap < _ON_GROUND_M)[..., None], points, np.nan)

    def _height_and_slope(self, xy: Array) -> tuple[Array, Array]:
        """Heights (...) and slopes (..., 2) over x and y; flat beyond the border."""
        limit = np.array([self.heights.shape[1] - 1.0, self.heights.shape[0] - 1.0])
        where = (xy[..., :2] - self.origin_xy) / self.cell_m
        place = np.minimum(np.maximum(where, 0.0), limit)
        corner = np.minimum(place.astype(np.int64), (limit - 1).astype(np.int64))
        a, b = np.moveaxis(place - corner, -1, 0)
        column, row = corner[..., 0], corner[..., 1]
        h00, h01 = self.heights[row, column], self.heights[row, column + 1]
        h10, h11 = self.heights[row + 1, column], self.heights[row + 1, column + 1]
        low, high = h00 + a * (h01 - h00), h10 + a * (h11 - h10)
        slope = np.stack([(h01 - h00) * (1 - b) + (h11 - h10) * b, high - low], -1) / self.cell_m
        return low + b * (high - low), np.where(place == where, slope, 0.0)


Ground = GroundPlane | GroundGrid
"""The road surface: both answer ``height_at``, ``normal_at``, ``tangent_at`` and ``intersect``."""


def _meet(origin: Array, directions: Array, normal: Array, offset: ArrayLike) -> Array:
    """Points (..., 3) where rays meet planes in front of their origins, else NaN."""
    slope = (directions * normal).sum(-1)
    gap = offset - (origin * normal).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        distance = gap / slope
        usable = np.isfinite(distance) & (distance > 0)
    return origin + directions * np.where(usable, distance, np.nan)[..., None]


# ------------------------------------------------------------------ fitting


def fit_plane(bottoms: ArrayLike, huber_m: float = 0.3) -> GroundPlane:
    """The plane nearest to observed bottoms of vehicles (N, 3), world, metres; robust against those that fly or sink.

    Raises InputError for fewer than three points.
    """
    points = _points(bottoms)
    design = np.column_stack([points[:, :2], np.ones(len(points))])
    weight = np.ones(len(points))
    for _ in range(10):
        root = np.sqrt(weight)
        slope_x, slope_y, height = np.linalg.lstsq(design * root[:, None], points[:, 2] * root, rcond=None)[0]
        miss = np.abs(points[:, 2] - design @ [slope_x, slope_y, height])
        weight = np.minimum(1.0, huber_m / np.maximum(miss, 1e-9))
    scale = 1.0 / np.sqrt(1.0 + slope_x**2 + slope_y**2)
    return GroundPlane(np.array([-slope_x, -slope_y, 1.0]) * scale, float(height * scale))


def fit_grid(bottoms: ArrayLike, cell_m: float = 4.0, bend: float = 1.0, huber_m: float = 0.3) -> GroundGrid:
    """A grid of heights from observed bottoms of vehicles (N, 3), world, metres; it covers them all.

    Least squares (Huber beyond ``huber_m``) with a penalty on second differences, ``bend`` observations strong a node:
    nodes without vehicles lie on the smooth continuation of the road. Raises InputError for fewer than three points, or an
    area with more than ``MAX_NODES`` nodes.
    """
    points = _points(bottoms)
    low = np.floor(points[:, :2].min(0) / cell_m) * cell_m
    columns, rows = (np.ceil((points[:, :2].max(0) - low) / cell_m).astype(int) + 1).clip(2)
    if rows * columns > MAX_NODES:
        raise InputError(
            f"{rows} x {columns} heights at {cell_m} m.", field="cell_m", remedy=f"Take larger cells; the most is {MAX_NODES}."
        )
    design = _bilinear(points[:, :2], low, cell_m, rows, columns)
    stiff = _second_differences(rows, columns)
    # A trace of pull to the median height, for a road that fixes less than a plane.
    level = float(np.median(points[:, 2]))
    penalty = bend * (stiff.T @ stiff) + 1e-6 * eye_array(rows * columns)
    weight = np.ones(len(points))
    heights = np.zeros(rows * columns)
    for _ in range(6):
        weighted = design.T.multiply(weight).tocsr()
        heights = spsolve((weighted @ design + penalty).tocsc(), weighted @ (points[:, 2] - level))
        miss = np.abs(points[:, 2] - level - design @ heights)
        weight = np.minimum(1.0, huber_m / np.maximum(miss, 1e-9))
    return GroundGrid(low, cell_m, heights.reshape(rows, columns) + level)


def _points(bottoms: ArrayLike) -> Array:
    points = np.asarray(bottoms, dtype=np.float64).reshape(-1, 3)
    if len(points) < 3 or not np.isfinite(points).all():
        raise InputError(
            f"{len(points)} points, or some not finite.", field="bottoms", remedy="Give at least three points on the road."
        )
    return points


def _bilinear(xy: Array, low: Array, cell_m: float, rows: int, columns: int) -> csr_array:
    """Weights (N, rows * columns) of the nodes at positions (N, 2)."""
    place = (xy - low) / cell_m
    corner = np.minimum(place.astype(np.int64), [columns - 2, rows - 2])
    a, b = (place - corner).T
    node = corner[:, 1] * columns + corner[:, 0]
    values = np.concatenate([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    nodes = np.concatenate([node, node + 1, node + columns, node + columns + 1])
    return csr_array(coo_array((values, (np.tile(np.arange(len(xy)), 4), nodes)), shape=(len(xy), rows * columns)))


def _second_differences(rows: int, columns: int) -> csr_array:
    """Second differences along x, along y, and across (twist), of a (rows, columns) grid: zero for every plane."""
    node = np.arange(rows * columns).reshape(rows, columns)
    stencils = [
        (np.stack([node[:, :-2], node[:, 1:-1], node[:, 2:]], -1), [1.0, -2.0, 1.0]),
        (np.stack([node[:-2], node[1:-1], node[2:]], -1), [1.0, -2.0, 1.0]),
        (np.stack([node[:-1, :-1], node[:-1, 1:], node[1:, :-1], node[1:, 1:]], -1), [1.0, -1.0, -1.0, 1.0]),
    ]
    parts = []
    for nodes, signs in stencils:
        flat = nodes.reshape(-1, len(signs))
        index = np.repeat(np.arange(len(flat)), len(signs))
        parts.append(coo_array((np.tile(signs, len(flat)), (index, flat.ravel())), shape=(len(flat), node.size)))
    return csr_array(vstack(parts))
