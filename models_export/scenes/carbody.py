"""Bodies of cars, pickups and vans: one smooth skin with cut-out wheel arches, a greenhouse of glass, lamps and wheels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from models_export.scenes.loft import Codes, add_cap, add_floor, add_skin, curve, stations
from models_export.scenes.mesh import Array, Mesh, MeshBuilder, Surface
from models_export.scenes.parts import GLASS, HOLLOW, TRIM, add_mirrors, add_plate, add_wheel, head_lamp, tail_lamp


@dataclass(frozen=True)
class CarShape:
    """Proportions. Places along the car are fractions of its length from the front; heights fractions of its height."""

    cowl: float
    """Foot of the windscreen."""
    roof_front: float
    roof_rear: float
    tail: float
    """Foot of the rear window."""
    nose: float
    """Height of the bonnet's front edge."""
    belt: float
    """Height of the window sills."""
    deck: float
    """Height of the boot's edge, or of a pickup's bed walls."""
    roof_width: float
    """Width of the roof over the body's."""
    windows: tuple[tuple[float, float], ...]
    """Spans of the side windows."""
    axles: tuple[float, float] = (0.175, 0.80)
    blind: bool = False
    """No rear window (delivery van)."""
    bed: bool = False
    """An open bed behind the cabin (pickup)."""
    tall_lamps: bool = False
    """Tail lamps that run up the rear pillars."""


@dataclass(frozen=True)
class Look:
    """What varies between two vehicles of a shape and size."""

    paint: Surface
    lit: bool
    rim_light: float
    jitter: tuple[float, float, float, float]
    """Standard normal numbers that move windscreen, rear window, belt line and nose a little."""


_LOW = np.array([0.0, 0.14, 0.32, 0.52, 0.72, 0.88, 1.0])
_LOW_WIDTH = np.array([0.93, 0.965, 0.99, 1.0, 0.992, 0.97, 0.935])
_UP = np.array([0.08, 0.36, 0.66, 0.92, 1.0])
_ROOF = np.array([0.93, 0.70, 0.36, 0.0])
_LAMP_ROWS = (3, 4)
_PAINT, _TRIM, _GLASS, _HEAD, _TAIL, _DARK = range(6)
_ARCH = np.array([-1.03, -1.0, -0.9, -0.66, -0.34, 0.0, 0.34, 0.66, 0.9, 1.0, 1.03])
_plan = curve(
    [
        *((0, 0.70), (0.012, 0.80), (0.035, 0.89), (0.08, 0.955), (0.18, 0.992), (0.3, 1), (0.76, 1)),
        *((0.88, 0.98), (0.945, 0.94), (0.98, 0.885), (1, 0.78)),
    ]
)


def build_car(shape: CarShape, dims: Array, look: Look) -> Mesh:
    """A mesh with extents exactly ``dims`` (length, width, height), metres."""
    body = _CarBody(shape, *(float(d) for d in dims), look.jitter)
    builder = MeshBuilder()
    palette = (look.paint, TRIM, GLASS, head_lamp(look.lit), tail_lamp(look.lit), HOLLOW)
    rings = body.rings()
    add_skin(builder, rings, body.codes(), palette)
    add_floor(builder, rings, HOLLOW)
    for end, front in ((0, True), (-1, False)):
        lamp = palette[_HEAD if front else _TAIL]

        def surface_of(row: int, band: int, lamp: Surface = lamp, front: bool = front) -> Surface:
            if row == 0:
                return TRIM
            if row in _LAMP_ROWS and band != 1:
                return lamp
            return TRIM if front and row in (1, 3) else look.paint

        add_cap(builder, rings[end], surface_of, front=front)
        x = rings[end, :, 0].max() if front else rings[end, :, 0].min()
        add_plate(builder, float(x), float(rings[end, 2 if front else 3, 2]) + 0.02, front=front)
    for axle in shape.axles:
        for side in (1, -1):
            add_wheel(builder, body.x(axle), side, 0.487 * body.width, body.wheel_radius, 0.21, look.rim_light)
    add_mirrors(builder, body.x(body.cowl + 0.085), float(body.belt_line(body.cowl)) + 0.03, body.width, look.paint)
    return builder.build(crease_rad=0.7).fitted(dims)


def car_lamps(dims: Array, shape: CarShape) -> tuple[Array, Array]:
    """Positions (2, 3) of head and tail lamps in the car's frame."""
    length, width, height = dims
    head = np.array([[0.493 * length, s * 0.36 * width, (0.66 * shape.nose - 0.5) * height] for s in (1, -1)])
    tail = np.array([[-0.495 * length, s * 0.38 * width, (0.75 * shape.deck - 0.5) * height] for s in (1, -1)])
    return head, tail


class _CarBody:
    """Measures of one car: lines along it as functions of the fraction of the length from the front."""

    def __init__(
        self, shape: CarShape, length: float, width: float, height: float, jitter: tuple[float, float, float, float]
    ) -> None:
        self.shape, self.length, self.width, self.height = shape, length, width, height
        self.cowl, self.tail = shape.cowl + 0.008 * jitter[0], min(shape.tail + 0.003 * jitter[1], 0.984)
        self.nose, self.belt = (shape.nose + 0.012 * jitter[3]) * height, (shape.belt + 0.008 * jitter[2]) * height
        deck = shape.deck * height
        rear = (min(self.tail + 0.03, 0.985), deck)
        self.belt_line = curve(
            [
                *((0, 0.80 * self.nose), (0.02, 0.92 * self.nose), (0.07, self.nose), (self.cowl, 0.975 * self.belt)),
                *((0.5, self.belt), (min(self.tail, 0.95), 1.01 * self.belt), rear, (0.99, deck), (1, 0.94 * deck)),
            ]
        )
        self.top_line, self.edge_line = self._top(deck), self._edge_width()

    @property
    def wheel_radius(self) -> float:
        """Metres; high bodies have larger wheels, but not in proportion."""
        return 0.13 * min(self.height, 1.9) + 0.125

    def x(self, fraction: float) -> float:
        """Metres ahead of the middle."""
        return self.length * (0.5 - fraction)

    @cached_property
    def places(self) -> Array:
        """Fractions of the length at which sections are taken."""
        s = self.shape
        arch = 1.13 * self.wheel_radius / self.length
        glass = [p for span in s.windows for p in span]
        screens = [self.cowl, self.cowl + 0.012, s.roof_front - 0.012, s.roof_front, s.roof_rear]
        back = [s.roof_rear + 0.01, self.tail - 0.008, self.tail]
        roof = np.linspace(s.roof_front, s.roof_rear, 5)
        ends = [0, 0.006, 0.02, 0.045, 0.08, 0.12, 0.5, 0.6, 0.9, 0.945, 0.97, 0.99, 1]
        return stations(ends, screens, back, roof, glass, s.axles[0] + arch * _ARCH, s.axles[1] + arch * _ARCH)

    def _top(self, deck: float) -> PchipInterpolator:
        """Height of the skin in the middle: bonnet, windscreen, roof, rear window, boot."""
        s, h = self.shape, self.height
        crown = 0.022 * h
        middle = 0.5 * (s.roof_front + s.roof_rear)
        points = [(0.0, 0.80 * self.nose + 0.2 * crown), (0.02, 0.92 * self.nose + crown), (0.07, self.nose + crown)]
        points += [(self.cowl, 0.975 * self.belt + crown), (s.roof_front, 0.965 * h), (middle, h), (s.roof_rear, 0.968 * h)]
        after = 0.62 * deck if s.bed else deck + crown
        points += [(self.tail, after), (0.5 * (self.tail + 0.99), after), (0.99, after), (1.0, 0.94 * deck + 0.2 * crown)]
        places, heights = np.array(points).T
        return PchipInterpolator(places, heights)

    def _edge_width(self) -> PchipInterpolator:
        """Half the width of the roof, of the bonnet's flat part and of the boot's, over half the body's."""
        s = self.shape
        back = 0.90 if s.bed else 0.84
        points = [(0, 0.86), (self.cowl, 0.84), (s.roof_front, s.roof_width), (s.roof_rear, s.roof_width), (self.tail, back)]
        places, widths = np.array([*points, (1.001, back)]).T
        return PchipInterpolator(places, widths)

    def rings(self) -> Array:
        """Left half sections (S, R, 3)."""
        f = self.places
        x = self.length * (0.5 - f)
        half = 0.5 * self.width * _plan(f)
        low, belt = self._bottom(x, f), self.belt_line(f)
        top = self.top_line(f)
        # The bonnet's and the roof's edges lie a little below their middle.
        edge = belt + 0.93 * (top - belt)
        edge_half = half * self.edge_line(f)
        y_low = half[:, None] * _LOW_WIDTH
        z_low = low[:, None] + _LOW * (belt - low)[:, None]
        y_up = y_low[:, -1:] + _UP * (edge_half - y_low[:, -1])[:, None]
        z_up = belt[:, None] + _UP * (edge - belt)[:, None]
        y_roof = edge_half[:, None] * _ROOF
        z_roof = edge[:, None] + (top - edge)[:, None] * (1 - _ROOF**2)
        y, z = np.hstack([y_low, y_up, y_roof]), np.hstack([z_low, z_up, z_roof])
        # Bumpers and bonnet lean back above.
        lean = np.where(f[:, None] < 0.02, -0.035, np.where(f[:, None] > 0.985, 0.03, 0.0)) * np.clip(
            z / self.height - 0.25, 0, 1
        )
        return np.stack([x[:, None] + lean * self.length * 0.6, y, z], -1)

    def _bottom(self, x: Array, f: Array) -> Array:
        """Height of the lower edge: the sill, lifted at the bumpers and cut round the wheels."""
        sill = np.maximum(0.125 * self.height, 0.17)
        low = sill + curve([(0, 0.05), (0.06, 0.0), (0.92, 0.0), (1, 0.06)])(f) * self.height
        radius = 1.13 * self.wheel_radius
        for axle in self.shape.axles:
            away = np.abs(x - self.x(axle))
            arch = self.wheel_radius + np.sqrt(np.maximum(radius**2 - away**2, 0.0))
            low = np.where(away < radius * 1.005, np.maximum(low, arch), low)
        return np.asarray(low)

    def codes(self) -> Codes:
        """What each cell of the skin is made of, indices into the palette of :func:`build_car`."""
        s = self.shape
        f = 0.5 * (self.places[1:] + self.places[:-1])
        first_up, first_roof = len(_LOW), len(_LOW) + len(_UP)
        codes = np.full((len(f), first_roof + len(_ROOF) - 1), _PAINT, dtype=np.int64)
        codes[:, 0] = _TRIM
        for row in _LAMP_ROWS:
            codes[f < 0.045, row] = _HEAD
            codes[f > 0.97, row] = _TAIL
        if s.tall_lamps:
            codes[f > 0.985, 3 : first_up + 2] = _TAIL
        side: NDArray[np.bool_] = np.zeros(len(f), dtype=bool)
        for start, stop in s.windows:
            side |= (f > start) & (f < stop)
        codes[np.ix_(side, range(first_up, first_roof - 2))] = _GLASS
        screen = (f > self.cowl + 0.01) & (f < s.roof_front - 0.010)
        codes[np.ix_(screen, range(first_roof, codes.shape[1]))] = _GLASS
        if not s.blind:
            rear = (f > s.roof_rear + 0.008) & (f < self.tail - 0.006)
            codes[np.ix_(rear, range(first_roof, codes.shape[1]))] = _GLASS
        if s.bed:
            codes[np.ix_((f > self.tail) & (f < 0.99), range(first_up + 1, codes.shape[1]))] = _DARK
        return codes
