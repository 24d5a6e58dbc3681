"""Moving traffic: vehicles follow routes, keep their gaps (intelligent driver model), obey lights, and never overlap."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from models_export.scenes.actor import ActorModel
from models_export.scenes.layout import REACH_M, SPACING_M, Bay, RoadWorld, Route
from models_export.scenes.mesh import Array
from models_export.scenes.vehicles import LONGEST_M, sample_vehicle

ENTRY_M = 85.0
"""Vehicles come in and leave at about this distance from the origin."""
_LOOK_M = 45.0
_MAX_STEP_S = 0.2
_ACCELERATION, _BRAKING = 2.0, 2.5
_GAP_M, _HEADWAY_S = 2.0, 1.2
_HARD_GAP_M = 0.6
_SIDE_GAP_M = 0.35
_YELLOW_S = 3.0
_FREE_M = 1e6
_PROBES = np.linspace(-0.5, 0.5, 7)
"""Places along a vehicle where others look for it; close enough to find a bus that crosses."""


@dataclass(eq=False)
class Vehicle:
    """One vehicle of the simulation."""

    id: int
    model: ActorModel
    route: Route | None
    """None for parked ones."""
    s_m: float = 0.0
    """Distance of its centre along the route."""
    speed_mps: float = 0.0
    eagerness: float = 1.0
    """Its desired speed as a fraction of the route's."""
    sway_phase: float = 0.0
    parked_pose: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def pose(self, s_m: float | None = None) -> Array:
        """Centre x, y and heading (3,), metres and radians; at another place along the route if given."""
        if self.route is None:
            return np.array(self.parked_pose)
        s = self.s_m if s_m is None else s_m
        axles = s + np.array([-0.30, 0.325]) * self.model.dims_lwh[0]
        ends = _along(self.route, axles)
        # Wide vehicles have no room to wander in their lane.
        sway = (0.22 if self.model.dims_lwh[1] < 2.06 else 0.06) * np.sin(axles / 17.0 + self.sway_phase)
        heading = np.arctan2(*(ends[1] - ends[0])[::-1])
        ends = ends + sway[:, None] * np.array([-np.sin(heading), np.cos(heading)])
        heading = np.arctan2(*(ends[1] - ends[0])[::-1])
        center = ends[0] + 0.30 / 0.625 * (ends[1] - ends[0])
        return np.array([*center, heading])

    def velocity(self) -> Array:
        """Velocity of the centre (3,), m/s."""
        if self.route is None or self.speed_mps == 0.0:
            return np.zeros(3)
        step = (self.pose(self.s_m + 0.05) - self.pose(self.s_m - 0.05))[:2]
        return np.array([*(step / np.linalg.norm(step) * self.speed_mps), 0.0])


def _along(route: Route, s_m: Array) -> Array:
    """Points (N, 2) at distances (N,) along a route, extended straight at both ends."""
    places = s_m / SPACING_M
    index = np.clip(places.astype(np.int64), 0, len(route.points) - 2)
    a, b = route.points[index], route.points[index + 1]
    return np.asarray(a + (places - index)[:, None] * (b - a))


@dataclass(eq=False)
class _Lights:
    """One approach at a time gets green; the next one only when the crossing is empty."""

    phases: int
    green_s: float
    phase: int
    left_s: float = 0.0
    go: bool = True

    def step(self, dt: float, crossing_empty: bool) -> None:
        self.left_s -= dt
        if self.go and self.left_s < _YELLOW_S:
            self.go = False
        elif not self.go and self.left_s < 0 and crossing_empty:
            self.phase = (self.phase + 1) % self.phases
            self.left_s, self.go = self.green_s, True


@dataclass(eq=False)
class Traffic:
    """All vehicles of a world over time. ``step`` advances; ``vehicles`` is the present state."""

    world: RoadWorld
    rng: np.random.Generator
    moving: int
    parked: int
    lamps_on: bool = False
    turning: bool | None = None
    """True lets only vehicles in that turn where they can; False only such that go straight on, and no angled parking."""
    vehicles: list[Vehicle] = field(default_factory=list)
    _next_id: int = 1
    _lights: _Lights | None = None
    _routes: tuple[Route, ...] = ()

    def __post_init__(self) -> None:
        chosen = tuple(r for r in self.world.routes if self.turning is None or r.turns == self.turning)
        self._routes = chosen or self.world.routes
        # Where all turn, many a crossing has right turns only: they flow from all sides without lights.
        free = tuple(r for r in self._routes if r.free)
        lively = bool(self.turning and free and self.rng.random() < 0.6)
        self._routes = free if lively else self._routes
        if self.world.phases and not lively:
            phase = int(self.rng.integers(self.world.phases))
            self._lights = _Lights(self.world.phases, float(self.rng.uniform(7, 12)), phase, float(self.rng.uniform(4, 12)))
        bays = [b for b in self.world.bays if self.turning is not False or self._aligned(b)]
        for bay in (bays[k] for k in self.rng.permutation(len(bays))[: self.parked]):
            x, y = bay.x + self.rng.normal(0, 0.25), bay.y + self.rng.normal(0, 0.05)
            backwards = np.pi if self.rng.random() < 0.12 else 0.0
            vehicle = self._new(None, bay.longest_m)
            vehicle.parked_pose = (float(x), float(y), float(bay.yaw + backwards + self.rng.normal(0, 0.02)))
            self.vehicles.append(vehicle)
        for _ in range(40 * self.moving):
            if sum(v.route is not None for v in self.vehicles) >= self.moving:
                break
            self._try_spawn(anywhere=True)

    def step(self, seconds: float) -> None:
        """Advance time, in steps of at most 0.2 s."""
        count = max(1, int(np.ceil(seconds / _MAX_STEP_S - 1e-9)))
        for _ in range(count):
            self._advance(seconds / count)

    def _aligned(self, bay: Bay) -> bool:
        """Whether cars in a bay stand along a lane's direction."""
        return any(abs(np.sin(bay.yaw - axis)) < 0.05 for axis in self.world.axes_rad)

    def _new(self, route: Route | None, longest_m: float) -> Vehicle:
        vehicle = Vehicle(
            self._next_id,
            sample_vehicle(self.rng, lamps_on=self.lamps_on and route is not None, longest_m=min(longest_m, LONGEST_M)),
            route,
            eagerness=float(self.rng.uniform(0.75, 1.15)),
            sway_phase=float(self.rng.uniform(0, 2 * np.pi)),
        )
        self._next_id += 1
        return vehicle

    def _try_spawn(self, *, anywhere: bool) -> None:
        route = self._routes[self.rng.integers(len(self._routes))]
        first = REACH_M - ENTRY_M
        end = route.length_m - first
        vehicle = None
        s = float(self.rng.uniform(first, end)) if anywhere else first
        # Not where it could no longer stop at a red light, nor within the crossing.
        in_box = route.stop_at_m - 14 < s < route.stop_at_m + 50
        if not (anywhere and in_box):
            place = _along(route, np.array([s]))[0]
            others = [(v.pose()[:2], v.model.dims_lwh[0]) for v in self.vehicles if v.route is not None]
            candidate = self._new(route, route.longest_m)
            room = 0.5 * candidate.model.dims_lwh[0] + (4.5 if anywhere else 9.5)
            if all(np.hypot(*(o - place)) > room + 0.5 * long or _beside(o, place, route, s) for o, long in others):
                vehicle = candidate
        if vehicle is not None:
            vehicle.s_m = s
            vehicle.speed_mps = route.speed_mps * vehicle.eagerness * (0.5 if anywhere else 0.9)
            self.vehicles.append(vehicle)

    def _advance(self, dt: float) -> None:
        movers = [v for v in self.vehicles if v.route is not None]
        snapshot = _snapshot(movers)
        new = [self._next_speed(i, v, snapshot, dt) for i, v in enumerate(movers)]
        for vehicle, speed in zip(movers, new, strict=True):
            vehicle.s_m += 0.5 * dt * (vehicle.speed_mps + speed) if speed > 0 else 0.0
            vehicle.speed_mps = speed
        if self._lights is not None:
            self._lights.step(dt, not any(_in_crossing(v) for v in movers))
        leave = REACH_M - ENTRY_M
        gone = {id(v) for v in movers if v.route is not None and v.s_m > v.route.length_m - leave}
        self.vehicles = [v for v in self.vehicles if id(v) not in gone]
        if sum(v.route is not None for v in self.vehicles) < self.moving and self.rng.random() < 0.5:
            self._try_spawn(anywhere=False)

    def _next_speed(self, i: int, v: Vehicle, snapshot: _Snapshot, dt: float) -> float:
        assert v.route is not None
        gap, lead_speed = _gap_ahead(i, v, snapshot)
        a = _idm(v.speed_mps, _wanted_speed(v), gap, lead_speed)
        if self._lights is not None and not (self._lights.go and self._lights.phase == v.route.phase):
            to_line = v.route.stop_at_m - v.s_m - 0.5 * v.model.dims_lwh[0]
            if to_line > 0 and v.speed_mps**2 / (2 * 4.5) < to_line:
                a = min(a, _idm(v.speed_mps, _wanted_speed(v), to_line + 1.5, 0.0))
                gap = min(gap, to_line + _HARD_GAP_M)
        speed = max(0.0, v.speed_mps + dt * max(a, -8.0))
        return min(speed, max(0.0, (gap - _HARD_GAP_M) / dt))


def _beside(other: Array, place: Array, route: Route, s: float) -> bool:
    """Whether another position is in a neighbouring lane rather than in the way."""
    ahead = _along(route, np.array([s, s + 1.0]))
    direction = ahead[1] - ahead[0]
    lateral = abs(direction[0] * (other - place)[1] - direction[1] * (other - place)[0])
    return bool(lateral > 2.8)


def _in_crossing(v: Vehicle) -> bool:
    """Whether a vehicle is past its stop line and not yet clear of the crossing."""
    assert v.route is not None
    half = 0.5 * v.model.dims_lwh[0]
    passed = v.s_m + half - v.route.stop_at_m
    inside = REACH_M - v.route.stop_at_m
    return bool(passed > 0.3 and np.abs(v.pose()[:2]).max() < inside + half) if passed > 0.3 else False


@dataclass(frozen=True, eq=False)
class _Snapshot:
    """Where N vehicles are at one instant."""

    points: Array
    """(7 N, 2) from rear to front of every vehicle."""
    owner: NDArray[np.int64]
    """(7 N,) whose they are."""
    widths: Array
    speeds: Array
    headings: Array


def _snapshot(movers: list[Vehicle]) -> _Snapshot:
    poses = np.array([v.pose() for v in movers]).reshape(-1, 3)
    dims = np.array([v.model.dims_lwh for v in movers]).reshape(-1, 3)
    shifts = _PROBES * dims[:, :1]
    direction = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], 1)
    points = poses[:, None, :2] + shifts[..., None] * direction[:, None]
    speeds = np.array([v.speed_mps for v in movers])
    return _Snapshot(points.reshape(-1, 2), np.repeat(np.arange(len(movers)), len(_PROBES)), dims[:, 1], speeds, poses[:, 2])


def _gap_ahead(i: int, v: Vehicle, now: _Snapshot) -> tuple[float, float]:
    """Free metres before the bumper along the route, and the speed along it of what comes then."""
    assert v.route is not None
    half = 0.5 * v.model.dims_lwh[0]
    first = max(0, int(v.s_m / SPACING_M))
    lane = v.route.points[first : first + int((half + _LOOK_M) / SPACING_M)]
    if not len(lane):
        return _FREE_M, 0.0
    index = np.flatnonzero((now.owner != i) & (np.abs(now.points - lane[len(lane) // 2]).max(1) < _LOOK_M))
    distance = np.hypot(*(now.points[index, None] - lane[None]).transpose(2, 0, 1))
    nearest = distance.argmin(1)
    reach = 0.5 * (now.widths[i] + now.widths[now.owner[index]]) + _SIDE_GAP_M
    # What is nearest to the route's first points is beside this vehicle or behind it.
    ahead = (distance[np.arange(len(index)), nearest] < reach) & (nearest > 1)
    if not ahead.any():
        return _FREE_M, 0.0
    index, nearest = index[ahead], nearest[ahead]
    hit = nearest.argmin()
    who = now.owner[index[hit]]
    gap = (first + nearest[hit]) * SPACING_M - v.s_m - half
    return float(gap), float(max(0.0, now.speeds[who] * np.cos(now.headings[who] - now.headings[i])))


def _wanted_speed(v: Vehicle) -> float:
    assert v.route is not None
    wanted = v.route.speed_mps * v.eagerness
    start, stop = v.route.curve_m
    if stop > start and v.s_m < stop:
        wanted = min(wanted, float(np.sqrt(v.route.turn_mps**2 + 2 * 1.6 * max(0.0, start - v.s_m))))
    return wanted


def _idm(speed: float, wanted: float, gap: float, lead_speed: float) -> float:
    """Acceleration of the intelligent driver model (Treiber, Hennecke, Helbing 2000), m/s^2."""
    closing = speed * (speed - lead_speed) / (2 * np.sqrt(_ACCELERATION * _BRAKING))
    star = _GAP_M + max(0.0, speed * _HEADWAY_S + closing)
    return float(_ACCELERATION * (1 - (speed / wanted) ** 4 - (star / max(gap, 0.3)) ** 2))
