"""What a 2D detector is asked for in the frames of a PandaSet drive: the extents of its vehicles' projected cuboids.

A vehicle counts when all of its corners are in front of the camera, enough of its extent lies inside the picture, and what is
left there is tall enough. The others, and what merely resembles a vehicle, are neither asked for nor is a box on them false.
A cuboid's extent is a little larger than the vehicle's outline, and stays the same where something hides the vehicle. Other
cuboids that hide it are known, and vehicles that they leave mostly clear are counted apart; fences, trees and the carrying
car are not known.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models_export.data.pandaset import VEHICLE_CLASSES, VEHICLE_LIKE, PandasetBoxes, PandasetClip
from service.geometry.boxes import box_corners, clip_extents, project_extents
from service.geometry.camera import MIN_DEPTH_M, Camera
from service.geometry.transforms import Array, transform_points

MIN_HEIGHT_PX = 25.0
"""Least height inside the picture of a vehicle that is asked for, px of the recording."""
MIN_INSIDE = 0.5
"""Least part of its extent inside the picture."""
MIN_CLEAR = 0.7
"""Least part of its extent that no nearer cuboid's extent covers, of a vehicle that counts as clear."""
_PAINT_PX = 4
"""Extents are painted over each other on a grid this coarse, px."""


@dataclass(frozen=True, eq=False)
class DriveFrame:
    """One camera's frame of one step, and its truth."""

    camera: Camera
    step: int
    jpeg: bytes
    xyxy_px: Array
    """(N, 4) vehicles asked for, clipped to the picture."""
    clear: NDArray[np.bool_]
    """(N,) those that nearer cuboids leave mostly clear."""
    ignored_xyxy_px: Array
    """(M, 4) where a box is neither right nor wrong, clipped to the picture."""


def drive_frames(clip: PandasetClip, every: int) -> Iterator[DriveFrame]:
    """Every camera's frame of every n-th step."""
    for step in range(0, clip.steps, every):
        boxes = clip.boxes(step)
        for camera_id in clip.camera_ids:
            camera = clip.camera(camera_id, step)
            yield DriveFrame(camera, step, clip.frame_bytes(camera_id, step), *truth_of(camera, boxes))


def truth_of(camera: Camera, boxes: PandasetBoxes) -> tuple[Array, NDArray[np.bool_], Array]:
    """A camera's vehicles that are asked for (N, 4), which of them are clear (N,), and the extents that are ignored (M, 4)."""
    like = np.array([label in VEHICLE_CLASSES or label in VEHICLE_LIKE for label in boxes.labels], dtype=bool)
    boxes = boxes.take(like)
    extents, in_front = project_extents(camera, boxes.center, boxes.dims_lwh, boxes.yaw)
    clipped = clip_extents(camera, extents)
    size, full = clipped[:, 2:] - clipped[:, :2], extents[:, 2:] - extents[:, :2]
    inside = np.prod(size, axis=1) / np.maximum(np.prod(full, axis=1), 1e-9)
    vehicle = np.array([label in VEHICLE_CLASSES for label in boxes.labels], dtype=bool)
    asked = vehicle & in_front & (size[:, 1] >= MIN_HEIGHT_PX) & (inside >= MIN_INSIDE)
    corners = transform_points(camera.T_cam_world, box_corners(boxes.center, boxes.dims_lwh, boxes.yaw))[..., 2]
    # A box partly behind the camera reaches the border from where its front part lies: good enough to ignore.
    present = (corners.max(1, initial=-np.inf) > MIN_DEPTH_M) & (size.min(1, initial=np.inf) > 0)
    clear = visible_part(camera, clipped, corners.mean(1), present) >= MIN_CLEAR
    return clipped[asked], clear[asked], clipped[present & ~asked]


def visible_part(camera: Camera, xyxy_px: Array, depth_m: Array, present: NDArray[np.bool_]) -> Array:
    """The part (N,) of extents (N, 4) that those of nearer boxes, by depth (N,), leave free; absent ones hide nothing."""
    owner = np.full((camera.height // _PAINT_PX + 1, camera.width // _PAINT_PX + 1), -1)
    first = np.floor(xyxy_px[:, :2] / _PAINT_PX).astype(int)
    last = np.ceil(xyxy_px[:, 2:] / _PAINT_PX).astype(int) + 1
    area = np.prod(np.maximum(last - first, 1), axis=1)
    for row in np.argsort(-depth_m):
        if present[row]:
            owner[first[row, 1] : last[row, 1], first[row, 0] : last[row, 0]] = row
    free: Array = np.bincount(owner[owner >= 0], minlength=len(area)) / np.maximum(area, 1)
    return free
