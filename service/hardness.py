"""Which cameras see a hard scene just now: dark, of little contrast (fog, rain), or crowded.

The thresholds were chosen on training scenes (docs/hard-mode.md). What they cost: a few thousand pixels a frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.geometry.transforms import Array

_EVERY_PX = 8
"""Every eighth pixel of every eighth row is looked at."""
_SPREAD_PERCENTILES = (5.0, 95.0)


@dataclass(frozen=True)
class HardnessSettings:
    """A frame is hard when any one of these says so."""

    dark_below: float = 95.0
    """Mean grey level, 0..255."""
    contrast_below: float = 80.0
    """Grey levels between the 5th and the 95th percentile."""
    crowded_from: int = 6
    """Detected vehicles of which another's 2D box covers more than ``overlap``."""
    overlap: float = 0.5
    """Share of a 2D box's area."""


@dataclass(frozen=True)
class Hardness:
    """What one frame looks like."""

    grey: float
    """Mean grey level, 0..255."""
    contrast: float
    """Grey levels between the 5th and the 95th percentile."""
    overlapped: int
    """Detected vehicles that another's box covers in part."""

    def is_hard(self, settings: HardnessSettings) -> bool:
        """Whether the frame is dark, of little contrast, or crowded."""
        return (
            self.grey < settings.dark_below
            or self.contrast < settings.contrast_below
            or self.overlapped >= settings.crowded_from
        )


def hardness_of(image: NDArray[np.uint8], xyxy_px: Array, settings: HardnessSettings) -> Hardness:
    """How hard an image (H, W, 3) RGB with detected 2D boxes (N, 4) is."""
    grey = image[::_EVERY_PX, ::_EVERY_PX].mean(2)
    low, high = np.percentile(grey, _SPREAD_PERCENTILES)
    return Hardness(float(grey.mean()), float(high - low), int((covered_share(xyxy_px) > settings.overlap).sum()))


def covered_share(xyxy_px: Array) -> Array:
    """The largest share (N,) of each 2D box (N, 4) that one other box covers."""
    low = np.maximum(xyxy_px[:, None, :2], xyxy_px[None, :, :2])
    high = np.minimum(xyxy_px[:, None, 2:], xyxy_px[None, :, 2:])
    shared = np.prod(np.maximum(high - low, 0.0), axis=-1)
    np.fill_diagonal(shared, 0.0)
    area = np.maximum(np.prod(xyxy_px[:, 2:] - xyxy_px[:, :2], axis=1), 1e-9)
    share: Array = shared.max(1, initial=0.0) / area
    return share
