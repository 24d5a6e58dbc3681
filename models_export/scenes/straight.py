"""The straight road: one to three lanes a side, with or without parking and a crosswalk with lights."""

from __future__ import annotations

import numpy as np

from models_export.scenes.layout import REACH_M, RoadWorld, Route, offset, plot, resampled, sample_kerbside
from models_export.scenes.mesh import Array, MeshBuilder
from models_export.scenes.pavement import (
    KERB_M,
    Style,
    crosswalk,
    dashes,
    lay_asphalt,
    lay_block,
    lay_wear,
    paint,
    sample_style,
)

_STOP_M = 4.5
"""Distance of a stop line from the middle of a crosswalk."""


def straight(rng: np.random.Generator) -> RoadWorld:
    """A random straight road along x."""
    style = sample_style(rng)
    lanes = int(rng.choice([1, 2, 3], p=[0.3, 0.45, 0.25]))
    kerbside = sample_kerbside(rng, 0.55)
    edge = lanes * style.lane_m
    half = edge + kerbside.depth_m
    far = REACH_M + 20
    ground = MeshBuilder()
    kerbs = (np.array([[-far, half], [far, half]]), np.array([[far, -half], [-far, -half]]))
    for line in kerbs:
        lay_block(ground, line, np.column_stack([line[:, 0], np.sign(line[:, 1]) * far]), style)
    lay_asphalt(ground, style)
    lay_wear(ground, style, (half, 0.0), rng)
    _markings(ground, lanes, style.lane_m, rng)
    eye = np.eye(2)
    lights = bool(rng.random() < 0.4)
    if lights:
        crosswalk(ground, eye, -1.6, half)
        for side in (1, -1):
            x = side * _STOP_M
            paint(ground, eye, (x - 0.22, x + 0.22), tuple(sorted((side * 0.2, side * edge))))
    places = np.arange(-54, 55, kerbside.pitch_m) if kerbside.parks else np.zeros(0)
    bays = kerbside.bays(places[np.abs(places) > 9] if lights else places, half, eye)
    set_back = half + style.walk_m + float(rng.uniform(2.5, 9))
    plots = [plot(1, s, (x, set_back), (x + 20, set_back + 16)) for x in np.arange(-110.0, 110.0, 22.0) for s in (1, -1)]
    return RoadWorld(
        "straight",
        ground,
        tuple(_straight_routes(lanes, style, lights, rng)),
        tuple(bays),
        tuple(plots),
        _roadside_poles(half, rng),
        2 if lights else 0,
        (0.0,),
        tuple(offset(line, style.walk_m * share) for line in kerbs for share in (0.35, 0.7)),
        KERB_M,
        kerbs,
    )


def _markings(ground: MeshBuilder, lanes: int, lane_m: float, rng: np.random.Generator) -> None:
    """Centre line, lane lines and edge lines."""
    eye = np.eye(2)
    if rng.random() < 0.5:
        for y in (-0.13, 0.13):
            paint(ground, eye, (-REACH_M - 20, REACH_M + 20), (y - 0.06, y + 0.06))
    else:
        dashes(ground, eye, (-REACH_M - 20, REACH_M + 20), 0.0, 3.0, 6.0)
    for side in (1, -1):
        for k in range(1, lanes):
            dashes(ground, eye, (-REACH_M - 20, REACH_M + 20), side * k * lane_m, 3.0, 6.0)
        paint(ground, eye, (-REACH_M - 20, REACH_M + 20), (side * lanes * lane_m - 0.06, side * lanes * lane_m + 0.06))


def _straight_routes(lanes: int, style: Style, lights: bool, rng: np.random.Generator) -> list[Route]:
    """Lanes both ways. With lights all of them are group 0, and group 1 is the people who cross."""
    routes = []
    speed = float(rng.uniform(9.0, 17.0))
    group, stop = (0, REACH_M - _STOP_M - 0.6) if lights else (-1, np.inf)
    for side in (1, -1):
        for k in range(lanes):
            y = side * (k + 0.5) * style.lane_m
            way = np.array([[REACH_M * side, y], [-REACH_M * side, y]])
            routes.append(Route(resampled(way), group, stop, speed * (1.08 - 0.06 * k), speed, (0.0, 0.0)))
    return routes


def _roadside_poles(half: float, rng: np.random.Generator) -> tuple[tuple[Array, Array], ...]:
    """Two poles look along the road one way, two the other way, on both sides."""
    poles = []
    first = 1 if rng.random() < 0.5 else -1
    for x, look, side in ((26, -1, 1), (9, -1, -1), (-26, 1, -1), (-9, 1, 1)):
        foot = np.array([x + rng.uniform(-5, 5), first * side * (half + rng.uniform(0.7, 2.0))])
        poles.append((foot, foot + np.array([look * rng.uniform(18, 30), -foot[1] + rng.uniform(-4, 4)])))
    return tuple(poles)
