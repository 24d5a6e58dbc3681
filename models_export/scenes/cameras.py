"""Cameras and where they stand: poles beside the road, and the paper's two layouts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models_export.scenes.layout import SPACING_M, RoadWorld, Route
from models_export.scenes.mesh import Array
from service.errors import InputError
from service.geometry.camera import Camera
from service.geometry.transforms import pole_camera_pose

WIDTH_PX, HEIGHT_PX = 1284, 384
SIZES = ((WIDTH_PX, HEIGHT_PX), (1280, 720), (1242, 375), (960, 540), (1024, 768), (1600, 600), (640, 480))
"""Picture sizes that a mix draws from."""
RIGS = ("poles", "sides", "turn")
"""``poles``: those of the world. ``sides``: front, back and both sides of one place. ``turn``: before and after a turn."""
FOCAL_PX = (450.0, 1300.0)
PITCH_DEG = (5.0, 35.0)
HEIGHT_M = (3.0, 9.0)
_NAMES = {
    "poles": ("north", "west", "south", "east"),
    "sides": ("front", "back", "left", "right"),
    "turn": ("before", "before-back", "after", "after-ahead"),
}
_CLEAR_M = 2.2


@dataclass(frozen=True, eq=False)
class Mount:
    """A place for a camera."""

    foot: Array
    """(2,) world, metres."""
    target: Array
    """(2,) the point on the ground that it looks towards."""
    height_m: tuple[float, float]
    aimed: bool = False
    """Whether its pitch is chosen for the target; otherwise it is drawn."""


@dataclass(frozen=True)
class Optics:
    """What pictures the cameras of a scene take."""

    size: tuple[int, int] | None = (WIDTH_PX, HEIGHT_PX)
    """Width and height, px; None draws one of ``SIZES``."""
    distorted: bool = False
    """Whether the lenses distort."""


def mounts_of(world: RoadWorld, rig: str, rng: np.random.Generator) -> tuple[Mount, ...]:
    """Four places for cameras. Raises InputError when the world has no place for the rig."""
    ceiling = world.ceiling_lamps
    height = HEIGHT_M if ceiling is None else (2.4, float(ceiling[0, 2]) - 0.15)
    if rig == "poles":
        return tuple(Mount(foot, target, height) for foot, target in world.poles)
    if rig == "sides":
        return _sides(world, height, rng)
    return _turn(world, height, rng)


def rig_cameras(
    mounts: tuple[Mount, ...], rig: str, count: int, optics: Optics, rng: np.random.Generator
) -> tuple[Camera, ...]:
    """``count`` cameras (1..8) on four mounts; more than four stand on the same mounts, turned aside, with a number."""
    size = optics.size or SIZES[rng.integers(len(SIZES))]
    names = _NAMES[rig]
    cameras = []
    for index in range(count):
        mount, lap = mounts[index % len(mounts)], index // len(mounts)
        name = names[index % len(mounts)] + (str(lap + 1) if lap else "")
        cameras.append(_camera(name, mount, lap, size, optics.distorted, rng))
    return tuple(cameras)


def _camera(name: str, mount: Mount, lap: int, size: tuple[int, int], distorted: bool, rng: np.random.Generator) -> Camera:
    width, height = size
    position = np.array([*mount.foot, rng.uniform(*mount.height_m)])
    # Long lenses are rarer than wide ones beside a crossing.
    focal = float(np.exp(rng.uniform(*np.log(FOCAL_PX)))) if rng.random() < 0.6 else float(rng.uniform(560, 800))
    focal = float(np.clip(focal * (width / WIDTH_PX) ** 0.5, *FOCAL_PX))
    away = mount.target - mount.foot
    heading = np.arctan2(away[1], away[0]) + lap * np.deg2rad(70)
    pitch = _pitch_deg(position[2], float(np.hypot(*away)) if mount.aimed else None, focal, height, rng)
    center = np.array([width - 1, height - 1]) / 2 + rng.normal(0, 4, 2)
    K = np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]])
    pose = pole_camera_pose(position, heading, np.deg2rad(pitch), np.deg2rad(rng.uniform(-1.5, 1.5)))
    distortion = _sample_distortion(rng, K, size) if distorted else np.zeros(0)
    return Camera(name, width, height, K, pose, distortion)


def _pitch_deg(height_m: float, target_m: float | None, focal: float, height_px: int, rng: np.random.Generator) -> float:
    low, high = PITCH_DEG
    if target_m is not None:
        return float(np.clip(np.rad2deg(np.arctan2(height_m - 0.7, target_m)) + rng.uniform(-2, 2), low, high))
    # Mostly the horizon is in the picture or just above it: a long lens that looks far down would see little road.
    steepest = float(np.clip(np.rad2deg(np.arctan(0.5 * height_px / focal)) + 4, low + 4, high))
    if rng.random() < 0.85:
        return float(rng.uniform(low + 0.3 * (steepest - low), steepest))
    return float(rng.uniform(steepest, min(high, steepest + 12)))


def _sides(world: RoadWorld, height: tuple[float, float], rng: np.random.Generator) -> tuple[Mount, ...]:
    """Front and back over the road at 0 degrees to a lane, left and right beside it at 90 degrees."""
    turning = [r for r in world.routes if not r.turns] or list(world.routes)
    route = turning[int(rng.integers(len(turning)))]
    start = route.points[int(np.linalg.norm(route.points, axis=1).argmin() + rng.integers(-16, 17))]
    heading = route.points[int(np.linalg.norm(route.points - start, axis=1).argmin()) + 1] - start
    along = heading / np.linalg.norm(heading)
    across = np.array([-along[1], along[0]])
    reach = (16.0, 28.0) if not world.indoor else (10.0, 16.0)
    # Front and back hang over the lanes: above a truck outdoors, under the ceiling indoors.
    over = (max(height[0], 5.2), height[1]) if not world.indoor else height
    mounts = [Mount(start + sign * rng.uniform(*reach) * along, start, over, True) for sign in (1, -1)]
    for sign in (1, -1):
        foot = _aside(world, start, sign * across, 7.0 if not world.indoor else 3.0)
        mounts.append(Mount(foot, start, height, True))
    return tuple(mounts)


def _turn(world: RoadWorld, height: tuple[float, float], rng: np.random.Generator) -> tuple[Mount, ...]:
    """Two cameras before a turn, two after it: one of each looks into the turn, one along the road."""
    routes = [r for r in world.routes if r.turns]
    if not routes:
        raise InputError(f"the world {world.kind} has no turn.", field="rig", remedy="Use the rig poles or sides there.")
    route = routes[int(rng.integers(len(routes)))]
    middle = 0.5 * sum(route.curve_m)
    before, after = route.curve_m[0] - rng.uniform(4, 12), route.curve_m[1] + rng.uniform(4, 12)
    if world.indoor:
        before, after = route.curve_m[0] - 3, route.curve_m[1] + 3
    mounts = []
    for place, look in ((before, middle), (before, before - 24), (after, middle), (after, after + 24)):
        here, there = _at(route, place), _at(route, look)
        ahead = _at(route, place + 1) - here
        right = np.array([ahead[1], -ahead[0]]) / np.linalg.norm(ahead)
        foot = _aside(world, here, right, 1.5) if not world.indoor else here + 2.2 * right
        mounts.append(Mount(foot, there, height, world.indoor))
    return tuple(mounts)


def _at(route: Route, s_m: float) -> Array:
    return np.asarray(route.points[int(np.clip(s_m / SPACING_M, 0, len(route.points) - 2))])


def _aside(world: RoadWorld, start: Array, direction: Array, least_m: float) -> Array:
    """The first spot in a direction (2,) from a start (2,) that is clear of all lanes."""
    reach = np.arange(least_m, 40.0, 0.5)
    for distance in reach:
        spot = start + distance * direction
        if world.clear_of_routes(spot) > _CLEAR_M:
            return np.asarray(spot)
    return np.asarray(start + reach[-1] * direction)


def _sample_distortion(rng: np.random.Generator, K: Array, size: tuple[int, int]) -> Array:
    """Coefficients k1 k2 p1 p2 k3 (5,) of a mild lens: up to 12 % barrel or 4 % pincushion at the picture's corner."""
    corner2 = (0.5 * size[0] / K[0, 0]) ** 2 + (0.5 * size[1] / K[1, 1]) ** 2
    k1 = rng.uniform(-0.12, 0.04) / corner2
    k2 = rng.uniform(-0.2, 0.2) * abs(k1) / corner2
    return np.array([k1, k2, *(rng.normal(0, 0.0006, 2)), 0.0])
