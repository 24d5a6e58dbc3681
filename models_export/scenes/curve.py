"""The curve: one road of one or two lanes a side that bends."""

from __future__ import annotations

import numpy as np

from models_export.scenes.layout import REACH_M, Plot, RoadWorld, Route, offset, resampled
from models_export.scenes.mesh import Array, MeshBuilder, Surface
from models_export.scenes.pavement import KERB_M, Style, lay_asphalt, lay_block, line_along, sample_style

_COMFORT_MPS2 = 2.2
"""Lateral acceleration that drivers accept."""


def curve(rng: np.random.Generator) -> RoadWorld:
    """A random bend to the left (seen from the west), its middle at the origin."""
    style = sample_style(rng)
    lanes = int(rng.choice([1, 2], p=[0.55, 0.45]))
    bend, radius = float(np.deg2rad(rng.uniform(45, 100))), float(rng.uniform(22, 60))
    center = _center_line(bend, radius)
    edge = lanes * style.lane_m
    half = edge + 0.5
    ground = MeshBuilder()
    inner, outer = offset(center, half), offset(center, -half)[::-1]
    inside = inner[0] + inner[-1] - inner[len(inner) // 2]
    lay_block(ground, inner, inside, style)
    lay_block(ground, outer, offset(outer, 160.0), style)
    lay_asphalt(ground, style)
    _mend(ground, center, edge, style, rng)
    if rng.random() < 0.6:
        line_along(ground, center, 0.12)
        line_along(ground, center, -0.12)
    else:
        line_along(ground, center, 0.0, 0.13, 3.0, 4.5)
    for side in (1, -1):
        line_along(ground, center, side * edge)
        for k in range(1, lanes):
            line_along(ground, center, side * k * style.lane_m, 0.12, 2.0, 4.0)
    kerbs = (inner, outer)
    return RoadWorld(
        "curve",
        ground,
        tuple(_routes(center, lanes, style.lane_m, bend, radius, float(rng.uniform(9, 16)))),
        (),
        tuple(_plots(kerbs, style.walk_m + float(rng.uniform(3, 7)), rng)),
        _poles(center, half, rng),
        0,
        (-bend / 2, bend / 2),
        tuple(offset(line, style.walk_m * share) for line in kerbs for share in (0.35, 0.7)),
        KERB_M,
        kerbs,
    )


def _center_line(bend: float, radius: float) -> Array:
    """A straight, an arc to the left and a straight, symmetric about the y axis, arc's middle at the origin (N, 2)."""
    angle = np.linspace(-bend / 2, bend / 2, 2 * int(np.ceil(bend * radius / 1.0)) + 1)
    arc = radius * np.stack([np.sin(angle), 1 - np.cos(angle)], 1)
    run = np.arange(0.5, REACH_M + 20, 0.5)[:, None]
    out = np.array([np.cos(bend / 2), np.sin(bend / 2)])
    after = arc[-1] + run * out
    before = after[::-1] * np.array([-1.0, 1.0])
    return np.concatenate([before, arc, after])


def _routes(center: Array, lanes: int, lane_m: float, bend: float, radius: float, speed: float) -> list[Route]:
    """Lanes both ways; drivers slow down for the bend."""
    routes = []
    for side in (-1, 1):
        for k in range(lanes):
            y = side * (k + 0.5) * lane_m
            points = resampled(offset(center, y) if side < 0 else offset(center, y)[::-1])
            # Both ends beyond the reach of a route are cut, as on straight roads.
            middle = int(np.linalg.norm(points, axis=1).argmin())
            steps = int(REACH_M / 0.5)
            points = points[max(0, middle - steps) : middle + steps + 1]
            at, reach = 0.5 * min(middle, steps), 0.5 * bend * (radius - y)
            turn = min(speed, float(np.sqrt(_COMFORT_MPS2 * (radius - y))))
            routes.append(Route(points, -1, np.inf, speed, turn, (at - reach, at + reach)))
    return routes


def _plots(kerbs: tuple[Array, ...], back: float, rng: np.random.Generator) -> list[Plot]:
    """Building land on a grid, wherever it is behind the sidewalks but not far from the road."""
    near = np.concatenate([line[::4] for line in kerbs])
    plots = []
    shift = rng.uniform(-8, 8, 2)
    for x in np.arange(-112.0, 112.0, 20.0) + shift[0]:
        for y in np.arange(-84.0, 100.0, 20.0) + shift[1]:
            low, high = np.array([x, y]), np.array([x + 15.0, y + 15.0])
            away = np.linalg.norm(near - np.clip(near, low, high), axis=1).min()
            if back < away < back + 22 and not np.any(np.all((near > low) & (near < high), axis=1)):
                plots.append(Plot((float(low[0]), float(low[1])), (float(high[0]), float(high[1]))))
    return plots


def _poles(center: Array, half: float, rng: np.random.Generator) -> tuple[tuple[Array, Array], ...]:
    """One pole outside and one inside the bend, one before and one after it; all look into the bend or along a leg."""
    middle = len(center) // 2
    poles = []
    for at, side, look in ((0, -1, 14.0), (-38, 1, 30.0), (38, -1, -30.0), (8, 1, -22.0)):
        here = middle + int(2 * (at + rng.uniform(-6, 6)))
        line = offset(center, side * (half + rng.uniform(0.8, 2.2)))
        target = center[int(np.clip(here + 2 * look, 0, len(center) - 1))] + rng.uniform(-3, 3, 2)
        poles.append((line[here], target))
    return tuple(poles)


def _mend(ground: MeshBuilder, center: Array, edge: float, style: Style, rng: np.random.Generator) -> None:
    """Mended patches and tar lines along the road."""
    for _ in range(int(rng.integers(2, 12))):
        start = int(rng.integers(len(center) // 2 - 120, len(center) // 2 + 120))
        stretch = center[start : start + int(rng.integers(4, 40))]
        y, width = rng.uniform(-edge + 1, edge - 1), float(rng.choice([0.07, rng.uniform(0.6, 2.0)]))
        shade = 0.5 if width < 0.1 else float(rng.uniform(0.72, 1.18))
        low, high = offset(stretch, y - width / 2), offset(stretch, y + width / 2)
        quads = np.stack([low[:-1], low[1:], high[1:], high[:-1]], 1)
        z = np.full((*quads.shape[:2], 1), 0.006 if width < 0.1 else 0.004)
        surface: Surface = style.asphalt.tinted(shade)
        ground.quads(np.concatenate([quads, z], -1), surface)
