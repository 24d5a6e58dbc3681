"""Oriented 3D boxes in the world frame, as arrays.

``center`` is the geometric centre, ``dims_lwh`` length, width, height in metres, ``yaw`` counter-clockwise from East about
gravity in [-pi, pi); the box's length runs along its heading. A covariance is 7x7 over (x, y, z, l, w, h, yaw).
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from service.geometry.camera import MIN_DEPTH_M, Camera
from service.geometry.transforms import Array, transform_points

CORNER_SIGNS = np.array([[sx, sy, sz] for sz in (-1, 1) for sx, sy in ((1, 1), (-1, 1), (-1, -1), (1, -1))], dtype=np.float64)
"""Signs (8, 3) of the corners over (length, width, height): bottom four first, counter-clockwise seen from above."""

BORDER_PX = 2.0
"""An edge of a 2D box this near to the image border counts as cut by it."""

TANGENT_DEGREES = (30, 60, 120, 150, 210, 240, 300, 330)
"""Directions in the image, clockwise from right, in which a vehicle's reach is read besides those of its 2D box's edges."""
TANGENT_DIRECTIONS = np.stack([np.cos(np.radians(TANGENT_DEGREES)), np.sin(np.radians(TANGENT_DEGREES))], 1)
"""(8, 2) their unit vectors: right, down."""

STATE_DIM = 7
"""x, y, z, length, width, height, yaw."""

YAW = 6
"""Place of the yaw in a state."""


@dataclass(frozen=True, eq=False)
class Boxes:
    """N boxes in the world frame; every array has N rows."""

    center: Array
    """(N, 3) geometric centres, metres."""
    dims_lwh: Array
    """(N, 3) length, width, height, metres."""
    yaw: Array
    """(N,) radians in [-pi, pi)."""
    score: Array
    """(N,) in 0..1."""
    cls: NDArray[np.int64]
    """(N,) class indices into the pack's classes."""
    covariance: Array
    """(N, 7, 7) over x y z l w h yaw."""
    flip_log_odds: Array
    """(N,) log-odds that the heading is ``yaw`` rather than ``yaw + pi``."""

    def __len__(self) -> int:
        return len(self.yaw)

    def take(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> Boxes:
        """The boxes at an index or mask."""
        return Boxes(
            self.center[index],
            self.dims_lwh[index],
            self.yaw[index],
            self.score[index],
            self.cls[index],
            self.covariance[index],
            self.flip_log_odds[index],
        )

    @staticmethod
    def empty() -> Boxes:
        """No boxes."""
        return Boxes(
            np.zeros((0, 3)),
            np.zeros((0, 3)),
            np.zeros(0),
            np.zeros(0),
            np.zeros(0, np.int64),
            np.zeros((0, 7, 7)),
            np.zeros(0),
        )

    @staticmethod
    def concatenate(parts: list[Boxes]) -> Boxes:
        """All boxes of several lists, in order."""
        if not parts:
            return Boxes.empty()
        return Boxes(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Boxes)})


def box_corners(center: ArrayLike, dims_lwh: ArrayLike, yaw: ArrayLike) -> Array:
    """World corners (..., 8, 3) in the order of ``CORNER_SIGNS`` of boxes (..., 3), (..., 3), (...)."""
    center = np.asarray(center, dtype=np.float64)
    offsets = 0.5 * CORNER_SIGNS * np.asarray(dims_lwh, dtype=np.float64)[..., None, :]
    c, s = np.cos(yaw)[..., None], np.sin(yaw)[..., None]
    x, y = offsets[..., 0], offsets[..., 1]
    rotated = np.stack([c * x - s * y, s * x + c * y, offsets[..., 2]], -1)
    return center[..., None, :] + rotated


def box_states(boxes: Boxes) -> Array:
    """State vectors (N, 7): x y z l w h yaw."""
    return np.concatenate([boxes.center, boxes.dims_lwh, boxes.yaw[:, None]], 1)


def project_extents(camera: Camera, center: ArrayLike, dims_lwh: ArrayLike, yaw: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
    """Extents of projected boxes in a camera.

    Returns xyxy (N, 4) in px, not clipped to the image, and in_front (N,): all eight corners before the camera. Where
    in_front is False the extents are not meaningful.
    """
    pixels, in_front = project_corners(camera, center, dims_lwh, yaw)
    return extents_of(pixels), in_front


def project_corners(camera: Camera, center: ArrayLike, dims_lwh: ArrayLike, yaw: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
    """Corners (N, 8, 2) of boxes in a camera, px, in the order of ``CORNER_SIGNS``, and in_front (N,) as above."""
    corners_cam = transform_points(camera.T_cam_world, box_corners(center, dims_lwh, yaw))
    return camera.project_cam(corners_cam), np.all(corners_cam[..., 2] > MIN_DEPTH_M, axis=-1)


def extents_of(points: ArrayLike) -> Array:
    """Extents (..., 4: left, top, right, bottom) of points (..., P, 2)."""
    points = np.asarray(points, dtype=np.float64)
    return np.concatenate([points.min(-2), points.max(-2)], -1)


def tangents_of(points_px: ArrayLike) -> Array:
    """How far points (..., P, 2) reach in each of ``TANGENT_DIRECTIONS``: (..., 8) px, the largest product with the direction.

    A straight line at this distance from the image's origin, square to the direction, touches the points from outside. With
    the four edges these are twelve tangents, which pin down the outline of a projected box.
    """
    reach: Array = (np.asarray(points_px, dtype=np.float64) @ TANGENT_DIRECTIONS.T).max(-2)
    return reach


def cut_edges(camera: Camera, xyxy_px: ArrayLike, border_px: float = BORDER_PX) -> NDArray[np.bool_]:
    """Which edges (N, 4: left, top, right, bottom) of 2D boxes (N, 4) lie at the image border, and so are cut by it."""
    xyxy = np.asarray(xyxy_px, dtype=np.float64)
    limits = np.array([camera.width - 1, camera.height - 1], dtype=np.float64)
    return np.concatenate([xyxy[:, :2] <= border_px, xyxy[:, 2:] >= limits - border_px], 1)


def scaled_extents(xyxy_px: ArrayLike, factor: ArrayLike) -> Array:
    """2D boxes (N, 4) in an image ``factor`` (2,) times as wide and high; pixel centres lie at integers."""
    return scaled_points(xyxy_px, np.tile(np.asarray(factor, dtype=np.float64), 2))


def scaled_points(points_px: ArrayLike, factor: ArrayLike) -> Array:
    """Coordinates (..., D) in an image ``factor`` (D,) times as large; pixel centres lie at integers."""
    scaled: Array = (np.asarray(points_px, dtype=np.float64) + 0.5) * np.asarray(factor, dtype=np.float64) - 0.5
    return scaled


def clip_extents(camera: Camera, xyxy: ArrayLike) -> Array:
    """2D boxes (N, 4) clipped to the image, whose pixels span [0, width - 1] x [0, height - 1]."""
    limits = np.array([camera.width - 1, camera.height - 1] * 2, dtype=np.float64)
    return np.clip(np.asarray(xyxy, dtype=np.float64), 0.0, limits)
