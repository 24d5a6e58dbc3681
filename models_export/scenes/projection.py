"""From cameras to OpenGL's clip space."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models_export.scenes.mesh import Array
from service.geometry.camera import Camera
from service.geometry.transforms import rigid, rotation_z, transform_points

NEAR_M, FAR_M = 0.5, 500.0


def clip_from_cam(camera: Camera) -> Array:
    """Projection (4, 4) from the camera frame to clip space; pixel centres at integers, first row at y = -1."""
    K = camera.K
    sx, sy = 2.0 / camera.width, 2.0 / camera.height
    P = np.zeros((4, 4))
    P[0] = [sx * K[0, 0], sx * K[0, 1], sx * (K[0, 2] + 0.5) - 1.0, 0.0]
    P[1] = [0.0, sy * K[1, 1], sy * (K[1, 2] + 0.5) - 1.0, 0.0]
    P[2] = [0.0, 0.0, (FAR_M + NEAR_M) / (FAR_M - NEAR_M), -2.0 * FAR_M * NEAR_M / (FAR_M - NEAR_M)]
    P[3] = [0.0, 0.0, 1.0, 0.0]
    return P


def crop_clip(camera: Camera, xyxy_px: Array) -> Array:
    """Matrices (N, 4, 4) on top of ``clip_from_cam`` that spread pixel rectangles (N, 4) over all of clip space."""
    sides = np.array([camera.width, camera.height])
    low = 2.0 * (xyxy_px[:, :2] + 0.5) / sides - 1.0
    high = 2.0 * (xyxy_px[:, 2:] + 0.5) / sides - 1.0
    M = np.tile(np.eye(4), (len(xyxy_px), 1, 1))
    for k in range(2):
        M[:, k, k] = 2.0 / (high[:, k] - low[:, k])
        M[:, k, 3] = -(high[:, k] + low[:, k]) / (high[:, k] - low[:, k])
    return M


def model_matrix(pose: Array, height_m: float, ground_m: float = 0.0) -> Array:
    """``world_from_model`` (4, 4) of something with pose x, y, yaw that stands on z = ``ground_m``."""
    return rigid(rotation_z(pose[2]), [pose[0], pose[1], ground_m + 0.5 * height_m])


def in_view(camera: Camera, boxes: Array) -> NDArray[np.bool_]:
    """Which of N things may be in a picture: (N,). boxes: (N, 6) x, y, yaw, length, width, ground height.

    Everything within a ball that holds the thing counts, so that nothing is missed.
    """
    reach = 0.5 * np.hypot(boxes[:, 3], boxes[:, 4]) + 2.0
    points = transform_points(camera.T_cam_world, np.column_stack([boxes[:, :2], boxes[:, 5] + 1.0]))
    x, y, z = points.T
    K, inside = camera.K, z > NEAR_M - reach
    for pixel, low, high, axis in ((x, -0.5, camera.width - 0.5, 0), (y, -0.5, camera.height - 0.5, 1)):
        for edge, sign in ((low, 1.0), (high, -1.0)):
            slope = (edge - K[axis, 2]) / K[axis, axis]
            # Signed distance from the plane through the eye and the picture's edge.
            inside &= sign * (pixel - slope * z) / np.hypot(1.0, slope) > -reach
    return np.asarray(inside)


def sun_clip(toward: Array, reach_m: float) -> Array:
    """Orthographic view (4, 4) from the sun, in direction ``toward`` (3,), of everything within ``reach_m`` of the origin."""
    side = np.cross([0.0, 0.0, 1.0], toward)
    side /= np.linalg.norm(side)
    R = np.stack([side, np.cross(toward, side), -toward])
    scale = np.diag([1 / reach_m, 1 / reach_m, 1 / 300.0, 1.0])
    return np.asarray(scale @ rigid(R, [0, 0, 0]), dtype=np.float64)
