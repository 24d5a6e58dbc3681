"""How far from the truth one moving camera puts vehicles, on the end of a PandaSet drive that no training sees.

The road is not read from the cuboids, for that would give away what is asked. A drive's world has its origin in the carrying
vehicle at the first step, on the axle's height; so the road lies a wheel's radius below, and rises and falls with the camera
from then on. Roll and pitch of the road are taken for zero.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from benchmarks.centres import CentreScore
from benchmarks.drive_truth import MIN_CLEAR, MIN_HEIGHT_PX, MIN_INSIDE
from models_export.data.pandaset import VEHICLE_CLASSES, PandasetBoxes, PandasetClip
from models_export.data.pandaset_samples import partial_extents, visible_fraction
from service.frames import EncodedFrame, FrameSet
from service.geometry.boxes import clip_extents
from service.geometry.camera import Camera
from service.geometry.ground import GroundPlane
from service.pipeline import Pipeline
from service.site import Site

WHEEL_RADIUS_M = 0.37
"""Of the carrying minivan (235/60 R18)."""
RANGE_M = 40.0
MATCH_M = 4.0
"""A box whose centre is farther from every vehicle's is false."""
_STEP_NS = 100_000_000


def score_single_cameras(pipeline: Pipeline, clip: PandasetClip, steps: Iterable[int]) -> CentreScore:
    """Every camera alone: vehicles in range, tall, inside and clear enough by the limits of ``drive_truth``."""
    score = CentreScore(MATCH_M)
    for step in steps:
        boxes = clip.boxes(step)
        like = boxes.take(np.array([label in VEHICLE_CLASSES for label in boxes.labels], dtype=bool))
        for camera_id in clip.camera_ids:
            camera = clip.camera(camera_id, step)
            site = Site("drive", (camera,), GroundPlane(offset=road_height(clip, camera_id, step)))
            frame = EncodedFrame(camera_id, clip.frame_bytes(camera_id, step), step * _STEP_NS)
            found = pipeline.run(FrameSet(site, (frame,), step * _STEP_NS, step + 1)).boxes.center
            in_range = np.linalg.norm(found - camera.position_m, axis=1) <= RANGE_M
            score.add(found, in_range, like.center, well_seen(camera, boxes, like))
    return score


def road_height(clip: PandasetClip, camera_id: str, step: int) -> float:
    """Height of the road in the drive's world, metres: from the camera's pose and the wheel alone."""
    now, start = (clip.camera(camera_id, at).position_m[2] for at in (step, 0))
    return float(now - start) - WHEEL_RADIUS_M


def well_seen(camera: Camera, boxes: PandasetBoxes, vehicles: PandasetBoxes) -> NDArray[np.bool_]:
    """Which vehicles (N,) a camera is asked for; all boxes of the step may hide them."""
    extents, whole = partial_extents(camera, vehicles)
    clipped = clip_extents(camera, extents)
    sides, full = clipped[:, 2:] - clipped[:, :2], extents[:, 2:] - extents[:, :2]
    inside = np.prod(sides, axis=1) / np.maximum(np.prod(full, axis=1), 1e-9)
    near = np.linalg.norm(vehicles.center - camera.position_m, axis=1) <= RANGE_M
    free = dict(zip(boxes.ids, visible_fraction(camera, boxes), strict=True))
    clear = np.array([free[name] >= MIN_CLEAR for name in vehicles.ids], dtype=bool)
    seen: NDArray[np.bool_] = whole & near & clear & (sides[:, 1] >= MIN_HEIGHT_PX) & (inside >= MIN_INSIDE)
    return seen
