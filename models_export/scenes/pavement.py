"""The ground of a road world: asphalt and its wear, kerbs, sidewalks, painted markings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models_export.scenes.layout import REACH_M, turned
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
    grey = rng.uniform(0.30, 0.52)
    warm = rng.uniform(-0.012, 0.018)
    walk = rng.uniform(0.48, 0.64)
    green = rng.random() < 0.7
    dry = rng.uniform(0, 1)
    verge = Surface((0.29 + 0.13 * dry, 0.34 + 0.04 * dry, 0.19 + 0.05 * dry), fine=0.6, coarse=0.5)
    paved = Surface((walk * 0.95, walk * 0.93, walk * 0.9), fine=0.25, coarse=0.25)
    return Style(
        asphalt=Surface(
            (grey + warm, grey, grey - warm), fine=float(rng.uniform(0.25, 0.5)), coarse=float(rng.uniform(0.15, 0.5))
        ),
        walk=Surface((walk + 0.01, walk, walk - 0.015), fine=0.25, coarse=0.2),
        kerb=Surface((0.66, 0.66, 0.64), fine=0.2),
        verge=verge if green else paved,
        lane_m=float(rng.uniform(3.1, 3.7)),
        walk_m=float(rng.uniform(2.2, 4.5)),
    )


def lay_block(ground: MeshBuilder, outline: Array, far: Array, style: Style) -> Array:
    """Land behind a kerb line (N, 2) with the land on the left: kerb, sidewalk, then ground up to ``far``."""
    kerb_in = _offset(outline, 0.16)
    walk_in = _offset(outline, style.walk_m)

    def lifted(line: Array, z: float) -> Array:
        return np.column_stack([line, np.full(len(line), z)])

    ground.strip(lifted(outline, 0.0), lifted(outline, KERB_M), style.kerb)
    ground.strip(lifted(outline, KERB_M), lifted(kerb_in, KERB_M), style.kerb)
    ground.strip(lifted(kerb_in, KERB_M), lifted(walk_in, KERB_M), style.walk)
    goal = np.broadcast_to(np.array([far[0], far[1], KERB_M]), (len(walk_in) - 1, 3))
    edge = lifted(walk_in, KERB_M)
    ground.quads(np.stack([edge[:-1], edge[1:], goal, goal], 1), style.verge)
    return walk_in


def _offset(line: Array, distance: float) -> Array:
    """A polyline (N, 2) shifted to its left."""
    step = np.empty_like(line)
    segments = np.diff(line, axis=0)
    segments /= np.linalg.norm(segments, axis=1, keepdims=True)
    step[0], step[-1] = segments[0], segments[-1]
    step[1:-1] = segments[:-1] + segments[1:]
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    normal = np.stack([-step[:, 1], step[:, 0]], 1)
    cosine = np.ones(len(line))
    cosine[1:-1] = np.einsum("ij,ij->i", step[1:-1], segments[:-1])
    return line + normal * (distance / cosine)[:, None]


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
