"""What is known exactly of a rendered step: how much of each road user each camera sees, and its KITTI labels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models_export.scenes.lens import Lens
from models_export.scenes.mesh import Array
from models_export.scenes.renderer import TILE_PX, Cast, Renderer, Shot
from service.geometry.boxes import project_extents

_MARGIN_PX = 1.0
_LEAST_VISIBLE = 0.001


@dataclass(frozen=True, eq=False)
class Sight:
    """One camera's view of N road users: visible fraction and truncation, (N,) each, as in ``SceneTruth``."""

    visible: Array
    truncated: Array


def measure_sight(renderer: Renderer, lens: Lens, shot: Shot, cast: Cast, boxes: tuple[Array, Array, Array]) -> Sight:
    """Compare each road user's pixels in a shot of ``lens.source`` with its silhouette alone.

    boxes: world centres (N, 3), sizes l, w, h (N, 3), yaw (N,), in the order of the cast.
    """
    camera, count = lens.source, len(cast.ids)
    visible, truncated = np.zeros(count), np.ones(count)
    xyxy, in_front = project_extents(camera, *boxes)
    xyxy = xyxy + _MARGIN_PX * np.array([-1, -1, 1, 1])
    limits = np.array([camera.width - 0.5, camera.height - 0.5])
    candidates = np.flatnonzero(in_front & np.all(xyxy[:, :2] < limits, 1) & np.all(xyxy[:, 2:] > -0.5, 1))
    if not len(candidates):
        return Sight(visible, truncated)
    rectangles = xyxy[candidates]
    masks = renderer.silhouettes(camera, rectangles, [cast.ids[k] for k in candidates], cast.placed) > 0
    width, height = TILE_PX
    sides = rectangles[:, 2:] - rectangles[:, :2]
    u = rectangles[:, :1] + (np.arange(width) + 0.5) / width * sides[:, :1]
    v = rectangles[:, 1:2] + (np.arange(height) + 0.5) / height * sides[:, 1:]
    area = sides.prod(1) / (width * height)
    alone = masks.sum((1, 2)) * area
    tiles = np.stack(np.broadcast_arrays(u[:, None, :], v[:, :, None]), -1)
    within = (masks & lens.contains(tiles)).sum((1, 2)) * area
    shown = lens.pixel_counts(shot, count)[candidates]
    seen = (within > 0) & (shown > _LEAST_VISIBLE * within)
    chosen = candidates[seen]
    visible[chosen] = np.clip(shown[seen] / within[seen], 0.0, 1.0)
    truncated[chosen] = np.clip(1.0 - within[seen] / alone[seen], 0.0, 1.0)
    return Sight(visible, truncated)
