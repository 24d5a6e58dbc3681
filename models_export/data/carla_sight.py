"""How much of each box a camera sees, from an instance picture and a depth picture.

CARLA cannot draw a vehicle alone, so the size of its unhidden silhouette is not known. What is known: the pixels that show
the vehicle (instance ids), and for each other pixel whose ray passes through the vehicle's box whether something stands
before the box (depth) or whether the ray went past the vehicle through an empty corner of its box. Of the pixels that are
hidden, the share ``FILL`` would have shown the vehicle:

    visible = own / (own + FILL * hidden)

It is exact for a vehicle that nothing hides. Against the simulator's exact fractions (331 views of more than 200 px, four
pole cameras) its mean error is 0.010, over the 82 views of hidden vehicles 0.014.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models_export.data.carla_images import ID_MASK
from service.geometry.boxes import project_extents
from service.geometry.camera import Camera
from service.geometry.transforms import Array, rotation_z

FILL = 0.74
"""Share of the projection of a vehicle's box that its silhouette fills: regressed on the simulator, which knows them."""
_MARGIN_PX = 2.0
_SLACK_M = 0.15
_LEAST_VISIBLE = 0.001
_GRID = 48
_PARALLEL = 1e-12


@dataclass(frozen=True, eq=False)
class BoxSight:
    """One camera's view of N boxes; every array has N rows."""

    visible: Array
    """(N,) estimated visible fraction; 0 where not seen."""
    truncated: Array
    """(N,) share of the box's projection outside the image; 1 where not seen."""
    own_px: NDArray[np.int64]
    """(N,) pixels with the box's id."""
    inside_px: NDArray[np.int64]
    """(N,) pixels whose surface lies inside of the box, whatever their id."""


def measure_boxes(
    camera: Camera,
    ids: NDArray[np.int64],
    boxes: tuple[Array, Array, Array],
    instance: NDArray[np.uint16],
    depth_m: Array,
) -> BoxSight:
    """See the module's text. A box that reaches behind the camera counts as not seen.

    ids: (N,) actors. boxes: world centres (N, 3), sizes l, w, h (N, 3), yaw (N,). instance: (H, W) lower sixteen bits of
    ids. depth_m: (H, W) metres along the optical axis.
    """
    count = len(ids)
    sight = BoxSight(np.zeros(count), np.ones(count), np.zeros(count, np.int64), np.zeros(count, np.int64))
    extents, in_front = project_extents(camera, *boxes)
    for k in np.flatnonzero(in_front):
        box = (boxes[0][k], boxes[1][k], float(boxes[2][k]))
        columns, rows = _window(extents[k, ::2], camera.width), _window(extents[k, 1::2], camera.height)
        if not len(columns) or not len(rows):
            continue
        entry, leave = _through_box(camera, columns, rows, box)
        view = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        own, depth = instance[view] == (int(ids[k]) & ID_MASK), depth_m[view]
        hit = entry < leave
        shown, hidden = int(own.sum()), int((hit & ~own & (depth < entry - _SLACK_M)).sum())
        sight.own_px[k] = shown
        sight.inside_px[k] = int((hit & (depth > entry - _SLACK_M) & (depth < leave)).sum())
        alone = shown + FILL * hidden
        if shown > _LEAST_VISIBLE * alone:
            sight.visible[k] = shown / alone
            sight.truncated[k] = _outside(camera, extents[k], box)
    return sight


def _window(span: Array, size: int) -> NDArray[np.int64]:
    """Pixels of one axis that a box with some margin covers inside the image."""
    low, high = int(np.floor(span[0] - _MARGIN_PX)), int(np.ceil(span[1] + _MARGIN_PX))
    return np.arange(max(low, 0), min(high, size - 1) + 1, dtype=np.int64)


def _outside(camera: Camera, extent: Array, box: tuple[Array, Array, float]) -> float:
    """Share of a box's projection that lies outside the image, on a grid over its extent (4,)."""
    steps = (np.arange(_GRID) + 0.5) / _GRID
    u, v = (extent[axis] + steps * (extent[axis + 2] - extent[axis]) for axis in (0, 1))
    entry, leave = _through_box(camera, u, v, box)
    hit = entry < leave
    within = np.outer((v > -0.5) & (v < camera.height - 0.5), (u > -0.5) & (u < camera.width - 0.5))
    return float(1.0 - (hit & within).sum() / max(int(hit.sum()), 1))


def _through_box(
    camera: Camera, u: NDArray[np.generic], v: NDArray[np.generic], box: tuple[Array, Array, float]
) -> tuple[Array, Array]:
    """Depths (V, U) at which the rays through pixels (u, v) enter and leave a box; entry > leave where they miss it.

    Slab method (Kay and Kajiya 1986) in the box's own axes; rays are scaled so that their parameter is depth.
    """
    center, dims, yaw = box
    pixels = np.stack(np.meshgrid(np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64)), -1)
    R_world_box = rotation_z(yaw)
    start = (camera.position_m - center) @ R_world_box
    along = camera.rays_world(pixels) @ R_world_box
    along = np.where(np.abs(along) < _PARALLEL, _PARALLEL, along)
    first, second = (-0.5 * dims - start) / along, (0.5 * dims - start) / along
    entry: Array = np.minimum(first, second).max(-1)
    leave: Array = np.maximum(first, second).min(-1)
    return np.maximum(entry, 0.0), leave
