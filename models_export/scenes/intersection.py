"""Crossings with lights: the four-way intersection, and the T-junction, where one arm is missing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models_export.scenes.layout import (
    REACH_M,
    Bay,
    Kerbside,
    Plot,
    RoadWorld,
    Route,
    offset,
    plot,
    resampled,
    rounded,
    sample_kerbside,
    turned,
)
from models_export.scenes.mesh import Array, MeshBuilder, Surface
from models_export.scenes.pavement import (
    KERB_M,
    WHITE,
    Style,
    arrow,
    crosswalk,
    dashes,
    lay_asphalt,
    lay_block,
    lay_wear,
    paint,
    sample_style,
)

_QUARTERS = ((1, 1), (-1, 1), (-1, -1), (1, -1))
"""Signs of x and y of the four corners."""


@dataclass(frozen=True)
class _Plan:
    """Measures of one crossing; pairs are for the road along x, then the road along y."""

    arms: tuple[int, ...]
    """0 comes in from the east, 1 from the north, 2 from the west, 3 from the south."""
    style: Style
    lanes: tuple[int, int]
    """Lanes each way."""
    parking: tuple[Kerbside, Kerbside]
    corner_m: float
    """Radius of the kerbs at the corners."""
    crosswalks: bool

    def half(self, road: int) -> float:
        """Half the width of a road between its kerbs."""
        return self.lanes[road] * self.style.lane_m + self.parking[road].depth_m

    def stop(self, arm: int) -> float:
        """Distance of an arm's stop line from the centre."""
        return self.half(1 - arm % 2) + self.stop_gap

    @property
    def stop_gap(self) -> float:
        """From the crossing road's edge to a stop line."""
        return self.corner_m + (5.2 if self.crosswalks else 1.5)


def intersection(rng: np.random.Generator) -> RoadWorld:
    """A random four-way intersection, centred on the origin."""
    return _crossing("intersection", (0, 1, 2, 3), rng)


def t_junction(rng: np.random.Generator) -> RoadWorld:
    """A random T-junction: a road along x, and one that joins it from the north."""
    return _crossing("t-junction", (0, 1, 2), rng)


def _crossing(kind: str, arms: tuple[int, ...], rng: np.random.Generator) -> RoadWorld:
    plan = _Plan(
        arms,
        sample_style(rng),
        (int(rng.integers(1, 3)), int(rng.integers(1, 3))),
        (sample_kerbside(rng, 0.6), sample_kerbside(rng, 0.6)),
        float(rng.uniform(4.5, 8.0)),
        bool(rng.random() < 0.8),
    )
    ground = MeshBuilder()
    far, kerbs = REACH_M + 20, []
    for sx, sy in _QUARTERS:
        if sy > 0 or 3 in arms:
            kerbs.append(_corner_outline(plan, sx, sy))
            lay_block(ground, kerbs[-1], np.array([sx, sy]) * far, plan.style)
    if 3 not in arms:
        kerbs.append(np.array([[far, -plan.half(0)], [-far, -plan.half(0)]]))
        lay_block(ground, kerbs[-1], np.array([[far, -far], [-far, -far]]), plan.style)
    lay_asphalt(ground, plan.style)
    lay_wear(ground, plan.style, (plan.half(0), plan.half(1)) if 3 in arms else (plan.half(0), 0.0), rng)
    routes: list[Route] = []
    for arm in arms:
        _markings(ground, plan, arm, rng)
        routes += _routes(plan, arm, float(rng.uniform(9.0, 14.0)))
    bays = [bay for arm in arms for bay in _bays(plan, arm)]
    walks = tuple(offset(line, plan.style.walk_m * share) for line in kerbs for share in (0.35, 0.7))
    return RoadWorld(
        kind,
        ground,
        tuple(routes),
        tuple(bays),
        _plots(plan, rng),
        _poles(plan, rng),
        len(arms),
        (0.0, np.pi / 2),
        walks,
        KERB_M,
        tuple(kerbs),
    )


def _corner_outline(plan: _Plan, sx: int, sy: int) -> Array:
    """The kerb line of one corner, land on its left (N, 2)."""
    hx, hy, radius = plan.half(1), plan.half(0), plan.corner_m
    angle = np.linspace(0, np.pi / 2, 9)
    # From the y road's side to the x road's side; both ends then run on along the roads.
    arc = np.stack([hx + radius * (1 - np.cos(angle)), hy + radius * (1 - np.sin(angle))], 1)
    far = REACH_M + 20
    legs = np.array([[hx, far], [hx, hy + radius + 0.01]]), np.array([[hx + radius + 0.01, hy], [far, hy]])
    line: Array = np.concatenate([legs[0], arc[1:-1], legs[1]]) * np.array([sx, sy])
    return line if sx * sy > 0 else line[::-1]


def _markings(ground: MeshBuilder, plan: _Plan, arm: int, rng: np.random.Generator) -> None:
    """Lines, arrows and crosswalk of one arm."""
    R, lane, lanes, stop = turned(arm), plan.style.lane_m, plan.lanes[arm % 2], plan.stop(arm)
    _centre_line(ground, R, stop, rng)
    if rng.random() < 0.6:
        for k in range(lanes):
            arrow(ground, R, stop + 6, (k + 0.5) * lane)
    for side in (1, -1):
        for k in range(1, lanes):
            paint(ground, R, (stop, stop + 15), (side * k * lane - 0.06, side * k * lane + 0.06))
            dashes(ground, R, (stop + 18, REACH_M), side * k * lane, 2.0, 4.0)
        if plan.parking[arm % 2].parks:
            dashes(ground, R, (stop + 4, REACH_M), side * lanes * lane, 1.0, 1.0, 0.1)
    # Coming in along the arm means driving towards -x: the right-hand side is y > 0.
    paint(ground, R, (stop, stop + 0.45), (0.2, lanes * lane))
    if plan.crosswalks:
        near, width = plan.half(1 - arm % 2) + plan.corner_m + 0.6, plan.half(arm % 2)
        crosswalk(ground, R, near, width)


def _centre_line(ground: MeshBuilder, R: Array, stop: float, rng: np.random.Generator) -> None:
    color = Surface((0.78, 0.62, 0.18), fine=0.25, coarse=0.4) if rng.random() < 0.25 else WHITE
    worn = color.tinted(float(rng.uniform(0.8, 1.1)))
    if rng.random() < 0.5:
        paint(ground, R, (stop, REACH_M), (-0.19, -0.07), worn)
        paint(ground, R, (stop, REACH_M), (0.07, 0.19), worn)
    else:
        paint(ground, R, (stop, stop + 20), (-0.07, 0.07), worn)
        dashes(ground, R, (stop + 23, REACH_M), 0.0, 3.0, 4.5)


def _routes(plan: _Plan, arm: int, speed_mps: float) -> list[Route]:
    """Routes that come in along an arm: straight on, right from the outer lane, left from the inner one."""
    R, lane = turned(arm), plan.style.lane_m
    own, cross = plan.lanes[arm % 2], plan.lanes[1 - arm % 2]
    routes = []

    def add(way: Array, turn_mps: float, curve: tuple[float, float], longest_m: float = np.inf, free: bool = False) -> None:
        stop, group = REACH_M - plan.stop(arm) - 0.7, plan.arms.index(arm)
        routes.append(Route(resampled(way) @ R.T, group, stop, speed_mps, turn_mps, curve, longest_m, free))

    ahead, right, left = ((arm + k) % 4 in plan.arms for k in (2, 1, 3))
    for k in range(own):
        y = (k + 0.5) * lane
        if ahead:
            add(np.array([[REACH_M, y], [-REACH_M, y]]), speed_mps, (0.0, 0.0))
        if right and k == own - 1:
            x = (cross - 0.5) * lane
            way = rounded(np.array([[REACH_M, y], [x, y], [x, REACH_M]]), plan.corner_m + 0.5 * lane)
            add(way, 5.5, (REACH_M - x - 9, REACH_M - x + 9), 7.0, True)
        if left and k == 0:
            x = -0.5 * lane
            way = rounded(np.array([[REACH_M, y], [x, y], [x, -REACH_M]]), (0.5 + cross) * lane + 2.0)
            add(way, 7.5, (REACH_M - x - 14, REACH_M - x + 6), 8.5)
    return routes


def _bays(plan: _Plan, arm: int) -> list[Bay]:
    """Kerbside places along both sides of an arm."""
    kerbside, start = plan.parking[arm % 2], plan.stop(arm) + 5
    if not kerbside.parks:
        return []
    return kerbside.bays(np.arange(start, start + 48, kerbside.pitch_m), plan.half(arm % 2), turned(arm))


def _plots(plan: _Plan, rng: np.random.Generator) -> tuple[Plot, ...]:
    """Building land: along both roads in each of the four quarters."""
    back = plan.style.walk_m + float(rng.uniform(2.0, 6.0))
    hx, hy = plan.half(1) + back, plan.half(0) + back
    plots = []
    for sx, sy in _QUARTERS:
        closed = sy < 0 and 3 not in plan.arms
        for start in np.arange(0.0, 80.0, 20.0):
            plots.append(plot(sx, sy, (hx + 5 + start, hy), (hx + 23 + start, hy + 16)))
            if start > 0 and not closed:
                plots.append(plot(sx, sy, (hx, hy + 5 + start), (hx + 16, hy + 23 + start)))
    if 3 not in plan.arms:
        plots.append(plot(1, -1, (-hx, hy), (hx, hy + 16)))
    return tuple(plots)


def _poles(plan: _Plan, rng: np.random.Generator) -> tuple[tuple[Array, Array], ...]:
    """Four poles behind the kerbs; each looks across the crossing, so that every arm has two cameras."""
    at_corner = rng.random() < 0.7
    poles = []
    for quarter in _QUARTERS:
        along = rng.uniform(0.0, 4.0) if at_corner else rng.uniform(6.0, 14.0)
        beside, road = rng.uniform(0.7, 1.6), int(rng.integers(2))
        if along < 1:
            foot = np.array([plan.half(1), plan.half(0)]) + 0.55 * plan.corner_m + 0.8
        else:
            foot = np.array([plan.half(1) + beside, plan.half(0) + beside])
            foot[road] += plan.corner_m + along - beside
        poles.append((foot * np.array(quarter), rng.uniform(-6.0, 6.0, 2)))
    return tuple(poles)
