"""What a road world is made of: lanes to drive on, places to park, land to build on, poles for cameras.

Everything is laid out with the roads along x and y; :mod:`models_export.scenes.plan` turns the whole world afterwards.
Traffic keeps to the right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from models_export.scenes.mesh import Array, MeshBuilder

REACH_M = 130.0
"""Roads run this far from the origin."""
SPACING_M = 0.5
"""Distance between the points of a route."""


@dataclass(frozen=True, eq=False)
class Route:
    """A way through the world that vehicles drive along."""

    points: Array
    """(P, 2) every ``SPACING_M`` metres, world x, y."""
    phase: int
    """Traffic light group that lets it go; -1 for no light."""
    stop_at_m: float
    """Distance along the route of its stop line; infinite where there is none."""
    speed_mps: float
    """What drivers want to do on its straights."""
    turn_mps: float
    """Speed within its curve."""
    curve_m: tuple[float, float]
    """Where the curve starts and ends along the route; an empty range for none."""
    longest_m: float = np.inf
    """Vehicles longer than this keep out: they would cut its curve."""
    free: bool = False
    """Whether it needs no lights as long as all vehicles are on such routes (right turns at a crossing)."""

    @property
    def turns(self) -> bool:
        """Whether it has a curve."""
        return self.curve_m[1] > self.curve_m[0]

    @property
    def length_m(self) -> float:
        """Length of the route."""
        return SPACING_M * (len(self.points) - 1)


@dataclass(frozen=True)
class Bay:
    """A place for a parked car: position and heading."""

    x: float
    y: float
    yaw: float
    longest_m: float = 5.6


@dataclass(frozen=True)
class Kerbside:
    """How cars park along a road: not at all, along the kerb, or with their noses to it at an angle."""

    depth_m: float
    """Width of the strip between lanes and kerb; a mere gutter where nobody parks."""
    pitch_m: float
    """Distance between bays along the road; 0 for none."""
    angle_rad: float
    """How far cars are turned to the right of the traffic beside them."""

    @property
    def parks(self) -> bool:
        """Whether there are bays."""
        return self.pitch_m > 0

    def bays(self, along: ArrayLike, half_m: float, R: Array) -> list[Bay]:
        """Bays on both sides of a road along x of half width ``half_m``, at places along it, in a frame turned by R (2, 2)."""
        bays = []
        for x in np.atleast_1d(along):
            for side in (1, -1):
                px, py = R @ np.array([x, side * (half_m - 0.49 * self.depth_m)])
                # Traffic keeps right: on the side y > 0 it drives towards -x.
                ahead = R @ np.array([-side, 0.0])
                yaw = float(np.arctan2(ahead[1], ahead[0])) - self.angle_rad
                bays.append(Bay(float(px), float(py), yaw, 5.0 if self.angle_rad else 5.6))
        return bays


def sample_kerbside(rng: np.random.Generator, share: float) -> Kerbside:
    """A random kerbside; on ``share`` of all roads people park, on a third of those at an angle."""
    angle = float(np.deg2rad(rng.uniform(40, 70)))
    kind = rng.random()
    if kind > share:
        return Kerbside(0.4, 0.0, 0.0)
    if kind > share / 3:
        return Kerbside(2.3, 6.2, 0.0)
    return Kerbside(5.0 * np.sin(angle) + 2.0 * np.cos(angle) + 0.2, 2.65 / np.sin(angle), angle)


@dataclass(frozen=True)
class Plot:
    """Land beside the road for a building, trees or nothing: axis-aligned, its front edge on the road side."""

    low: tuple[float, float]
    high: tuple[float, float]


@dataclass(frozen=True, eq=False)
class RoadWorld:
    """The layout of one world."""

    kind: str
    ground: MeshBuilder
    routes: tuple[Route, ...]
    bays: tuple[Bay, ...]
    plots: tuple[Plot, ...]
    poles: tuple[tuple[Array, Array], ...]
    """Camera poles: foot (2,) and the point on the ground (2,) that the camera looks towards."""
    phases: int
    """Number of traffic light groups; 0 without lights."""
    axes_rad: tuple[float, ...]
    """Directions of its lanes, each standing for both ways along it: what a vehicle's rotation is measured from."""
    walks: tuple[Array, ...]
    """Polylines (N, 2) that people walk along."""
    walk_z_m: float
    """Height of the walks."""
    kerbs: tuple[Array, ...] = ()
    """Polylines (N, 2) with the sidewalk on their left; street lamps stand along them."""
    ceiling_lamps: Array | None = None
    """(N, 3) lamps of an indoor world; None outdoors."""

    @property
    def indoor(self) -> bool:
        """Whether there is a roof over it."""
        return self.ceiling_lamps is not None

    def clear_of_routes(self, spot: Array) -> float:
        """Metres (in the larger of x and y) from a spot (2,) to the nearest point of any route."""
        return min(float(np.abs(route.points - spot).max(1).min()) for route in self.routes)


def turned(arm: int) -> Array:
    """Rotation (2, 2) from the frame of an arm (its road comes in along +x from the east) to the world."""
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[arm]
    return np.array([[c, -s], [s, c]], dtype=np.float64)


def rounded(corner: Array, radius: float) -> Array:
    """A polyline of three points (3, 2) with its corner replaced by an arc."""
    a, b, c = corner
    into, out = (b - a) / np.linalg.norm(b - a), (c - b) / np.linalg.norm(c - b)
    center = b - into * radius + out * radius
    angle = np.linspace(0, np.pi / 2, 24)[:, None]
    arc = center - out * radius * np.cos(angle) + into * radius * np.sin(angle)
    return np.concatenate([a[None], arc, c[None]])


def resampled(line: Array) -> Array:
    """A polyline (N, 2) with points every ``SPACING_M``."""
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    distance = np.concatenate([[0], np.cumsum(steps)])
    places = np.arange(0, distance[-1], SPACING_M)
    return np.stack([np.interp(places, distance, line[:, k]) for k in range(2)], 1)


def plot(sx: int, sy: int, low: tuple[float, float], high: tuple[float, float]) -> Plot:
    """A plot given by its corners in the first quarter, mirrored into the quarter with signs ``sx``, ``sy``."""
    corners = np.array([low, high]) * np.array([sx, sy])
    (x0, y0), (x1, y1) = corners.min(0).tolist(), corners.max(0).tolist()
    return Plot((x0, y0), (x1, y1))


def offset(line: Array, distance: float) -> Array:
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
