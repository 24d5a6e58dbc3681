"""Contact sheets: scenes at a glance."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from models_export.data.dataset import SceneTruth
from models_export.scenes.film import develop
from models_export.scenes.generate import SceneMaker
from models_export.scenes.renderer import Renderer
from models_export.scenes.request import SceneRequest
from service.errors import InputError
from service.geometry.boxes import box_corners
from service.geometry.camera import Camera

_EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))
_COLORS = {"Car": (90, 230, 120), "Van": (250, 190, 60), "Truck": (240, 110, 60), "Pedestrian": (120, 170, 255)}


def contact_sheet(
    requests: Sequence[SceneRequest], renderer: Renderer, scale: float, *, boxes: bool = False
) -> NDArray[np.uint8]:
    """One row a scene, one column a camera, the first step of each: (H, W, 3) RGB."""
    rows = []
    for request in requests:
        maker = SceneMaker(request, renderer)
        step = next(maker.steps())
        row = []
        for index, (camera, shot) in enumerate(zip(maker.plan.site.cameras, step.shots, strict=True)):
            picture = develop(shot.image, maker.plan.films[index], (request.seed, 0, index))
            if boxes:
                _draw_boxes(picture, camera, index, step.truth)
            row.append(cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
        rows.append(np.hstack(row))
    return np.vstack(rows).astype(np.uint8, copy=False)


def write_picture(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write a picture (H, W, 3) RGB as PNG or JPG. Raises InputError for other endings."""
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise InputError(f"cannot write {path.suffix or 'a file without ending'}.", field=str(path), remedy="Use .png or .jpg.")
    options = [] if path.suffix.lower() == ".png" else [cv2.IMWRITE_JPEG_QUALITY, 80]
    encoded, data = cv2.imencode(path.suffix, cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), options)
    assert encoded
    path.write_bytes(data.tobytes())


def _draw_boxes(picture: NDArray[np.uint8], camera: Camera, index: int, truth: SceneTruth) -> None:
    seen = np.flatnonzero(truth.visible[:, index] > 0)
    pixels, depth = camera.project(box_corners(truth.center[seen], truth.dims_lwh[seen], truth.yaw[seen]))
    for k, corners, z in zip(seen, np.clip(pixels, -5000, 5000), depth, strict=True):
        if z.min() < 0.5:
            continue
        for a, b in _EDGES:
            ends = (tuple(np.rint(corners[e]).astype(int).tolist()) for e in (a, b))
            cv2.line(picture, *ends, _COLORS.get(truth.classes[k], (230, 230, 90)), 1, cv2.LINE_AA)
