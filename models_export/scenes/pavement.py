"""The ground of a road world: asphalt and its wear, kerbs, sidewalks, painted markings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models_export.scenes.layout import REACH_M, offset, turned
from models_export.scenes.mesh import Array, MeshBuilder, Surface

KERB_M = 0.13
"""Height of the sidewalk."""
PAINT_Z_M = 0.012
"""Markings lie this far above the road, so that depth tells them apart."""

WHITE = Surface((0.80, 0.80, 0.78), fine=0.25, coarse=0.45)


@dataclass(frozen=True)
class Style:
    """How the roads of one world look, and the widths of their lanes and sidewalks."""

    asphalt: Surface
    walk: Surface
    kerb: Surface
    verge: Surface
    lane_m: float
    walk_m: float


def sample_style(rng: np.random.Generator) -> Style:
    """A random style."""
    grey = rng.uniform(0.28, 0.54)
    warm = rng.uniform(-0.025, 0.035)
    # Some roads are reddish, some bluish; a few are of pale concrete.
    hue = np.array([warm, rng.uniform(-0.008, 0.008), -warm])
    grey = grey + 0.08 if rng.random() < 0.12 else grey
    walk = rng.uniform(0.48, 0.64)
    green = rng.random() < 0.7
    dry = rng.uniform(0, 1)
    verge = Surface((0.29 + 0.13 * dry, 0.34 + 0.04 * dry, 0.19 + 0.05 * dry), fine=0.6, coarse=0.5)
    paved = Surface((walk * 0.95, walk * 0.93, walk * 0.9), fine=0.25, coarse=0.25)
    return Style(
        asphalt=Surface(
            (float(grey + hue[0]), float(grey + hue[1]), float(grey + hue[2])),
            fine=float(rng.uniform(0.25, 0.5)),
            coarse=float(rng.uniform(0.15, 0.5)),
        ),
        walk=Surface((walk + 0.01, walk, walk - 0.015), fine=0.25, coarse=0.2),
        kerb=Surface((0.66, 0.66, 0.64), fine=0.2),
        verge=verge if green else paved,
        lane_m=float(rng.uniform(3.1, 3.7)),
        walk_m=float(rng.uniform(2.2, 4.5)),
    )


def lay_block(ground: MeshBuilder, outline: Array, far: Array, style: Style) -> Array:
    """Land behind a kerb line (N, 2) with the land on the left: kerb, sidewalk, then ground up to ``far``.

    far: one point (2,), or one for each point of the line (N, 2). Gives the sidewalk's inner edge (N, 2).
    """
    kerb_in = offset(outline, 0.16)
    walk_in = offset(outline, style.walk_m)

    def lifted(line: Array, z: float) -> Array:
        return np.column_stack([line, np.full(len(line), z)])

    ground.strip(lifted(outline, 0.0), lifted(outline, KERB_M), style.kerb)
    ground.strip(lifted(outline, KERB_M), lifted(kerb_in, KERB_M), style.kerb)
    ground.strip(lifted(kerb_in, KERB_M), lifted(walk_in, KERB_M), style.walk)
    goal = lifted(np.broadcast_to(far, walk_in.shape), KERB_M)
    edge = lifted(walk_in, KERB_M)
    ground.quads(np.stack([edge[:-1], edge[1:], goal[1:], goal[:-1]], 1), style.verge)
    return walk_in


def lay_asphalt(ground: MeshBuilder, style: Style) -> None:
    """The plane z = 0 under everything."""
    far = REACH_M + 20
    ground.quads([[-far, -far, 0], [far, -far, 0], [far, far, 0], [-far, far, 0]], style.asphalt)


def lay_wear(ground: MeshBuilder, style: Style, half: tuple[float, ...], rng: np.random.Generator) -> None:
    """Mended patches, tar lines and manhole covers on both roads; ``half`` as in the intersection, 0 for no road."""
    for axis, width in enumerate(half):
        if width <= 0:
            continue
        R = np.eye(2) if axis == 0 else turned(1)
        for _ in range(int(rng.integers(2, 14))):
            x, y = rng.uniform(-60, 60), rng.uniform(-width + 1, width - 1)
            kind = rng.random()
            if kind < 0.45:
                size = rng.uniform(0.8, 6.0), rng.uniform(0.6, 2.2)
                patch = style.asphalt.tinted(float(rng.uniform(0.72, 1.18)))
                paint(ground, R, (x, x + size[0]), (y - size[1] / 2, min(y + size[1] / 2, width)), patch, 0.004)
            elif kind < 0.75:
                paint(ground, R, (x, x + rng.uniform(4, 25)), (y, y + 0.07), style.asphalt.tinted(0.5), 0.006)
            else:
                angle = np.linspace(0, 2 * np.pi, 13)[:-1]
                ring = (np.array([x, y]) + 0.33 * np.stack([np.cos(angle), np.sin(angle)], 1)) @ R.T
                ground.fan(np.column_stack([ring, np.full(12, 0.008)]), Surface((0.24, 0.23, 0.22), gloss=0.15, fine=0.4))


def paint(
    ground: MeshBuilder,
    R: Array,
    x: tuple[float, float],
    y: tuple[float, float],
    surface: Surface = WHITE,
    z: float = PAINT_Z_M,
) -> None:
    """A painted rectangle in a frame turned by R (2, 2)."""
    corners = np.array([[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]]) @ R.T
    ground.quads(np.column_stack([corners, np.full(4, z)]), surface)


def dashes(
    ground: MeshBuilder, R: Array, x: tuple[float, float], y: float, dash: float, gap: float, width: float = 0.13
) -> None:
    """A broken line along x at ``y``, in a frame turned by R (2, 2)."""
    for start in np.arange(x[0], x[1] - dash, dash + gap):
        paint(ground, R, (start, start + dash), (y - width / 2, y + width / 2))


def arrow(ground: MeshBuilder, R: Array, x: float, y: float) -> None:
    """An arrow on a lane, pointing to the crossing."""
    paint(ground, R, (x + 1.2, x + 4.0), (y - 0.08, y + 0.08))
    corners = np.array([[x, y], [x + 1.3, y - 0.38], [x + 1.3, y + 0.38], [x + 1.3, y + 0.38]]) @ R.T
    ground.quads(np.column_stack([corners, np.full(4, PAINT_Z_M)]), WHITE)


def line_along(
    ground: MeshBuilder,
    line: Array,
    y: float,
    width: float = 0.12,
    dash: float = 0.0,
    gap: float = 0.0,
    surface: Surface = WHITE,
) -> None:
    """A painted line at ``y`` metres left of a polyline (N, 2), broken when ``gap`` is positive."""
    low, high = offset(line, y - width / 2), offset(line, y + width / 2)
    quads = np.stack([low[:-1], low[1:], high[1:], high[:-1]], 1)
    if gap > 0:
        distance = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])[:-1]
        quads = quads[distance % (dash + gap) < dash]
    z = np.full((*quads.shape[:2], 1), PAINT_Z_M)
    ground.quads(np.concatenate([quads, z], -1), surface)


def crosswalk(ground: MeshBuilder, R: Array, x: float, width: float) -> None:
    """Stripes across a road from -width to width, from ``x`` on 3.2 m deep, in a frame turned by R (2, 2)."""
    for y in np.arange(-width + 0.5, width - 0.5, 1.0):
        paint(ground, R, (x, x + 3.2), (y, y + 0.5))
