"""The indoor garage: a hall with two aisles, rows of bays, columns, pipes and ceiling lamps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models_export.scenes.layout import REACH_M, Bay, RoadWorld, Route, resampled
from models_export.scenes.mesh import Array, MeshBuilder, Surface
from models_export.scenes.pavement import paint

_DOOR_M = 3.4
"""Half the width of a door."""


@dataclass(frozen=True)
class _Hall:
    """Measures of one garage, metres."""

    long: float
    """Half its length along x."""
    aisle: float
    """Half the width of an aisle."""
    depth: float
    """Depth of a bay."""
    bay: float
    """Width of a bay."""
    ceiling: float

    @property
    def wide(self) -> float:
        """Half its width along y."""
        return 2 * (self.depth + self.aisle)

    @property
    def lane(self) -> float:
        """Distance of each aisle's middle from the x axis."""
        return self.depth + self.aisle

    @property
    def end(self) -> float:
        """Where the rows of bays stop: beyond is the aisle across."""
        return self.long - 2 * self.aisle - 0.5


def garage(rng: np.random.Generator) -> RoadWorld:
    """A random hall, centred on the origin. One-way: in through one door, round or straight on, and out."""
    hall = _Hall(
        float(rng.uniform(27, 36)),
        float(rng.uniform(2.9, 3.4)),
        float(rng.uniform(5.0, 5.6)),
        float(rng.uniform(2.45, 2.75)),
        float(rng.uniform(3.3, 4.4)),
    )
    ground = MeshBuilder()
    grey = rng.uniform(0.38, 0.60)
    floor = Surface((grey, grey, grey * rng.uniform(0.93, 1.04)), gloss=float(rng.uniform(0.05, 0.5)), fine=0.15, coarse=0.4)
    wall_grey = rng.uniform(0.5, 0.8)
    wall = Surface((wall_grey, wall_grey, wall_grey * rng.uniform(0.92, 1.02)), fine=0.08, coarse=0.2)
    far = REACH_M + 20
    ground.quads([[-far, -far, 0], [far, -far, 0], [far, far, 0], [-far, far, 0]], floor)
    _shell(ground, hall, wall, rng)
    bays = _bays(ground, hall, rng)
    _columns(ground, hall, wall, rng)
    lamps = _ceiling(ground, hall, wall, rng)
    walk = hall.lane - hall.aisle + 0.55
    walks = tuple(np.array([[-hall.end, s * walk], [hall.end, s * walk]]) for s in (1, -1))
    return RoadWorld(
        "garage", ground, _routes(hall, rng), bays, (), _poles(hall, rng), 0, (0.0, np.pi / 2), walks, 0.0, (), lamps
    )


def _shell(ground: MeshBuilder, hall: _Hall, wall: Surface, rng: np.random.Generator) -> None:
    """Walls with doors where the aisles meet them, a coloured band at waist height, the ceiling."""
    band = Surface(tuple(rng.uniform(0.15, 0.85, 3).tolist()), coarse=0.2)
    x, y, top = hall.long, hall.wide, hall.ceiling
    spans = ((-y, -hall.lane - _DOOR_M), (-hall.lane + _DOOR_M, hall.lane - _DOOR_M), (hall.lane + _DOOR_M, y))
    for side in (1, -1):
        for z0, z1, surface in ((0.0, 0.9, wall.tinted(0.8)), (0.9, 1.25, band), (1.25, top, wall)):
            for a, b in spans:
                _upright(ground, (side * x, a), (side * x, b), z0, z1, surface)
            _upright(ground, (-x, side * y), (x, side * y), z0, z1, surface)
        for middle in (hall.lane, -hall.lane):
            _upright(ground, (side * x, middle - _DOOR_M), (side * x, middle + _DOOR_M), 2.7, top, wall)
            # Daylight or the next hall behind the door.
            light = Surface((0.62, 0.66, 0.70), glow=float(rng.uniform(0.0, 0.25)))
            _upright(ground, (side * (x + 30), middle - 14), (side * (x + 30), middle + 14), 0.0, 12.0, light)


def _upright(
    ground: MeshBuilder, a: tuple[float, float], b: tuple[float, float], z0: float, z1: float, surface: Surface
) -> None:
    """A wall between two points on the floor, seen from both sides."""
    front = np.array([[*a, z0], [*b, z0], [*b, z1], [*a, z1]])
    ground.quads(np.stack([front, front[::-1]]), surface)


def _bays(ground: MeshBuilder, hall: _Hall, rng: np.random.Generator) -> tuple[Bay, ...]:
    """Painted bays along both aisles; cars park nose in or nose out."""
    paint_color = Surface((0.82, 0.80, 0.72) if rng.random() < 0.6 else (0.80, 0.66, 0.20), fine=0.2, coarse=0.4)
    count = int(2 * hall.end / hall.bay)
    start = -0.5 * count * hall.bay
    eye, bays = np.eye(2), []
    for sign in (1, -1):
        for low, high in ((0.0, hall.depth), (hall.depth + 2 * hall.aisle, hall.wide)):
            a, b = sorted((sign * low, sign * high))
            for k in range(count + 1):
                x = start + k * hall.bay
                paint(ground, eye, (x - 0.05, x + 0.05), (a + 0.1, b - 0.1), paint_color)
            for k in range(count):
                heading = np.pi / 2 if rng.random() < 0.5 else -np.pi / 2
                bays.append(Bay(float(start + (k + 0.5) * hall.bay), 0.5 * (a + b), float(heading)))
    return tuple(bays)


def _columns(ground: MeshBuilder, hall: _Hall, wall: Surface, rng: np.random.Generator) -> None:
    """Columns between the bays, striped at bumper height."""
    stripe = Surface((0.80, 0.65, 0.12) if rng.random() < 0.6 else (0.70, 0.12, 0.10))
    count = int(2 * hall.end / hall.bay)
    start = -0.5 * count * hall.bay
    for k in range(0, count + 1, 3):
        x = start + k * hall.bay
        for y in (0.0, hall.depth - 0.6, -hall.depth + 0.6):
            ground.box([x - 0.2, y - 0.2, 0.0], [x + 0.2, y + 0.2, hall.ceiling], wall)
            ground.box([x - 0.21, y - 0.21, 0.35], [x + 0.21, y + 0.21, 1.2], stripe)


def _ceiling(ground: MeshBuilder, hall: _Hall, wall: Surface, rng: np.random.Generator) -> Array:
    """The ceiling with beams, pipes and rows of tubes; gives the lamps (N, 3)."""
    x, y, top = hall.long, hall.wide, hall.ceiling
    ground.quads([[-x, -y, top], [-x, y, top], [x, y, top], [x, -y, top]], wall.tinted(0.9))
    for place in np.arange(-hall.end, hall.end + 1, 3 * hall.bay):
        corners = np.array([[place - 0.2, -y, top - 0.35], [place - 0.2, y, top - 0.35], [place + 0.2, y, top - 0.35]])
        ground.quads([*corners, [place + 0.2, -y, top - 0.35]], wall.tinted(0.8))
        for edge in (-0.2, 0.2):
            _upright(ground, (place + edge, -y), (place + edge, y), top - 0.35, top, wall.tinted(0.75))
    pipe = Surface((0.55, 0.12, 0.10) if rng.random() < 0.5 else (0.6, 0.6, 0.6), gloss=0.2)
    for offset_y in (hall.lane + 1.2, -hall.lane - 1.2):
        ground.box([-x, offset_y - 0.08, top - 0.6], [x, offset_y + 0.08, top - 0.45], pipe)
        bottom = [[-x, offset_y - 0.08, top - 0.6], [-x, offset_y + 0.08, top - 0.6], [x, offset_y + 0.08, top - 0.6]]
        ground.quads([*bottom, [x, offset_y - 0.08, top - 0.6]], pipe)
    tube, lamps = Surface((0.95, 0.96, 1.0), glow=1.0), []
    gap = float(rng.uniform(5, 9))
    for row in (hall.lane, -hall.lane, 0.0):
        for place in np.arange(-hall.long + 3, hall.long - 2, gap):
            a, b, z = place - 0.7, place + 0.7, top - 0.42
            ground.quads([[a, row - 0.08, z], [a, row + 0.08, z], [b, row + 0.08, z], [b, row - 0.08, z]], tube)
            lamps.append([place, row, z])
    return np.array(lamps)


def _routes(hall: _Hall, rng: np.random.Generator) -> tuple[Route, ...]:
    """In through a western door, along the aisle; then out at the other end, or round the bays and back."""
    radius = 5.2
    arc = np.linspace(0, np.pi / 2, 16)[:, None]
    far = hall.long - hall.aisle - 0.6
    y = hall.lane
    turn = np.array([far - radius, y - radius]) + radius * np.hstack([np.sin(arc), np.cos(arc)])
    back = turn[::-1] * np.array([1.0, -1.0])
    around = np.concatenate([[[-REACH_M, y]], turn, back, [[-REACH_M, -y]]])
    through = np.array([[-REACH_M, y], [REACH_M, y]])
    side = 1.0 if rng.random() < 0.5 else -1.0
    flip, speed = np.array([1.0, side]), float(rng.uniform(3.5, 6.0))
    start = REACH_M + far - radius
    curve = (start - 1.0, start + 2 * radius * np.pi / 2 + 2 * (y - radius) + 1.0)
    return (
        Route(resampled(around * flip), -1, np.inf, speed, 3.2, curve, 6.0),
        Route(resampled(through * flip), -1, np.inf, speed, speed, (0.0, 0.0), 6.0),
    )


def _poles(hall: _Hall, rng: np.random.Generator) -> tuple[tuple[Array, Array], ...]:
    """Cameras under the ceiling: at both ends of the aisles and on columns."""
    x = hall.end - 1.0
    # Beside the pipes, over the edge of an aisle.
    y = hall.lane - hall.aisle + 0.3
    poles = []
    for sx, sy, reach in ((-1, 1, 22), (1, 1, 20), (1, -1, 22), (-1, -1, 20)):
        foot = np.array([sx * (x + rng.uniform(-3, 2)), sy * y])
        target = np.array([sx * (x - reach), sy * (hall.lane + rng.uniform(-2, 2))])
        poles.append((foot, target))
    return tuple(poles)
