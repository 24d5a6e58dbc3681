"""The road surface of a site as a plane in the world frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from service.geometry.transforms import Array


@dataclass(frozen=True, eq=False)
class GroundPlane:
    """The plane ``normal . p = offset`` in the world, metres; the default is z = 0."""

    normal: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    """Unit normal (3,), pointing up (z > 0)."""
    offset: float = 0.0
    """Distance of the plane from the origin along the normal, metres."""

    def height_at(self, xy: ArrayLike) -> Array:
        """Heights z (...) of the ground under world positions (..., 2 or more), metres."""
        xy = np.asarray(xy, dtype=np.float64)
        height: Array = (self.offset - xy[..., :2] @ self.normal[:2]) / self.normal[2]
        return height

    def intersect(self, origin_m: ArrayLike, directions: ArrayLike) -> Array:
        """Where rays from ``origin_m`` (3,) along ``directions`` (..., 3) meet the ground: points (..., 3).

        NaN where a ray runs parallel to the ground or meets it behind its origin.
        """
        origin = np.asarray(origin_m, dtype=np.float64)
        directions = np.asarray(directions, dtype=np.float64)
        slope = directions @ self.normal
        gap = self.offset - origin @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = gap / slope
        distance = np.where(np.isfinite(distance) & (distance > 0), distance, np.nan)
        return origin + directions * distance[..., None]
