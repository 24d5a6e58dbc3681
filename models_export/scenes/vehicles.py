"""Procedural cars: six body shapes, sizes sampled per vehicle, one mesh each whose extents are the label's box.

A car's frame: x forward, y left, z up, origin at the centre of its box.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models_export.scenes.mesh import Array, Mesh, MeshBuilder, Surface


@dataclass(frozen=True)
class Shape:
    """Proportions of a body style. Places along the car are fractions of its length from the front bumper."""

    name: str
    share: float
    """How common it is on the road."""
    length_m: tuple[float, float]
    width_m: tuple[float, float]
    height_m: tuple[float, float]
    cowl: float
    """Foot of the windscreen."""
    roof_front: float
    roof_rear: float
    tail: float
    """Foot of the rear window."""
    nose: float
    """Height of the hood's front edge, fraction of the height."""
    belt: float
    """Height of the window sills, fraction of the height."""
    deck: float
    """Height of the boot's edge, fraction of the height."""
    blind: bool = False
    """Whether the side behind the front doors is a closed panel (delivery van)."""


SHAPES = (
    Shape("sedan", 0.26, (4.3, 5.1), (1.74, 1.93), (1.40, 1.50), 0.29, 0.43, 0.70, 0.84, 0.47, 0.62, 0.66),
    Shape("hatchback", 0.27, (3.6, 4.4), (1.65, 1.83), (1.42, 1.56), 0.25, 0.40, 0.83, 0.945, 0.49, 0.61, 0.64),
    Shape("wagon", 0.16, (4.4, 5.0), (1.75, 1.92), (1.42, 1.55), 0.27, 0.40, 0.88, 0.965, 0.47, 0.61, 0.63),
    Shape("suv", 0.22, (4.1, 5.0), (1.78, 2.00), (1.58, 1.88), 0.26, 0.38, 0.85, 0.96, 0.53, 0.61, 0.63),
    Shape("delivery", 0.05, (4.3, 5.2), (1.75, 2.00), (1.78, 1.95), 0.18, 0.33, 0.96, 0.985, 0.45, 0.56, 0.56, blind=True),
    Shape("van", 0.08, (4.3, 5.2), (1.78, 2.00), (1.76, 1.95), 0.17, 0.33, 0.95, 0.985, 0.45, 0.56, 0.56),
)

PAINTS: tuple[tuple[tuple[float, float, float], float], ...] = (
    ((0.90, 0.90, 0.89), 0.22),
    ((0.10, 0.10, 0.11), 0.18),
    ((0.42, 0.43, 0.45), 0.17),
    ((0.68, 0.69, 0.71), 0.13),
    ((0.13, 0.22, 0.42), 0.09),
    ((0.55, 0.08, 0.09), 0.07),
    ((0.22, 0.38, 0.62), 0.04),
    ((0.16, 0.27, 0.20), 0.03),
    ((0.45, 0.36, 0.28), 0.03),
    ((0.86, 0.62, 0.12), 0.02),
    ((0.80, 0.34, 0.10), 0.02),
)
"""Car colours (display RGB) and how common they are."""


@dataclass(frozen=True, eq=False)
class VehicleModel:
    """A vehicle's looks: its exact box and its mesh in the car's frame."""

    shape: str
    dims_lwh: Array
    """(3,) metres."""
    mesh: Mesh


def sample_vehicle(rng: np.random.Generator, *, lamps_on: bool = False) -> VehicleModel:
    """A random car. ``lamps_on`` lights its head and tail lamps."""
    shape = SHAPES[rng.choice(len(SHAPES), p=np.array([s.share for s in SHAPES]) / sum(s.share for s in SHAPES))]
    # Long cars of a kind are also wide; height varies more freely.
    size = rng.beta(2, 2)
    wide, high = np.clip(size + rng.normal(0, 0.15), 0, 1), np.clip(0.5 * size + 0.5 * rng.random(), 0, 1)
    dims = np.array(
        [
            low + t * (top - low)
            for (low, top), t in zip((shape.length_m, shape.width_m, shape.height_m), (size, wide, high), strict=True)
        ]
    )
    rgb, _ = PAINTS[rng.choice(len(PAINTS), p=np.array([p for _, p in PAINTS]) / sum(p for _, p in PAINTS))]
    r, g, b = np.clip(np.array(rgb) * rng.uniform(0.85, 1.12) + rng.normal(0, 0.015, 3), 0.02, 0.97)
    paint = Surface((float(r), float(g), float(b)), gloss=float(rng.uniform(0.45, 0.9)))
    jitter = rng.normal(0, 1, 4)
    mesh = build_car(shape, dims, paint, jitter, lamps_on=lamps_on, rim_light=float(rng.uniform(0.35, 0.75)))
    return VehicleModel(shape.name, dims, mesh)


_TRIM = Surface((0.09, 0.09, 0.10), gloss=0.25)
_TYRE = Surface((0.07, 0.07, 0.075))
_ARCH = Surface((0.03, 0.03, 0.035))
_GLASS = Surface((0.06, 0.075, 0.085), gloss=1.0, glass=1.0)
_PLATE = Surface((0.88, 0.88, 0.84))


def build_car(shape: Shape, dims: Array, paint: Surface, jitter: Array, *, lamps_on: bool, rim_light: float) -> Mesh:
    """The mesh of one car with extents exactly ``dims`` (length, width, height).

    jitter: (4,) standard normal numbers that move windscreen, rear window, belt line and nose a little.
    """
    length, width, height = dims
    builder = MeshBuilder()
    belt = (shape.belt + 0.008 * jitter[2]) * height
    nose = (shape.nose + 0.012 * jitter[3]) * height
    cowl, tail = shape.cowl + 0.008 * jitter[0], shape.tail + 0.004 * jitter[1]
    body = _Body(length, width, height, cowl, tail, nose, belt, shape.deck * height)
    _lower_body(builder, body, paint, lamps_on)
    _greenhouse(builder, body, shape, paint)
    for along in (0.175, 0.80):
        for side in (1, -1):
            _wheel(builder, body, length * (0.5 - along), side, rim_light)
    _mirrors(builder, body, paint)
    return builder.build(crease_rad=0.62).fitted(dims)


@dataclass(frozen=True)
class _Body:
    """Measures of one car in metres; ``cowl`` and ``tail`` are fractions of the length from the front."""

    length: float
    width: float
    height: float
    cowl: float
    tail: float
    nose: float
    belt: float
    deck: float

    @property
    def wheel_radius(self) -> float:
        return 0.155 * self.height + 0.095

    def x(self, fraction: float) -> float:
        return self.length * (0.5 - fraction)

    def top(self, fraction: float) -> float:
        """Height of the lower body's upper edge: hood, window sill, boot."""
        places = [0.0, 0.04, self.cowl, 0.5, max(self.tail, 0.6), 0.985, 1.0]
        heights = [0.93 * self.nose, self.nose, 0.985 * self.belt, self.belt, self.belt * 1.01, self.deck, 0.95 * self.deck]
        return float(np.interp(fraction, places, heights))

    def half_width(self, fraction: float) -> float:
        places = [0.0, 0.03, 0.10, 0.22, 0.8, 0.92, 0.98, 1.0]
        return 0.5 * self.width * float(np.interp(fraction, places, [0.74, 0.90, 0.975, 1.0, 1.0, 0.975, 0.92, 0.80]))


_STATIONS = (0.0, 0.03, 0.10, 0.22, 0.36, 0.5, 0.65, 0.8, 0.92, 0.98, 1.0)
_LEVELS = (0.0, 0.22, 0.55, 0.80, 1.0)
"""Heights of the rings' points between sill and upper edge: sill, bumper, lamps, shoulder, edge."""
_LEVEL_WIDTH = (0.93, 0.965, 0.985, 1.0, 0.945)


def _lower_body(builder: MeshBuilder, body: _Body, paint: Surface, lamps_on: bool) -> None:
    sill = 0.13 * body.height
    rings = np.array([_ring(body, station, sill) for station in _STATIONS])
    head = Surface((0.92, 0.93, 0.95), gloss=0.6, glow=0.9 if lamps_on else 0.12)
    tail = Surface((0.72, 0.05, 0.05), gloss=0.3, glow=0.45 if lamps_on else 0.1)
    mirrored = rings * np.array([1.0, -1.0, 1.0])
    last = len(_STATIONS) - 2
    for i in range(len(_STATIONS) - 1):
        for j in range(len(_LEVELS) - 1):
            lamp = {0: head, last: tail}.get(i) if j == 2 else None
            surface = lamp or (_TRIM if j == 0 else paint)
            a, b, c, d = rings[i, j], rings[i + 1, j], rings[i + 1, j + 1], rings[i, j + 1]
            builder.quads([a, b, c, d], surface)
            a, b, c, d = (p * np.array([1.0, -1.0, 1.0]) for p in (a, b, c, d))
            builder.quads([b, a, d, c], surface)
        middle = 0.5 * (rings[i, -1] + mirrored[i, -1]), 0.5 * (rings[i + 1, -1] + mirrored[i + 1, -1])
        front, back = (m + np.array([0.0, 0.0, 0.018 * body.height]) for m in middle)
        builder.quads([rings[i, -1], rings[i + 1, -1], back, front], paint)
        builder.quads([front, back, mirrored[i + 1, -1], mirrored[i, -1]], paint)
        builder.quads([rings[i, 0], mirrored[i, 0], mirrored[i + 1, 0], rings[i + 1, 0]], _ARCH)
    _end_face(builder, rings[0], paint, head, front=True)
    _end_face(builder, rings[-1], paint, tail, front=False)


def _ring(body: _Body, station: float, sill: float) -> Array:
    top, half = body.top(station), body.half_width(station)
    lift = 0.05 * body.height if station in (0.0, 1.0) else 0.0
    bottom = sill + lift
    bulge = {0.0: (-0.03, 0.0, 0.0, -0.02, -0.05), 1.0: (0.02, 0.0, 0.01, 0.02, 0.04)}.get(station, (0.0,) * 5)
    rows = zip(_LEVELS, _LEVEL_WIDTH, bulge, strict=True)
    return np.array([[body.x(station) + dx, half * w, bottom + level * (top - bottom)] for level, w, dx in rows])


def _end_face(builder: MeshBuilder, ring: Array, paint: Surface, lamp: Surface, *, front: bool) -> None:
    """Close the body in front or behind: lamps outside, grille or boot between them, a number plate."""
    bands = ((-1.0, -0.58), (-0.58, 0.58), (0.58, 1.0))
    sign = 1.0 if front else -1.0
    for j in range(len(_LEVELS) - 1):
        for k, (left, right) in enumerate(bands):
            inner = _TRIM if front else paint
            surface = (_TRIM, paint, inner if k == 1 else lamp, paint)[j]
            corners = np.array([ring[j], ring[j], ring[j + 1], ring[j + 1]])
            corners[:, 1] *= np.array([left, right, right, left]) * sign
            builder.quads(corners, surface)
    x = ring[:, 0].max() if front else ring[:, 0].min()
    z = ring[1, 2] + (0.05 if front else 0.55) * (ring[2, 2] - ring[1, 2])
    y = 0.26 * sign
    plate = [[x + 0.012 * sign, s * y, z + dz] for s, dz in ((-1, -0.06), (1, -0.06), (1, 0.06), (-1, 0.06))]
    builder.quads(plate, _PLATE)


def _greenhouse(builder: MeshBuilder, body: _Body, shape: Shape, paint: Surface) -> None:
    """Windows, pillars and roof: a frustum over the sills with a crowned roof."""
    roof_x = np.array([body.x(shape.roof_front), body.x(shape.roof_rear)])
    base_x = np.array([body.x(body.cowl), body.x(body.tail)])
    eave = 0.945 * body.height
    low_half, high_half = 0.94 * 0.5 * body.width, (0.86 if shape.name in ("van", "delivery") else 0.76) * 0.5 * body.width
    base = np.array([[x, low_half, body.top(f) - 0.01] for x, f in zip(base_x, (body.cowl, body.tail), strict=True)])
    top = np.array([[x, high_half, eave] for x in roof_x])
    flip = np.array([1.0, -1.0, 1.0])
    front = np.array([base[0] * flip, base[0], top[0], top[0] * flip])
    rear = np.array([base[1], base[1] * flip, top[1] * flip, top[1]])
    left = np.array([base[0], base[1], top[1], top[0]])
    right = (left * flip)[[1, 0, 3, 2]]
    for face in (front, rear, left, right):
        builder.quads(face, paint)
    _pane(builder, front, (0.05, 0.95), (0.04, 0.93))
    if not shape.blind:
        _pane(builder, rear, (0.10, 0.90), (0.22 if shape.name in ("van", "suv") else 0.12, 0.88))
    # Faces run from cowl to tail on the left, from tail to cowl on the right.
    for start, stop in ((0.09, 0.30), (0.33, 0.58), (0.61, 0.90))[: 1 if shape.blind else 3]:
        _pane(builder, left, (start, stop), (0.08, 0.90))
        _pane(builder, right, (1 - stop, 1 - start), (0.08, 0.90))
    _roof(builder, top, body.height, paint)


def _pane(builder: MeshBuilder, face: Array, across: tuple[float, float], up: tuple[float, float]) -> None:
    """A window on a quadrilateral face (4, 3): bottom edge first, given by fractions across and up; a few mm proud."""
    normal = np.cross(face[1] - face[0], face[3] - face[0])
    lift = 0.006 * normal / np.linalg.norm(normal)

    def point(u: float, v: float) -> Array:
        bottom, top = face[0] + u * (face[1] - face[0]), face[3] + u * (face[2] - face[3])
        return np.asarray(bottom + v * (top - bottom) + lift)

    corners = [point(across[0], up[0]), point(across[1], up[0]), point(across[1], up[1]), point(across[0], up[1])]
    builder.quads(corners, _GLASS)


def _roof(builder: MeshBuilder, top: Array, height: float, paint: Surface) -> None:
    ends = top[:, 0]
    x = np.interp([0.0, 0.12, 0.4, 0.7, 0.92, 1.0], [0, 1], ends)
    crown = np.interp([0.0, 0.12, 0.4, 0.7, 0.92, 1.0], [0, 0.12, 0.4, 0.75, 1.0], [0.0, 0.6, 1.0, 0.9, 0.0])
    across = np.array([1.0, 0.8, 0.0, -0.8, -1.0])
    bulge = np.array([0.0, 0.7, 1.0, 0.7, 0.0])
    z = top[0, 2] + (height - top[0, 2]) * crown[:, None] * bulge
    grid = np.stack(np.broadcast_arrays(x[:, None], top[0, 1] * across, z), -1)
    builder.quads(np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], 2).reshape(-1, 4, 3), paint)


def _wheel(builder: MeshBuilder, body: _Body, x: float, side: int, rim_light: float) -> None:
    """A wheel, and the dark half disc of its arch just outside the body's side."""
    radius, outer = body.wheel_radius, 0.5 * body.width * 0.995
    angle = np.linspace(0, 2 * np.pi, 15)[:-1]
    circle = np.stack([np.cos(angle), np.sin(angle)], 1)
    arch_angle = np.linspace(-0.25, np.pi + 0.25, 10)
    arch = 1.17 * radius * np.stack([np.cos(arch_angle), np.sin(arch_angle)], 1)

    def disc(points: Array, y: float) -> Array:
        ring = np.column_stack([x + points[:, 0], np.full(len(points), side * y), radius + points[:, 1]])
        return ring[::-1] if side > 0 else ring

    builder.fan(disc(arch, outer - 0.012), _ARCH)
    builder.fan(disc(radius * circle, outer), _TYRE)
    builder.fan(disc(0.66 * radius * circle, outer + 0.003), Surface((rim_light, rim_light, rim_light * 1.02), gloss=0.5))
    builder.fan(disc(0.22 * radius * circle, outer + 0.005), _TRIM)
    near, far = disc(radius * circle, outer), disc(radius * circle, outer - 0.21)
    builder.strip(far, near, _TYRE, closed=True)


def _mirrors(builder: MeshBuilder, body: _Body, paint: Surface) -> None:
    x, z = body.x(body.cowl + 0.085), body.belt + 0.02
    inner, outer = 0.46 * body.width, 0.4995 * body.width
    for low, high in ((inner, outer), (-outer, -inner)):
        builder.box([x - 0.05, low, z], [x + 0.09, high, z + 0.13], paint)
