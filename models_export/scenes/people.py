"""People on foot and on bicycles: simple figures that hide parts of vehicles, with exact boxes of their own."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from models_export.scenes.actor import ActorModel
from models_export.scenes.layout import RoadWorld, offset, resampled
from models_export.scenes.mesh import Array, Mesh, MeshBuilder, Surface

FIRST_ID = 100_001
"""Identities of people start here, those of vehicles at 1."""
_RIDERS = 0.25
_REACH_M = 60.0


@dataclass(eq=False)
class Walker:
    """Somebody who goes to and fro along a walk."""

    id: int
    model: ActorModel
    line: Array
    """(N, 2) points every half metre."""
    s_m: float
    """Distance along the line; beyond its end the way leads back."""
    speed_mps: float
    ground_m: float

    def step(self, seconds: float) -> None:
        """Walk on."""
        self.s_m += seconds * self.speed_mps

    def pose(self) -> Array:
        """Centre x, y and heading (3,)."""
        length = 0.5 * (len(self.line) - 1)
        lap = self.s_m % (2 * length)
        ahead = lap < length
        place = min(lap if ahead else 2 * length - lap, length - 1e-6)
        index = int(place / 0.5)
        a, b = self.line[index], self.line[index + 1]
        center = a + (place / 0.5 - index) * (b - a)
        step = b - a if ahead else a - b
        return np.array([*center, np.arctan2(step[1], step[0])])

    def velocity(self) -> Array:
        """(3,) m/s."""
        yaw = self.pose()[2]
        return self.speed_mps * np.array([np.cos(yaw), np.sin(yaw), 0.0])


def sample_walkers(world: RoadWorld, rng: np.random.Generator, count: int) -> list[Walker]:
    """``count`` people on a world's walks, one in four on a bicycle (none indoors)."""
    walkers = []
    for k in range(count):
        line = resampled(world.walks[rng.integers(len(world.walks))])
        line = line[np.abs(line).max(1) < _REACH_M]
        rides = not world.indoor and rng.random() < _RIDERS
        line = resampled(offset(line, float(rng.uniform(-0.4, 0.4))))
        model = _sample_cyclist(rng) if rides else _sample_pedestrian(rng)
        speed = rng.uniform(2.5, 5.5) if rides else (0.0 if rng.random() < 0.2 else rng.uniform(0.8, 1.7))
        start = float(rng.uniform(0, len(line)))
        walkers.append(Walker(FIRST_ID + k, model, line, start, float(speed), world.walk_z_m))
    return walkers


def _sample_pedestrian(rng: np.random.Generator) -> ActorModel:
    tall = float(rng.uniform(1.5, 1.95))
    dims = np.array([rng.uniform(0.45, 0.75), rng.uniform(0.46, 0.60), tall])
    clothes = _sample_clothes(rng)
    return ActorModel("pedestrian", "pedestrian", dims, partial(_build_pedestrian, dims, clothes))


def _sample_cyclist(rng: np.random.Generator) -> ActorModel:
    dims = np.array([rng.uniform(1.65, 1.85), rng.uniform(0.50, 0.62), rng.uniform(1.60, 1.85)])
    clothes = _sample_clothes(rng)
    return ActorModel("cyclist", "cyclist", dims, partial(_build_cyclist, dims, clothes))


@dataclass(frozen=True)
class _Clothes:
    coat: Surface
    trousers: Surface
    skin: Surface
    hair: Surface


def _sample_clothes(rng: np.random.Generator) -> _Clothes:
    return _Clothes(
        Surface(tuple(rng.uniform(0.08, 0.85, 3).tolist())),
        Surface(tuple(rng.uniform(0.06, 0.4, 3).tolist())),
        Surface((0.72, 0.54, 0.44)).tinted(float(rng.uniform(0.4, 1.15))),
        Surface((0.2, 0.15, 0.1)).tinted(float(rng.uniform(0.3, 2.2))),
    )


def _build_pedestrian(dims: Array, clothes: _Clothes) -> Mesh:
    """Someone in mid-stride."""
    builder = MeshBuilder()
    for side, ahead in ((1, 0.20), (-1, -0.20)):
        y = 0.10 * side
        _limb(builder, (0.0, y, 0.90), (ahead, y, 0.06), 0.085, clothes.trousers)
        builder.box([ahead - 0.08, y - 0.05, 0.0], [ahead + 0.16, y + 0.05, 0.09], clothes.hair)
        _limb(builder, (0.0, 0.21 * side, 1.40), (-0.8 * ahead, 0.24 * side, 0.85), 0.055, clothes.coat)
    _limb(builder, (0.0, 0.0, 0.82), (0.02, 0.0, 1.48), 0.19, clothes.coat)
    _head(builder, (0.03, 0.0, 1.63), clothes)
    return builder.build(crease_rad=0.9).fitted(dims)


def _build_cyclist(dims: Array, clothes: _Clothes) -> Mesh:
    """Someone on a bicycle."""
    builder, steel = MeshBuilder(), Surface((0.15, 0.15, 0.17), gloss=0.3)
    for x in (0.52, -0.52):
        _hoop(builder, x, 0.34, steel)
    for a, b in (
        ((0.45, 0.85), (-0.1, 0.35)),
        ((-0.15, 0.9), (-0.1, 0.35)),
        ((0.45, 0.85), (0.52, 0.34)),
        ((-0.1, 0.35), (-0.52, 0.34)),
    ):
        _limb(builder, (a[0], 0.0, a[1]), (b[0], 0.0, b[1]), 0.025, steel)
    _limb(builder, (0.42, -0.28, 1.0), (0.42, 0.28, 1.0), 0.02, steel)
    for side in (1, -1):
        knee = (0.15, 0.12 * side, 0.75 + 0.12 * side)
        _limb(builder, (-0.18, 0.10 * side, 0.98), knee, 0.075, clothes.trousers)
        _limb(builder, knee, (-0.08, 0.12 * side, 0.30 + 0.15 * side), 0.06, clothes.trousers)
        _limb(builder, (0.10, 0.19 * side, 1.42), (0.42, 0.24 * side, 1.02), 0.05, clothes.coat)
    _limb(builder, (-0.18, 0.0, 0.95), (0.12, 0.0, 1.50), 0.17, clothes.coat)
    _head(builder, (0.22, 0.0, 1.66), clothes)
    return builder.build(crease_rad=0.9).fitted(dims)


def _limb(
    builder: MeshBuilder, a: tuple[float, float, float], b: tuple[float, float, float], radius: float, surface: Surface
) -> None:
    """A six-sided rod with closed ends."""
    start, stop = np.array(a), np.array(b)
    along = (stop - start) / np.linalg.norm(stop - start)
    side = np.cross(along, [0.0, 1.0, 0.0] if abs(along[1]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    up = np.cross(along, side)
    angle = np.linspace(0, 2 * np.pi, 7)[:-1, None]
    ring = radius * (np.cos(angle) * side + np.sin(angle) * up)
    builder.strip(start + ring, stop + ring, surface, closed=True)
    builder.fan((start + ring)[::-1], surface)
    builder.fan(stop + ring, surface)


def _head(builder: MeshBuilder, center: tuple[float, float, float], clothes: _Clothes) -> None:
    x, y, z = center
    _limb(builder, (x, y, z - 0.17), (x, y, z - 0.02), 0.055, clothes.skin)
    _limb(builder, (x, y, z - 0.10), (x, y, z + 0.06), 0.10, clothes.skin)
    _limb(builder, (x - 0.01, y, z + 0.04), (x - 0.01, y, z + 0.13), 0.105, clothes.hair)


def _hoop(builder: MeshBuilder, x: float, radius: float, surface: Surface) -> None:
    """A wheel standing on z = 0: a flat ring, seen from both sides."""
    angle = np.linspace(0, 2 * np.pi, 17)[:, None]
    circle = np.hstack([np.cos(angle), np.zeros_like(angle), np.sin(angle)])
    outer, inner = (np.array([x, 0.0, radius]) + r * circle for r in (radius, 0.87 * radius))
    builder.strip(outer, inner, surface)
    builder.strip(inner, outer, surface)
