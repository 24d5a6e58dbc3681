"""How far off a network's readings are, as measured on validation scenes.

A detection's score says more about its precision than anything else: the detector learns it as the overlap that its box will
have. So every standard deviation grows with the distance of the score from 1. Vehicles cut by the image border are read worse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from service.geometry.transforms import Array


@dataclass(frozen=True)
class ErrorModel:
    """``sigma = (floor + slope * size) * exp(growth * (1 - score)) * (cut, if cut)``, in the unit of the reading."""

    floor: float
    slope: float
    """Over the box's size, sqrt(width * height) in px; 0 where size does not matter."""
    growth: float
    cut: float
    """Factor for vehicles that the image border cuts."""

    @staticmethod
    def from_metadata(values: object) -> ErrorModel:
        """From the list [floor, slope, growth, cut] of an ONNX file's metadata. Raises TypeError or ValueError."""
        floor, slope, growth, cut = (float(v) for v in values)  # type: ignore[attr-defined]
        if not (floor > 0 and slope >= 0 and cut > 0 and np.isfinite([floor, slope, growth, cut]).all()):
            raise ValueError(f"error model {values!r}: floor and cut must be positive, slope not negative")
        return ErrorModel(floor, slope, growth, cut)

    def to_metadata(self) -> list[float]:
        """The inverse of :meth:`from_metadata`."""
        return [self.floor, self.slope, self.growth, self.cut]

    def sigma(self, score: ArrayLike, is_cut: ArrayLike = False, size_px: ArrayLike = 0.0) -> Array:
        """Standard deviations (N,) of readings on detections of scores (N,), cut or not (N,), of sizes (N,)."""
        size = np.asarray(size_px, dtype=np.float64)
        growth = np.exp(self.growth * (1.0 - np.asarray(score, dtype=np.float64)))
        return np.asarray((self.floor + self.slope * size) * growth * np.where(is_cut, self.cut, 1.0))
