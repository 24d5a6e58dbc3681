"""A scene without its pictures: world, light, cameras, and who is where at each step. Needs no OpenGL."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from models_export.scenes.actor import KITTI_CLASS, ActorModel
from models_export.scenes.cameras import Mount, Optics, mounts_of, rig_cameras
from models_export.scenes.film import Film, sample_film
from models_export.scenes.layout import RoadWorld
from models_export.scenes.light import CLEAR_WEATHERS, INDOOR_WEATHERS, OUTDOOR_WEATHERS, Light, sample_light
from models_export.scenes.mesh import Array, Mesh
from models_export.scenes.people import Walker, sample_walkers
from models_export.scenes.request import SceneRequest
from models_export.scenes.roads import WORLDS, build_world
from models_export.scenes.scenario import ROTATION_THRESHOLD_RAD, rotation_from_axes
from models_export.scenes.surroundings import furnish
from models_export.scenes.traffic import Traffic, Vehicle
from service.geometry.transforms import rotation_z, wrap_angle
from service.site import AccuracyModel, Site

START_NS = 1_767_225_600_000_000_000
"""Capture time of every scene's first step: 2026-01-01T00:00:00Z."""
EXACT = AccuracyModel(ground_m=0.02, ground_per_m=0.0, camera_m=0.01, camera_rad=0.0003)
"""Of every site: what is drawn is what its numbers say, up to half a pixel."""
_CROWDED = 0.15
"""Share of hard scenes that are hard by occlusion, in clear weather."""
_TURNING, _NEAR_M = 3, 45.0
"""A moderate scene starts when this many vehicles are rotated this near to the origin; fewer do where few drive."""


@dataclass(frozen=True, eq=False)
class Moment:
    """All road users at one step: N rows, world frame."""

    index: int
    captured_at_ns: int
    ids: list[int]
    models: list[ActorModel]
    poses: Array
    """(N, 3): x, y, yaw in [-pi, pi)."""
    ground: Array
    """(N,) height of what they stand on, metres."""
    velocity: Array
    """(N, 3) m/s."""

    @property
    def dims_lwh(self) -> Array:
        """(N, 3) metres."""
        return np.array([m.dims_lwh for m in self.models]).reshape(-1, 3)

    @property
    def center(self) -> Array:
        """(N, 3) geometric centres, metres."""
        return np.column_stack([self.poses[:, :2], self.ground + 0.5 * self.dims_lwh[:, 2]])

    @property
    def classes(self) -> tuple[str, ...]:
        """KITTI's class of each."""
        return tuple(KITTI_CLASS[m.kind] for m in self.models)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kind of each, finer than the class."""
        return tuple(m.kind for m in self.models)


class ScenePlan:
    """All of a scene that follows from its request. Raises InputError when the request cannot be met."""

    def __init__(self, request: SceneRequest) -> None:
        request.check()
        self.request = request
        rng = np.random.default_rng([request.seed, WORLDS.index(request.world)])
        world_rng, traffic_rng, light_rng, camera_rng, people_rng = rng.spawn(5)
        world = build_world(request.world, world_rng)
        lamp_heads = furnish(world, world_rng)
        weather, self._crowded = _draw_weather(request, world, light_rng)
        self.light: Light = sample_light(light_rng, weather, indoor=world.indoor)
        self._turn_rad = float(world_rng.uniform(-np.pi / 4, np.pi / 4))
        self.axes_rad = tuple(float(a) for a in wrap_angle(np.array(world.axes_rad) + self._turn_rad))
        self.lamp_heads = lamp_heads @ rotation_z(self._turn_rad).T
        self._traffic = self._busy(world, traffic_rng)
        people = int(people_rng.integers(5, 15)) if self._crowded else int(people_rng.integers(0, 8))
        self._walkers = sample_walkers(world, people_rng, people)
        cameras = rig_cameras(
            self._turned_mounts(mounts_of(world, request.rig, camera_rng)),
            request.rig,
            request.cameras,
            Optics(request.size, request.distorted),
            camera_rng,
        )
        self.site = Site(f"scene-{request.seed}", cameras, accuracy=EXACT)
        self.films: tuple[Film, ...] = tuple(sample_film(light_rng, self.light, request.quality) for _ in cameras)
        self._world = world

    def static_mesh(self) -> Mesh:
        """All that does not move, in the world frame."""
        return self._world.ground.build().moved(rotation_z(self._turn_rad), np.zeros(3))

    def moments(self) -> Iterator[Moment]:
        """All steps in order; once only, for traffic moves on."""
        for index in range(self.request.steps):
            if index:
                seconds = 1.0 / self.request.rate_hz
                self._traffic.step(seconds)
                for walker in self._walkers:
                    walker.step(seconds)
            yield self._moment(index)

    def _moment(self, index: int) -> Moment:
        actors: list[Vehicle | Walker] = [*self._traffic.vehicles, *self._walkers]
        R = rotation_z(self._turn_rad)
        poses = np.array([a.pose() for a in actors]).reshape(-1, 3)
        poses[:, :2] = poses[:, :2] @ R[:2, :2].T
        poses[:, 2] = wrap_angle(poses[:, 2] + self._turn_rad)
        ground = np.array([a.ground_m if isinstance(a, Walker) else 0.0 for a in actors])
        velocity = np.array([a.velocity() for a in actors]).reshape(-1, 3) @ R.T
        captured = START_NS + round(index * 1e9 / self.request.rate_hz)
        return Moment(index, captured, [a.id for a in actors], [a.model for a in actors], poses, ground, velocity)

    def _turned_mounts(self, mounts: tuple[Mount, ...]) -> tuple[Mount, ...]:
        R = rotation_z(self._turn_rad)[:2, :2]
        return tuple(Mount(R @ m.foot, R @ m.target, m.height_m, m.aimed) for m in mounts)

    def _busy(self, world: RoadWorld, rng: np.random.Generator) -> Traffic:
        """Traffic that has run for a while, so that queues and gaps look natural."""
        request = self.request
        total = int(rng.integers(16 if self._crowded else 4, 26)) if request.vehicles is None else request.vehicles
        parked = min(int(rng.integers(0, 1 + min(10, total // 2))), len(world.bays))
        if world.indoor:
            total += 8 if request.vehicles is None else 0
            parked = max(parked, min(total - int(rng.integers(1, 6)), len(world.bays)), 0)
        turning = {"easy": False, "moderate": True}.get(request.scenario or "")
        traffic = Traffic(world, rng, total - parked, parked, lamps_on=self.light.lamps_on, turning=turning)
        traffic.step(float(rng.uniform(8.0, 20.0)))
        if turning:
            _await_turns(traffic)
        return traffic


def _await_turns(traffic: Traffic) -> None:
    """Let time pass until some vehicles are about to turn, for a minute at most."""
    axes = traffic.world.axes_rad
    for _ in range(240):
        poses = np.array([v.pose() for v in traffic.vehicles if v.route is not None]).reshape(-1, 3)
        rotated = rotation_from_axes(poses[:, 2], axes) > ROTATION_THRESHOLD_RAD
        if np.sum(rotated & (np.abs(poses[:, :2]).max(1) < _NEAR_M)) >= min(_TURNING, 1 + len(poses) // 5):
            return
        traffic.step(0.25)


def _draw_weather(request: SceneRequest, world: RoadWorld, rng: np.random.Generator) -> tuple[str | None, bool]:
    """The weather, None for any, and whether the scene is to be crowded."""
    if request.scenario is None or request.weather is not None:
        return request.weather, request.scenario == "hard" and request.weather in CLEAR_WEATHERS
    crowded = request.scenario == "hard" and bool(rng.random() < _CROWDED)
    clear = request.scenario != "hard" or crowded
    choices = [w for w in (INDOOR_WEATHERS if world.indoor else OUTDOOR_WEATHERS) if (w in CLEAR_WEATHERS) == clear]
    return str(rng.choice(choices)), crowded
