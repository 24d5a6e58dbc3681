"""From a plan's moment to what the renderer draws: placed bodies and the lamps that are on."""

from __future__ import annotations

import numpy as np

from models_export.scenes.lamplight import Lamps, beam_pools, street_pools
from models_export.scenes.mesh import Array
from models_export.scenes.plan import Moment, ScenePlan
from models_export.scenes.projection import model_matrix
from models_export.scenes.renderer import Cast
from service.geometry.transforms import transform_points

_HEAD_RGB = np.array([1.0, 0.96, 0.88])
_TAIL_RGB = np.array([1.0, 0.07, 0.05])
_HEAD_GLOW, _TAIL_GLOW, _STREET_GLOW = 1.4, 0.40, 0.8
_HEAD_M, _TAIL_M, _STREET_M = 0.42, 0.25, 0.5
"""Radii of halos."""
_BEAM = 0.30
"""Light of both head lamps on the road where it is brightest."""


def cast_of(plan: ScenePlan, moment: Moment) -> Cast:
    """Everybody on stage."""
    dims = moment.dims_lwh
    matrices = [model_matrix(*row) for row in zip(moment.poses, dims[:, 2], moment.ground, strict=True)]
    boxes = np.column_stack([moment.poses, dims[:, :2], moment.ground])
    return Cast(moment.ids, dict(zip(moment.ids, matrices, strict=True)), boxes, _lamps(plan, moment, matrices))


def _lamps(plan: ScenePlan, moment: Moment, matrices: list[Array]) -> Lamps:
    light = plan.light
    places, colors, sizes, facings = [], [], [], []

    def add(points: Array, rgb: Array, size: float, facing: Array) -> None:
        places.append(points)
        colors.append(np.broadcast_to(rgb, points.shape))
        sizes.append(np.full(len(points), size))
        facings.append(np.broadcast_to(facing, points.shape))

    street = light.lamp_rgb.max() > 0 and len(plan.lamp_heads) > 0
    if street and light.weather not in ("indoor", "dim"):
        add(plan.lamp_heads, _STREET_GLOW * light.lamp_rgb / light.lamp_rgb.max(), _STREET_M, np.zeros(3))
    for model, matrix in zip(moment.models, matrices, strict=True):
        for lamps, rgb, glow, size, sign in (
            (model.head_lamps, _HEAD_RGB, _HEAD_GLOW, _HEAD_M, 1.0),
            (model.tail_lamps, _TAIL_RGB, _TAIL_GLOW, _TAIL_M, -1.0),
        ):
            if len(lamps):
                add(transform_points(matrix, lamps), glow * rgb, size, sign * matrix[:3, 0])
    pools = [street_pools(plan.lamp_heads, light.lamp_rgb)] if street else []
    pools += [_beams(moment)] if light.dark and light.lamps_on else []
    if not places and not pools:
        return Lamps.none()
    empty = Lamps.none()
    halo = [
        np.concatenate(p) if p else e
        for p, e in ((places, empty.place), (colors, empty.rgb), (sizes, empty.size), (facings, empty.facing))
    ]
    return Lamps(*halo, np.concatenate(pools) if pools else empty.pools)


def _beams(moment: Moment) -> Array:
    lit = np.array([len(m.head_lamps) > 0 for m in moment.models], dtype=bool)
    return beam_pools(moment.poses[lit], moment.dims_lwh[lit, 0], _BEAM * _HEAD_RGB)
