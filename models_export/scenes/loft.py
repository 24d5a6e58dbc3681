"""Bodies by lofting: cross-sections along a vehicle, joined into a smooth skin that is closed at both ends."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models_export.scenes.mesh import Array, MeshBuilder, Surface

_FLIP = np.array([1.0, -1.0, 1.0])

Codes = NDArray[np.int64]
"""Index into a palette per cell of a skin: (S - 1, R - 1) for S stations and R points a half section."""


def curve(points: Sequence[tuple[float, float]]) -> Callable[[ArrayLike], Array]:
    """A function through (x, y) points, straight in between and constant outside."""
    x, y = np.array(points, dtype=np.float64).T
    return lambda at: np.asarray(np.interp(at, x, y), dtype=np.float64)


def stations(*places: ArrayLike) -> Array:
    """All places in order, without near duplicates (closer than 0.2 % of the length)."""
    ordered = np.sort(np.concatenate([np.ravel(p) for p in places]))
    ordered = ordered[(ordered >= 0) & (ordered <= 1)]
    return ordered[np.concatenate([[True], np.diff(ordered) > 0.002])]


def add_skin(builder: MeshBuilder, rings: Array, codes: Codes, palette: Sequence[Surface]) -> None:
    """Both sides of a body. rings: (S, R, 3) left half sections from the sill up to the middle of the roof, front first."""
    left = np.stack([rings[:-1, :-1], rings[1:, :-1], rings[1:, 1:], rings[:-1, 1:]], 2)
    right = left[:, :, [1, 0, 3, 2]] * _FLIP
    for code, surface in enumerate(palette):
        chosen = codes == code
        if chosen.any():
            builder.quads(np.concatenate([left[chosen], right[chosen]]), surface)


def add_floor(builder: MeshBuilder, rings: Array, surface: Surface) -> None:
    """The underside between both sills."""
    low = rings[:, 0]
    builder.quads(np.stack([low[:-1], low[:-1] * _FLIP, low[1:] * _FLIP, low[1:]], 1), surface)


def add_cap(builder: MeshBuilder, ring: Array, surface_of: Callable[[int, int], Surface], *, front: bool) -> None:
    """Close one end, ring (R, 3). ``surface_of(row, band)``: rows from the sill up; bands 0 left, 1 middle, 2 right."""
    bands = ((1.0, 0.60), (0.60, -0.60), (-0.60, -1.0))
    for row in range(len(ring) - 1):
        for band, (a, b) in enumerate(bands):
            quad = np.array([ring[row], ring[row], ring[row + 1], ring[row + 1]])
            quad[:, 1] *= np.array([b, a, a, b])
            builder.quads(quad if front else quad[[1, 0, 3, 2]], surface_of(row, band))
