"""PandaSet frames (CC BY 4.0) as samples of detector and multi-bin head: cuboids projected into the vehicle's six cameras.

PandaSet does not say what a camera sees of a cuboid. Cuboids hide each other here, drawn from far to near; what walls and
hedges hide is not known. Steps at the end of the drive are kept out of training: the same street, and many of the same parked
cars, a few seconds later.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from models_export.data.detection import ANY_VEHICLE, IGNORED, MIN_SIDE_PX, VehicleSample, class_columns
from models_export.data.pandaset import VEHICLE_CLASSES, VEHICLE_LIKE, PandasetBoxes, PandasetClip, open_pandaset
from service.frames import decode
from service.geometry.boxes import box_corners, clip_extents, project_corners
from service.geometry.camera import Camera, ray_azimuth
from service.geometry.transforms import Array, transform_points, wrap_angle
from service.nets.canvas import to_canvas

ARCHIVE = "pandaset_clip.zip"
SOURCE = "pandaset"
ATTRIBUTION = "PandaSet, Hesai and Scale AI, CC BY 4.0"
TRAINING_STEPS, HELD_OUT_STEPS = range(0, 40), range(45, 60)
"""Five steps between them are on neither side."""
VAN_LIKE_LWH = (4.8, 0.0, 1.9)
"""A `Car` longer and higher than this may be a van, which PandaSet calls cars: its class counts as unknown."""
MIN_HEIGHT_PX, MAX_DISTANCE_M = 14.0, 50.0
"""Vehicles that are lower in the decoded image, or farther, are ignored: what hides them is not known."""
MIN_VISIBLE, MAX_TRUNCATED = 0.4, 0.6
"""Vehicles less visible, or farther outside the image, are neither positives nor negatives."""
NEAR_M = 0.3
"""Corners nearer to the camera's plane are left out of a box's extents."""
_MASK_SCALE = 4
"""Pixels of the image a pixel of the mask that says what hides what."""


def load_pandaset(
    archive: Path, classes: tuple[str, ...], max_width: int, steps: range = TRAINING_STEPS
) -> list[VehicleSample]:
    """All cameras' samples of a range of steps, in memory. Raises NotFoundError when the archive is not there."""
    clip = open_pandaset(archive)
    return [pandaset_sample(clip, camera_id, step, classes, max_width) for step in steps for camera_id in clip.camera_ids]


def pandaset_sample(clip: PandasetClip, camera_id: str, step: int, classes: tuple[str, ...], max_width: int) -> VehicleSample:
    """One camera's frame. classes: lower-case names, in the network's order."""
    full = clip.camera(camera_id, step)
    image = decode(clip.frame_bytes(camera_id, step), full, max_width)
    camera = full.scaled(image.shape[1], image.shape[0])
    boxes = clip.boxes(step)
    extents, whole = partial_extents(camera, boxes)
    kinds = np.array([kind_of(label, dims) for label, dims in zip(boxes.labels, boxes.dims_lwh, strict=True)], dtype=object)
    clipped = clip_extents(camera, extents)
    sides = clipped[:, 2:] - clipped[:, :2]
    seen = np.array([kind is not None for kind in kinds], dtype=bool) & (sides.min(1, initial=np.inf) > 1)
    inside = np.prod(sides, axis=1) / np.maximum(np.prod(extents[:, 2:] - extents[:, :2], axis=1), 1e-6)
    doubtful = ~whole | (visible_fraction(camera, boxes) < MIN_VISIBLE) | (1 - inside > MAX_TRUNCATED)
    doubtful |= (sides.min(1, initial=np.inf) < MIN_SIDE_PX) | (sides[:, 1] < MIN_HEIGHT_PX)
    doubtful |= np.linalg.norm(boxes.center - camera.position_m, axis=1) > MAX_DISTANCE_M
    cls, known, unwanted = class_columns(kinds[seen].tolist(), classes)
    xyxy = clipped[seen]
    return VehicleSample(
        canvas=to_canvas(image),
        image_size=(image.shape[1], image.shape[0]),
        xyxy_px=xyxy,
        ignore=unwanted | doubtful[seen],
        cls=cls,
        class_known=known,
        source=f"{SOURCE}/{camera_id}",
        camera=camera,
        dims_lwh=boxes.dims_lwh[seen],
        alpha=wrap_angle(boxes.yaw[seen] - ray_azimuth(camera, (xyxy[:, :2] + xyxy[:, 2:]) / 2)),
        corners_px=project_corners(camera, boxes.center[seen], boxes.dims_lwh[seen], boxes.yaw[seen])[0],
    )


def kind_of(label: str, dims_lwh: Array) -> str | None:
    """Our kind of an object; None for one that is background."""
    if label in VEHICLE_LIKE:
        return IGNORED
    if label == "Car" and np.all(dims_lwh > VAN_LIKE_LWH):
        return ANY_VEHICLE
    return VEHICLE_CLASSES.get(label)


def partial_extents(camera: Camera, boxes: PandasetBoxes) -> tuple[Array, NDArray[np.bool_]]:
    """Extents (N, 4) of the corners in front of a camera, px, not clipped, and whether all corners are (N,).

    A box wholly behind the camera gets an empty extent at the origin.
    """
    extents = np.zeros((len(boxes), 4))
    whole = np.zeros(len(boxes), dtype=bool)
    for row, corners in enumerate(_corners_cam(camera, boxes)):
        front = corners[corners[:, 2] > NEAR_M]
        if len(front):
            pixels = camera.project_cam(front)
            extents[row] = np.concatenate([pixels.min(0), pixels.max(0)])
            whole[row] = len(front) == len(corners)
    return extents, whole


def visible_fraction(camera: Camera, boxes: PandasetBoxes) -> Array:
    """How much of each box's silhouette in the image (N,) no nearer box hides, 0..1; 0 for boxes out of the image."""
    corners = _corners_cam(camera, boxes)
    mask = np.zeros((-(-camera.height // _MASK_SCALE), -(-camera.width // _MASK_SCALE)), np.int32)
    alone = np.zeros(len(boxes))
    distance = np.linalg.norm(corners.mean(1), axis=1)
    for row in np.argsort(-distance):
        front = corners[row][corners[row][:, 2] > NEAR_M]
        if len(front) >= 3:
            hull = cv2.convexHull(np.clip(camera.project_cam(front) / _MASK_SCALE, -1e4, 1e4).astype(np.int32))
            own = cv2.fillConvexPoly(np.zeros(mask.shape, np.uint8), hull, 1).astype(bool)
            alone[row] = own.sum()
            mask[own] = row + 1
    left = np.bincount(mask.ravel(), minlength=len(boxes) + 1)[1:]
    return np.asarray(left / np.maximum(alone, 1))


def _corners_cam(camera: Camera, boxes: PandasetBoxes) -> Array:
    corners: Array = transform_points(camera.T_cam_world, box_corners(boxes.center, boxes.dims_lwh, boxes.yaw))
    return corners
