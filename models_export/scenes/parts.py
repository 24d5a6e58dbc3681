"""Parts that all vehicles share: wheels, mirrors, number plates, and the materials that never vary much."""

from __future__ import annotations

import numpy as np

from models_export.scenes.mesh import Array, MeshBuilder, Surface

TRIM = Surface((0.09, 0.09, 0.10), gloss=0.25)
TYRE = Surface((0.07, 0.07, 0.075))
HOLLOW = Surface((0.03, 0.03, 0.035))
GLASS = Surface((0.06, 0.075, 0.085), gloss=1.0, glass=1.0)
PLATE = Surface((0.88, 0.88, 0.84))


def head_lamp(lit: bool) -> Surface:
    """A head lamp's pane."""
    return Surface((0.92, 0.93, 0.95), gloss=0.6, glow=0.9 if lit else 0.10)


def tail_lamp(lit: bool) -> Surface:
    """A tail lamp's pane."""
    return Surface((0.72, 0.05, 0.05), gloss=0.3, glow=0.45 if lit else 0.08)


def add_wheel(builder: MeshBuilder, x: float, side: int, outer: float, radius: float, width: float, rim_light: float) -> None:
    """A wheel that stands on z = 0 with its outer face at ``outer`` metres from the middle; ``side`` +1 left, -1 right."""
    angle = np.linspace(0, 2 * np.pi, 17)[:-1]
    circle = np.stack([np.cos(angle), np.sin(angle)], 1)

    def disc(scale: float, y: float) -> Array:
        points = scale * radius * circle
        ring = np.column_stack([x + points[:, 0], np.full(len(points), side * y), radius + points[:, 1]])
        return ring[::-1] if side > 0 else ring

    rim = Surface((rim_light, rim_light, rim_light * 1.02), gloss=0.5)
    builder.strip(disc(1.0, outer - width), disc(1.0, outer - 0.02), TYRE, closed=True)
    builder.strip(disc(1.0, outer - 0.02), disc(0.93, outer), TYRE, closed=True)
    builder.strip(disc(0.93, outer), disc(0.68, outer - 0.005), TYRE, closed=True)
    builder.strip(disc(0.68, outer - 0.005), disc(0.60, outer - 0.045), rim.tinted(0.8), closed=True)
    builder.strip(disc(0.60, outer - 0.045), disc(0.25, outer - 0.03), rim, closed=True)
    builder.fan(disc(0.25, outer - 0.03), rim.tinted(0.6))
    _spokes(builder, x, side, outer - 0.022, radius)


def _spokes(builder: MeshBuilder, x: float, side: int, y: float, radius: float) -> None:
    """Dark gaps between five spokes."""
    for k in range(5):
        middle = 2 * np.pi * k / 5 + 0.3
        corners = [(0.30, middle - 0.12), (0.56, middle - 0.30), (0.56, middle + 0.30), (0.30, middle + 0.12)]
        gap = np.array([[x + f * radius * np.cos(a), side * y, radius + f * radius * np.sin(a)] for f, a in corners])
        builder.quads(gap[::-1] if side > 0 else gap, HOLLOW)


def add_mirrors(builder: MeshBuilder, x: float, z: float, width: float, surface: Surface, *, tall: float = 0.13) -> None:
    """Both door mirrors, reaching just short of the vehicle's full width."""
    inner, outer = 0.455 * width, 0.4995 * width
    for low, high in ((inner, outer), (-outer, -inner)):
        builder.box([x - 0.05, low, z], [x + 0.09, high, z + tall], surface)


def add_plate(builder: MeshBuilder, x: float, z: float, *, front: bool) -> None:
    """A number plate on a face at x."""
    sign = 1.0 if front else -1.0
    corners = [[x + 0.008 * sign, sign * s * 0.26, z + dz] for s, dz in ((-1, -0.06), (1, -0.06), (1, 0.06), (-1, 0.06))]
    builder.quads(corners, PLATE)
