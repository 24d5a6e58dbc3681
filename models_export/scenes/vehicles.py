"""Procedural vehicles: ten body styles from hatchback to bus, sizes sampled per vehicle."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from models_export.scenes.actor import ActorModel
from models_export.scenes.carbody import CarShape, Look, build_car, car_lamps
from models_export.scenes.heavy import build_bus, build_truck, heavy_lamps
from models_export.scenes.mesh import Array, Surface


@dataclass(frozen=True)
class Style:
    """A body style: how common, how large, how shaped."""

    name: str
    kind: str
    """One of ``actor.VEHICLE_KINDS``."""
    share: float
    """How common it is on the road."""
    length_m: tuple[float, float]
    width_m: tuple[float, float]
    height_m: tuple[float, float]
    shape: CarShape | None = None
    """None for trucks and buses, which are built otherwise."""


_Spans = tuple[tuple[float, float], ...]


def _car(
    lines: tuple[float, float, float, float, float, float, float, float],
    windows: _Spans,
    *,
    axles: tuple[float, float] = (0.175, 0.80),
    blind: bool = False,
    bed: bool = False,
    tall_lamps: bool = False,
) -> CarShape:
    """``lines``: cowl, roof front and rear, tail, nose, belt, deck, roof width, as in ``CarShape``."""
    return CarShape(*lines, windows, axles, blind, bed, tall_lamps)


_SEDAN = _car((0.29, 0.44, 0.69, 0.84, 0.49, 0.63, 0.67, 0.74), ((0.375, 0.53), (0.55, 0.70), (0.715, 0.76)))
_HATCH = _car((0.25, 0.41, 0.84, 0.955, 0.51, 0.62, 0.65, 0.76), ((0.34, 0.55), (0.57, 0.75), (0.775, 0.86)))
_WAGON = _car((0.27, 0.41, 0.89, 0.97, 0.49, 0.62, 0.64, 0.76), ((0.355, 0.53), (0.55, 0.71), (0.73, 0.92)), tall_lamps=True)
_SUV = _car((0.26, 0.39, 0.87, 0.965, 0.55, 0.63, 0.65, 0.79), ((0.34, 0.52), (0.54, 0.70), (0.72, 0.89)), tall_lamps=True)
_PICKUP = _car((0.25, 0.37, 0.56, 0.60, 0.54, 0.63, 0.60, 0.78), ((0.325, 0.43), (0.45, 0.56)), axles=(0.17, 0.76), bed=True)
_VAN_LINES, _VAN_AXLES = (0.16, 0.29, 0.955, 0.985, 0.46, 0.56, 0.57, 0.875), (0.165, 0.785)
_PANEL = _car(_VAN_LINES, ((0.235, 0.385),), axles=_VAN_AXLES, blind=True, tall_lamps=True)
_MINIBUS = _car(_VAN_LINES, ((0.235, 0.385), (0.405, 0.64), (0.66, 0.93)), axles=_VAN_AXLES, tall_lamps=True)

STYLES = (
    Style("sedan", "car", 0.24, (4.3, 5.1), (1.74, 1.93), (1.40, 1.50), _SEDAN),
    Style("hatchback", "car", 0.23, (3.6, 4.4), (1.65, 1.83), (1.42, 1.56), _HATCH),
    Style("wagon", "car", 0.12, (4.4, 5.0), (1.75, 1.92), (1.42, 1.55), _WAGON),
    Style("suv", "car", 0.20, (4.1, 5.0), (1.78, 2.00), (1.58, 1.88), _SUV),
    Style("pickup", "car", 0.05, (5.0, 5.7), (1.80, 2.03), (1.72, 1.92), _PICKUP),
    Style("panel-van", "van", 0.05, (4.6, 5.9), (1.85, 2.05), (1.85, 2.45), _PANEL),
    Style("minibus", "van", 0.04, (4.6, 5.6), (1.85, 2.02), (1.80, 2.20), _MINIBUS),
    Style("box-truck", "truck", 0.045, (5.8, 8.2), (2.10, 2.45), (2.75, 3.45)),
    Style("bus", "bus", 0.025, (9.6, 12.4), (2.48, 2.55), (2.90, 3.25)),
)
LONGEST_M = max(style.length_m[1] for style in STYLES)

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
"""Colours of cars (display RGB) and how common they are."""
_LIVERIES = (
    (0.92, 0.92, 0.90),
    (0.75, 0.12, 0.12),
    (0.12, 0.28, 0.55),
    (0.90, 0.70, 0.10),
    (0.15, 0.45, 0.25),
    (0.70, 0.71, 0.72),
)
"""Colours of vans, truck boxes and buses."""


def sample_vehicle(rng: np.random.Generator, *, lamps_on: bool = False, longest_m: float = LONGEST_M) -> ActorModel:
    """A random vehicle of the styles that stay below ``longest_m``. ``lamps_on`` lights its head and tail lamps."""
    styles = [s for s in STYLES if s.length_m[0] < longest_m]
    share = np.array([s.share for s in styles])
    style = styles[rng.choice(len(styles), p=share / share.sum())]
    dims = _sample_dims(style, rng)
    dims[0] = min(dims[0], longest_m)
    gloss = float(rng.uniform(0.45, 0.9))
    plain = style.kind == "car"
    base, accent = _sample_paint(rng, gloss, plain), _sample_paint(rng, gloss, False)
    jitter = tuple(np.clip(rng.normal(0, 1, 4), -2, 2).tolist())
    look = Look(base, lamps_on, float(rng.uniform(0.35, 0.75)), jitter)
    if style.shape is not None:
        build, lamps = partial(build_car, style.shape, dims, look), car_lamps(dims, style.shape)
    else:
        maker = build_bus if style.kind == "bus" else build_truck
        build, lamps = partial(maker, dims, look, accent), heavy_lamps(dims)
    if not lamps_on:
        return ActorModel(style.name, style.kind, dims, build)
    return ActorModel(style.name, style.kind, dims, build, *lamps)


def _sample_dims(style: Style, rng: np.random.Generator) -> Array:
    """Long vehicles of a style are also wide; height varies more freely."""
    size = rng.beta(2, 2)
    wide, high = np.clip(size + rng.normal(0, 0.15), 0, 1), np.clip(0.5 * size + 0.5 * rng.random(), 0, 1)
    ranges = (style.length_m, style.width_m, style.height_m)
    return np.array([low + t * (top - low) for (low, top), t in zip(ranges, (size, wide, high), strict=True)])


def _sample_paint(rng: np.random.Generator, gloss: float, car: bool) -> Surface:
    if car:
        share = np.array([p for _, p in PAINTS])
        rgb, _ = PAINTS[rng.choice(len(PAINTS), p=share / share.sum())]
    else:
        rgb = _LIVERIES[0] if rng.random() < 0.45 else _LIVERIES[rng.integers(len(_LIVERIES))]
    r, g, b = np.clip(np.array(rgb) * rng.uniform(0.85, 1.12) + rng.normal(0, 0.015, 3), 0.02, 0.97)
    return Surface((float(r), float(g), float(b)), gloss=gloss)
