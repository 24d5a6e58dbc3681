"""The straight road: one to three lanes a side, with or without parking."""

from __future__ import annotations

import numpy as np

from models_export.scenes.layout import REACH_M, Bay, RoadWorld, Route, plot, resampled
from models_export.scenes.mesh import Array, MeshBuilder
from models_export.scenes.pavement import KERB_M, Style, dashes, lay_asphalt, lay_block, lay_wear, paint, sample_style


def straight(rng: np.random.Generator) -> RoadWorld:
    """A random straight road along x."""
    style = sample_style(rng)
    lanes = int(rng.choice([1, 2, 3], p=[0.3, 0.45, 0.25]))
    parking = bool(rng.random() < 0.55)
    edge = lanes * style.lane_m
    half = edge + (2.3 if parking else 0.4)
    far = REACH_M + 20
    ground = MeshBuilder()
    for side in (1, -1):
        line = np.array([[-far, half], [far, half]]) if side > 0 else np.array([[far, -half], [-far, -half]])
        _block_strip(ground, line, style)
    lay_asphalt(ground, style)
    lay_wear(ground, style, (half, 0.0), rng)
    eye = np.eye(2)
    if rng.random() < 0.5:
        for y in (-0.13, 0.13):
            paint(ground, eye, (-far, far), (y - 0.06, y + 0.06))
    else:
        dashes(ground, eye, (-far, far), 0.0, 3.0, 6.0)
    for side in (1, -1):
        for k in range(1, lanes):
            dashes(ground, eye, (-far, far), side * k * style.lane_m, 3.0, 6.0)
        paint(ground, eye, (-far, far), (side * edge - 0.06, side * edge + 0.06))
    routes = _straight_routes(lanes, style, rng)
    bays = [
        Bay(float(x), s * (half - 1.12), 0.0 if s < 0 else np.pi) for x in np.arange(-54, 55, 6.2) for s in (1, -1) if parking
    ]
    set_back = half + style.walk_m + float(rng.uniform(2.5, 9))
    plots = [plot(1, s, (x, set_back), (x + 20, set_back + 16)) for x in np.arange(-110.0, 110.0, 22.0) for s in (1, -1)]
    return RoadWorld("straight", ground, tuple(routes), tuple(bays), tuple(plots), _roadside_poles(half, rng), 0)


def _block_strip(ground: MeshBuilder, line: Array, style: Style) -> None:
    """Land along a straight kerb line (2, 2), on its left."""
    walk_in = lay_block(ground, line, np.array([0.0, np.sign(line[0, 1]) * (REACH_M + 20)]), style)
    outer = walk_in * np.array([1.0, 0.0]) + [0, np.sign(line[0, 1]) * (REACH_M + 20)]
    corners = np.column_stack([np.stack([walk_in[0], walk_in[1], outer[1], outer[0]]), np.full(4, KERB_M)])
    ground.quads(corners, style.verge)


def _straight_routes(lanes: int, style: Style, rng: np.random.Generator) -> list[Route]:
    routes = []
    speed = float(rng.uniform(9.0, 17.0))
    for side in (1, -1):
        for k in range(lanes):
            y = side * (k + 0.5) * style.lane_m
            way = np.array([[REACH_M * side, y], [-REACH_M * side, y]])
            routes.append(Route(resampled(way), -1, np.inf, speed * (1.08 - 0.06 * k), speed, (0.0, 0.0)))
    return routes


def _roadside_poles(half: float, rng: np.random.Generator) -> tuple[tuple[Array, Array], ...]:
    """Two poles look along the road one way, two the other way, on both sides."""
    poles = []
    first = 1 if rng.random() < 0.5 else -1
    for x, look, side in ((26, -1, 1), (9, -1, -1), (-26, 1, -1), (-9, 1, 1)):
        foot = np.array([x + rng.uniform(-5, 5), first * side * (half + rng.uniform(0.7, 2.0))])
        poles.append((foot, foot + np.array([look * rng.uniform(18, 30), -foot[1] + rng.uniform(-4, 4)])))
    return tuple(poles)
