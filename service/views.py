"""Which cameras have which place in view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from service.geometry.boxes import Boxes, box_corners
from service.geometry.camera import MIN_DEPTH_M, Camera
from service.geometry.transforms import Array


def whole_in_view(boxes: Boxes, cameras: Sequence[Camera], range_m: float) -> NDArray[np.bool_]:
    """(M, C): whether each of C cameras has each of M boxes wholly in its picture, its centre within ``range_m`` metres.

    Whether something else hides the box is not known here.
    """
    if len(boxes) == 0 or len(cameras) == 0:
        return np.zeros((len(boxes), len(cameras)), dtype=bool)
    T = np.array([camera.T_cam_world for camera in cameras])
    points = np.empty((len(boxes), 9, 3))
    points[:, :8], points[:, 8] = box_corners(boxes.center, boxes.dims_lwh, boxes.yaw), boxes.center
    points_cam = points.reshape(-1, 3) @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]
    pixels = _pixels(cameras, points_cam)
    limits = np.array([[[camera.width - 1.0, camera.height - 1.0]] for camera in cameras])
    inside = ((pixels >= 0.0) & (pixels <= limits)).all(2) & (points_cam[..., 2] > MIN_DEPTH_M)
    # The camera's centre is where its transform gives zero, so distance is the length of the transformed centre.
    center = points_cam[:, 8::9]
    near = (center * center).sum(2) <= range_m**2
    whole: NDArray[np.bool_] = (inside.reshape(len(cameras), -1, 9).all(2) & near).T
    return whole


def _pixels(cameras: Sequence[Camera], points_cam: Array) -> Array:
    """Pixels (C, P, 2) of points (C, P, 3), each in its own camera's frame."""
    if any(camera.has_distortion for camera in cameras):
        return np.stack([camera.project_cam(points) for camera, points in zip(cameras, points_cam, strict=True)])
    K = np.array([camera.K for camera in cameras])
    normalised = points_cam[..., :2] / np.maximum(points_cam[..., 2:], MIN_DEPTH_M)
    pixels: Array = normalised @ K[:, :2, :2].transpose(0, 2, 1) + K[:, None, :2, 2]
    return pixels
