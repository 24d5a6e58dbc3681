"""Box trucks and buses."""

from __future__ import annotations

import numpy as np

from models_export.scenes.carbody import Look
from models_export.scenes.loft import add_cap, add_floor, add_skin, curve, stations
from models_export.scenes.mesh import Array, Mesh, MeshBuilder, Surface
from models_export.scenes.parts import GLASS, HOLLOW, TRIM, add_mirrors, add_plate, add_wheel, head_lamp, tail_lamp

_ARCH = np.array([-1.03, -1.0, -0.9, -0.66, -0.34, 0.0, 0.34, 0.66, 0.9, 1.0, 1.03])
_BODY, _TRIM, _GLASS, _HEAD, _TAIL, _ACCENT = range(6)


def build_bus(dims: Array, look: Look, accent: Surface) -> Mesh:
    """A city bus with extents exactly ``dims`` (length, width, height), metres; ``accent`` paints its lower half."""
    length, width, height = (float(d) for d in dims)
    builder, radius = MeshBuilder(), 0.48
    axles = (2.6 / length, 1 - 3.3 / length)
    pillars = np.arange(0.06, 0.97, 1.45 / length)
    f, rings = _bus_rings(length, width, height, axles, pillars, radius)
    middle = 0.5 * (f[1:] + f[:-1])
    codes = np.full((len(middle), rings.shape[1] - 1), _BODY, dtype=np.int64)
    codes[:, 0] = _TRIM
    codes[:, 1:3] = _ACCENT
    pane = ~np.any(np.abs(middle[:, None] - (pillars + 0.055 / length)) < 0.056 / length, axis=1) & (middle > 0.008)
    codes[np.ix_(pane & (middle < 0.985), [3, 4])] = _GLASS
    palette = (look.paint, TRIM, GLASS, head_lamp(look.lit), tail_lamp(look.lit), accent)
    add_skin(builder, rings, codes, palette)
    add_floor(builder, rings, HOLLOW)

    def surface_of(row: int, band: int, front: bool) -> Surface:
        if row == (1 if front else 2) and band != 1:
            return palette[_HEAD if front else _TAIL]
        if row in ((3, 4) if front else (4,)):
            return GLASS
        return TRIM if row in ((0, 5) if front else (0,)) else (accent if row < 3 else look.paint)

    add_cap(builder, rings[0], lambda row, band: surface_of(row, band, True), front=True)
    add_cap(builder, rings[-1], lambda row, band: surface_of(row, band, False), front=False)
    _wheels(builder, [length * (0.5 - a) for a in axles], 0.49 * width, radius, look.rim_light)
    return builder.build(crease_rad=0.7).fitted(dims)


def _bus_rings(
    length: float, width: float, height: float, axles: tuple[float, float], pillars: Array, radius: float
) -> tuple[Array, Array]:
    """Places (S,) along a bus, and left half sections (S, R, 3)."""
    arches = [a + 1.1 * radius / length * _ARCH for a in axles]
    f = stations([0, 0.003, 0.008, 0.016, 0.03, 0.97, 0.985, 0.995, 1], pillars, pillars + 0.11 / length, *arches)
    x = length * (0.5 - f)
    low = np.full(len(f), 0.30)
    for axle in axles:
        away = np.abs(x - length * (0.5 - axle))
        low = np.where(away < 1.105 * radius, radius + np.sqrt(np.maximum((1.1 * radius) ** 2 - away**2, 0)), low)
    half = 0.5 * width * curve([(0, 0.93), (0.003, 0.965), (0.008, 0.985), (0.02, 1), (0.985, 1), (1, 0.95)])(f)
    roof = height * curve([(0, 0.955), (0.004, 0.975), (0.012, 0.99), (0.03, 1), (0.98, 1), (1, 0.97)])(f)
    levels = np.array([0.0, 0.10, 0.26, 0.38, 0.62, 0.84, 0.90, 0.95])
    widths = np.array([0.985, 1.0, 1.0, 1.0, 0.995, 0.985, 0.96, 0.91])
    # Window lines run level above the wheel arches; only the lowest rows give way to them.
    rows = np.maximum(0.30 + levels * (roof - 0.30)[:, None], low[:, None])
    inward, upward = np.array([0.82, 0.45, 0.0]), np.array([0.985, 0.997, 1.0])
    y = np.hstack([half[:, None] * widths, half[:, None] * inward])
    z = np.hstack([rows, 0.30 + upward * (roof - 0.30)[:, None]])
    return f, np.stack([np.broadcast_to(x[:, None], y.shape), y, z], -1)


def build_truck(dims: Array, look: Look, cargo: Surface) -> Mesh:
    """A box truck with extents exactly ``dims`` (length, width, height), metres; ``cargo`` is the surface of its box."""
    length, width, height = (float(d) for d in dims)
    builder, radius = MeshBuilder(), 0.135 * height
    cab_length, cab_height = 1.75, min(0.83 * height, 2.5)
    axles = (0.5 * length - 1.05, -0.5 * length + 0.24 * length)
    _cab(builder, length, 0.94 * width, cab_length, cab_height, axles[0], radius, look)
    back, front = -0.5 * length, 0.5 * length - cab_length - 0.12
    _cargo(builder, back, front, width, 0.30 * height, height, cargo, look)
    builder.box([back + 0.1, -0.32 * width, 0.18 * height], [front + 0.6, 0.32 * width, 0.30 * height], HOLLOW)
    for side in (1, -1):
        low, high = sorted((side * 0.44 * width, side * 0.47 * width))
        builder.box([axles[1] + radius + 0.2, low, 0.17 * height], [axles[0] - radius - 0.3, high, 0.27 * height], TRIM)
    _wheels(builder, list(axles), 0.485 * width, radius, look.rim_light)
    return builder.build(crease_rad=0.7).fitted(dims)


def heavy_lamps(dims: Array) -> tuple[Array, Array]:
    """Positions (2, 3) of head and tail lamps of a bus or truck in its frame."""
    length, width, height = dims
    head = np.array([[0.497 * length, s * 0.38 * width, 0.80 - 0.5 * height] for s in (1, -1)])
    tail = np.array([[-0.499 * length, s * 0.40 * width, 0.90 - 0.5 * height] for s in (1, -1)])
    return head, tail


def _cab(
    builder: MeshBuilder, length: float, width: float, cab_m: float, height: float, axle_x: float, radius: float, look: Look
) -> None:
    ahead = 0.5 * length
    f, rings = _cab_rings(ahead, width, cab_m, height, axle_x, radius)
    middle = 0.5 * (f[1:] + f[:-1])
    codes = np.full((len(middle), rings.shape[1] - 1), _BODY, dtype=np.int64)
    codes[:, 0] = _TRIM
    codes[np.ix_((middle > 0.34) & (middle < 0.76), [5, 6])] = _GLASS
    codes[np.ix_((middle > 0.05) & (middle < 0.28), range(9, codes.shape[1]))] = _GLASS
    codes[middle < 0.05, 2] = _HEAD
    palette = (look.paint, TRIM, GLASS, head_lamp(look.lit), TRIM, TRIM)
    add_skin(builder, rings, codes, palette)
    add_floor(builder, rings, HOLLOW)

    def surface_of(row: int, band: int) -> Surface:
        if row == 2 and band != 1:
            return palette[_HEAD]
        return TRIM if row in (0, 2, 3) else look.paint

    add_cap(builder, rings[0], surface_of, front=True)
    add_cap(builder, rings[-1], lambda *_: look.paint, front=False)
    add_plate(builder, float(rings[0, :, 0].max()), 0.55, front=True)
    add_mirrors(builder, ahead - 0.22 * cab_m, 0.62 * height, width * 1.06, TRIM, tall=0.34)


def _cab_rings(ahead: float, width: float, cab_m: float, height: float, axle_x: float, radius: float) -> tuple[Array, Array]:
    """Places (S,) along a cab whose front is ``ahead`` metres before the middle, and left half sections (S, R, 3)."""
    f = stations(
        [0, 0.01, 0.04, 0.10, 0.18, 0.30, 0.34, 0.52, 0.76, 0.80, 0.94, 1], (ahead - axle_x + 1.1 * radius * _ARCH) / cab_m
    )
    x = ahead - cab_m * f
    low = np.full(len(f), 0.42)
    away = np.abs(x - axle_x)
    low = np.where(away < 1.105 * radius, radius + np.sqrt(np.maximum((1.1 * radius) ** 2 - away**2, 0)), low)
    half = 0.5 * width * curve([(0, 0.86), (0.01, 0.91), (0.04, 0.955), (0.12, 0.99), (0.2, 1), (1, 1)])(f)
    top = height * curve([(0, 0.60), (0.04, 0.66), (0.10, 0.76), (0.30, 0.955), (0.42, 0.99), (0.7, 1), (1, 0.995)])(f)
    levels = np.array([0.0, 0.16, 0.34, 0.46, 0.56])
    belt = 0.56 * height
    # Below the window line sections go up to the same height everywhere; above it they follow the windscreen.
    z_low = low[:, None] + (levels / 0.56) * np.minimum(belt, 0.93 * top)[:, None] - (levels / 0.56) * low[:, None]
    start = z_low[:, -1]
    up = np.array([0.12, 0.45, 0.80, 0.93, 1.0])
    z_up = start[:, None] + up * (0.97 * top - start)[:, None]
    across = np.array([0.92, 0.6, 0.3, 0.0])
    z_roof = 0.97 * top[:, None] + (0.03 * top)[:, None] * (1 - across**2)
    y_low = half[:, None] * np.array([0.95, 0.99, 1.0, 1.0, 0.99])
    y_up = half[:, None] * np.array([0.985, 0.97, 0.945, 0.92, 0.88])
    y = np.hstack([y_low, y_up, 0.88 * half[:, None] * across])
    z = np.hstack([z_low, z_up, z_roof])
    return f, np.stack([np.broadcast_to(x[:, None], y.shape), y, z], -1)


def _cargo(
    builder: MeshBuilder, back: float, front: float, width: float, bottom: float, top: float, cargo: Surface, look: Look
) -> None:
    """The box: slightly rounded edges, a frame round its rear doors, tail lamps under them."""
    f = stations([0, 0.006, 0.02], np.linspace(0.06, 0.94, 9), [0.98, 0.994, 1])
    x = front + (back - front) * f
    inset = curve([(0, 0.965), (0.006, 0.99), (0.02, 1), (0.98, 1), (0.994, 0.99), (1, 0.965)])(f)
    half = 0.5 * width * inset
    high = bottom + (top - bottom) * (0.5 + 0.5 * inset)
    levels = np.array([0.0, 0.05, 0.3, 0.55, 0.8, 0.95, 0.985, 1.0, 1.0, 1.0, 1.0])
    widths = np.array([0.985, 1.0, 1.0, 1.0, 1.0, 1.0, 0.985, 0.95, 0.6, 0.3, 0.0])
    y = half[:, None] * widths
    z = bottom + (high - bottom)[:, None] * levels
    rings = np.stack([np.broadcast_to(x[:, None], y.shape), y, z], -1)
    codes = np.zeros((len(f) - 1, len(levels) - 1), dtype=np.int64)
    codes[:, 0] = 1
    add_skin(builder, rings, codes, (cargo, TRIM))
    add_floor(builder, rings, HOLLOW)
    add_cap(builder, rings[0], lambda *_: cargo, front=True)
    add_cap(builder, rings[-1], lambda row, _: TRIM if row in (0, 5) else cargo.tinted(0.92), front=False)
    lamp = tail_lamp(look.lit)
    for side in (1, -1):
        low, high_y = sorted((side * 0.30 * width, side * 0.46 * width))
        builder.box([back + 0.02, low, 0.72 * bottom], [back + 0.12, high_y, 0.98 * bottom], lamp)
    seam = [[back - 0.001, s * 0.012, z] for s, z in ((1, bottom + 0.1), (-1, bottom + 0.1), (-1, top - 0.15), (1, top - 0.15))]
    builder.quads(seam, HOLLOW)


def _wheels(builder: MeshBuilder, axles: list[float], outer: float, radius: float, rim_light: float) -> None:
    for x in axles:
        for side in (1, -1):
            add_wheel(builder, x, side, outer, radius, 0.3, rim_light)
