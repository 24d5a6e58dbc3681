"""Angles and rigid transforms, and what small arrays need often.

Frames: *world* is local ENU in metres (x East, y North, z up); *camera* is x right, y down, z forward. ``T_a_b`` maps
coordinates in frame b to frame a (``p_a = T_a_b @ p_b``), so inner names cancel: ``T_a_c = T_a_b @ T_b_c``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

# Columns are the world directions of a camera's x, y, z axes when it looks level to the East.
_R_WORLD_LEVELCAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def between(values: Array, low: float, high: float) -> Array:
    """``np.clip``, whose checks of its arguments cost more than its work on a few boxes."""
    clipped: Array = np.minimum(np.maximum(values, low), high)
    return clipped


def wrap_angle(angle_rad: ArrayLike) -> Array:
    """Wrap angles to [-pi, pi). Any shape, radians, float64."""
    wrapped = np.mod(np.asarray(angle_rad, dtype=np.float64) + np.pi, 2 * np.pi) - np.pi
    # For tiny negative sums `mod` rounds up to exactly 2 pi; keep the interval half open.
    return np.where(wrapped >= np.pi, -np.pi, wrapped)


def rotation_z(angle_rad: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) counter-clockwise about +z by angles of shape (...)."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    c, s = np.cos(angle), np.sin(angle)
    zero, one = np.zeros_like(c), np.ones_like(c)
    return np.stack([np.stack([c, -s, zero], -1), np.stack([s, c, zero], -1), np.stack([zero, zero, one], -1)], -2)


def rigid(R: ArrayLike, t: ArrayLike) -> Array:
    """A transform (4, 4) from a rotation (3, 3) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def invert_rigid(T: ArrayLike) -> Array:
    """Inverses (..., 4, 4) of rigid transforms, by transposing the rotation."""
    T = np.asarray(T, dtype=np.float64)
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    out = np.zeros_like(T)
    out[..., :3, :3] = R_t
    out[..., :3, 3] = -np.einsum("...ij,...j->...i", R_t, T[..., :3, 3])
    out[..., 3, 3] = 1.0
    return out


def transform_points(T: ArrayLike, points: ArrayLike) -> Array:
    """Apply one rigid transform (4, 4) to points (..., 3)."""
    T = np.asarray(T, dtype=np.float64)
    moved: Array = np.asarray(points, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]
    return moved


def inverse_2x2(matrices: Array) -> Array:
    """Inverses of symmetric, positive definite matrices (N, 2, 2); in closed form, several times quicker than LAPACK's."""
    xx, xy, yy = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 1]
    inverse = np.empty_like(matrices)
    scale = 1.0 / (xx * yy - xy * xy)
    inverse[:, 0, 0], inverse[:, 1, 1] = yy * scale, xx * scale
    inverse[:, 0, 1] = inverse[:, 1, 0] = -xy * scale
    return inverse


def pole_camera_pose(position_m: ArrayLike, heading_rad: float, pitch_rad: float, roll_rad: float = 0.0) -> Array:
    """``T_cam_world`` (4, 4) of a camera on a pole.

    position_m: (3,) world. heading_rad: counter-clockwise from East, the direction the camera looks in. pitch_rad:
    positive looks down. roll_rad: positive turns the picture's content counter-clockwise (camera rolled clockwise).
    """
    c, s = np.cos(pitch_rad), np.sin(pitch_rad)
    R_level_pitched = np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])
    R_pitched_rolled = rotation_z(roll_rad)
    R_world_cam = rotation_z(heading_rad) @ _R_WORLD_LEVELCAM @ R_level_pitched @ R_pitched_rolled
    return invert_rigid(rigid(R_world_cam, position_m))
