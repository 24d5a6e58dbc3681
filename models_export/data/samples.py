"""Scene folders as training samples: canvases as the service would make them, and their truth in canvas pixels."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from models_export.data.ahead import mapped_ahead
from models_export.data.dataset import UNKNOWN_CONDITION, Scene, SceneTruth, list_scenes, open_scene
from models_export.data.detection import MIN_SIDE_PX, VEHICLES, EncodedStill, VehicleSample, class_columns
from service.errors import InputError
from service.geometry.boxes import clip_extents, extents_of, project_corners
from service.geometry.camera import Camera, ray_azimuth
from service.geometry.ground import Ground
from service.geometry.transforms import Array, wrap_angle
from service.nets.canvas import to_canvas

SIMULATED = "simulated"
"""The first part of the source of a scene's frames."""
MIN_VISIBLE = 0.3
"""Vehicles of which less is visible are neither positives nor negatives."""
MAX_TRUNCATED = 0.7
"""Vehicles of which more lies outside the image are neither positives nor negatives."""
MAX_DEPTH_M = 150.0
"""Depths beyond are masked: their inverse is smaller than the noise."""
VALIDATION_EVERY = 10
"""Every tenth scene validates; a scene is never on both sides."""


@dataclass(frozen=True, eq=False)
class Sample(VehicleSample):
    """One camera's frame of a scene, where everything is known."""

    visible: Array
    """(N,) visible fraction."""
    truncated: Array
    """(N,) fraction outside the image."""
    center: Array
    """(N, 3) geometric centres in the world, metres."""
    ground: Ground
    """The scene's road."""
    inverse_depth: NDArray[np.float32]
    """(h, w) 1 / metres at the depth net's stride; 0 where the depth is unknown."""
    weather: str = UNKNOWN_CONDITION
    """Light and weather of the scene: day, night, fog, ..."""

    @property
    def labels(self) -> dict[str, str]:
        """What validation tells frames apart by."""
        return {"camera": self.camera.id, "weather": self.weather}


def split_scenes(roots: Iterable[Path]) -> tuple[list[Path], list[Path]]:
    """Training and validation scenes of data sets. Raises InputError when a side is empty."""
    scenes = [scene for root in roots for scene in list_scenes(root)]
    validation = scenes[VALIDATION_EVERY - 1 :: VALIDATION_EVERY]
    training = [scene for scene in scenes if scene not in validation]
    if not training or not validation:
        raise InputError(
            f"{len(scenes)} scenes found.",
            field="data",
            remedy=f"Training needs at least {VALIDATION_EVERY}: render more with `quadlift scenes render`.",
        )
    return training, validation


def read_samples(scenes: Iterable[Path], classes: tuple[str, ...], max_width: int, depth_stride: int) -> Iterator[Sample]:
    """All frames of all cameras of scenes, read as they are taken. classes: lower-case names, in the network's order."""
    parts = mapped_ahead(lambda path: _load_scene(open_scene(path), classes, max_width, depth_stride), scenes)
    return chain.from_iterable(parts)


def _load_scene(scene: Scene, classes: tuple[str, ...], max_width: int, depth_stride: int) -> list[Sample]:
    samples = []
    for step in range(scene.steps):
        truth = scene.truth(step)
        for camera_index, camera in enumerate(scene.site.cameras):
            samples.append(_load_sample(scene, step, truth, camera_index, camera, classes, max_width, depth_stride))
    return samples


def _load_sample(
    scene: Scene,
    step: int,
    truth: SceneTruth,
    camera_index: int,
    camera: Camera,
    classes: tuple[str, ...],
    max_width: int,
    depth_stride: int,
) -> Sample:
    still = EncodedStill(scene.frame_bytes(camera.id, step), camera)
    image, scaled = still.at(max_width)
    corners, in_front = project_corners(scaled, truth.center, truth.dims_lwh, truth.yaw)
    kinds = np.array(truth.kinds, dtype=str)
    seen = in_front & (truth.visible[:, camera_index] > 0) & (np.isin(kinds, classes) | np.isin(kinds, VEHICLES))
    xyxy = clip_extents(scaled, extents_of(corners[seen]))
    visible, truncated = truth.visible[seen, camera_index], truth.truncated[seen, camera_index]
    sides = xyxy[:, 2:] - xyxy[:, :2]
    cls, known, unwanted = class_columns(kinds[seen].tolist(), classes)
    ignore = unwanted | (visible < MIN_VISIBLE) | (sides.min(1, initial=np.inf) < MIN_SIDE_PX) | (truncated > MAX_TRUNCATED)
    return Sample(
        canvas=to_canvas(image),
        image_size=(image.shape[1], image.shape[0]),
        camera=scaled,
        xyxy_px=xyxy,
        ignore=ignore,
        cls=cls,
        class_known=known,
        source=f"{SIMULATED}/{scene.world}",
        dims_lwh=truth.dims_lwh[seen],
        alpha=wrap_angle(truth.yaw[seen] - ray_azimuth(scaled, (xyxy[:, :2] + xyxy[:, 2:]) / 2)),
        corners_px=corners[seen],
        visible=visible,
        truncated=truncated,
        center=truth.center[seen],
        ground=scene.site.ground,
        inverse_depth=_inverse_depth(scene.depth(camera.id, step), to_canvas(image).shape[:2], image.shape[:2], depth_stride),
        weather=scene.condition,
        still=still,
    )


def _inverse_depth(
    depth_m: NDArray[np.float32], canvas: tuple[int, ...], image: tuple[int, ...], stride: int
) -> NDArray[np.float32]:
    """Inverse depth at the centres of the net's cells; nearest neighbour, for a mean of two surfaces is neither."""
    rows, columns = canvas[0] // stride, canvas[1] // stride
    scale = depth_m.shape[1] / image[1], depth_m.shape[0] / image[0]
    x = ((np.arange(columns) + 0.5) * stride * scale[0] - 0.5).astype(np.float32)
    y = ((np.arange(rows) + 0.5) * stride * scale[1] - 0.5).astype(np.float32)
    sampled = cv2.remap(depth_m, *np.meshgrid(x, y), cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    known = (sampled > 0) & (sampled < MAX_DEPTH_M)
    return np.where(known, 1.0 / np.maximum(sampled, 0.1), 0.0).astype(np.float32)
