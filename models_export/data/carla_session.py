"""A connection to a CARLA server that leaves the server as it was found: settings, weather, scenery, traffic, sensors.

In synchronous mode a server waits for its client's ticks; a client that goes without restoring the settings leaves it
standing still. So everything that a session changes is undone when it closes, whatever ended it, and a step of that which
fails does not keep the others from being done.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any

from models_export.data.carla_convert import CarlaPose
from models_export.data.carla_rig import Rig
from models_export.data.carla_weather import PRESETS, Weather
from service.errors import NotFoundError, QuadliftError
from service.site import OriginModel

if TYPE_CHECKING:
    import carla

MAX_TICK_S = 0.1
"""Longest tick: CARLA's physics takes at most ten substeps of 10 ms."""
UNDO_TIMEOUT_S = 5.0
"""For each answer while a session closes: the server may be gone."""
START_REMEDY = (
    "Start one: `./CarlaUE4.sh -RenderOffScreen` in CARLA's folder, or "
    "`docker run --rm --gpus all --net=host carlasim/carla:0.9.16 bash CarlaUE4.sh -RenderOffScreen -nosound`; "
    "it needs about half a minute. See docs/carla.md."
)
_PARKED = ("Car", "Truck", "Bus", "Motorcycle", "Bicycle")


@dataclass(frozen=True)
class ServerOptions:
    """Where the server is, and how long to wait for it."""

    host: str = "127.0.0.1"
    port: int = 2000
    traffic_port: int = 8000
    """Port that the traffic manager listens on, in this process."""
    timeout_s: float = 30.0
    """For any answer; loading a map may take most of it."""
    picture_timeout_s: float = 10.0
    """For the pictures of one frame."""


def import_carla() -> ModuleType:
    """CARLA's client package. Raises NotFoundError saying how to install it."""
    try:
        import carla
    except ImportError as error:
        raise NotFoundError(
            f"CARLA's Python client cannot be imported: {error}.",
            field="carla",
            remedy="Run: pip install 'quadlift[carla]' (Linux or Windows on x86-64).",
        ) from error
    module: ModuleType = carla
    return module


def connect(carla_module: Any, options: ServerOptions) -> carla.Client:
    """A client whose server answers and is of the same version. Raises QuadliftError saying how to start one."""
    client = carla_module.Client(options.host, options.port)
    client.set_timeout(options.timeout_s)
    address = f"{options.host}:{options.port}"
    try:
        server, own = client.get_server_version(), client.get_client_version()
    except RuntimeError as error:
        raise QuadliftError(f"no CARLA server answers: {error}.", field=address, remedy=START_REMEDY) from error
    if server != own:
        raise QuadliftError(
            f"the server is CARLA {server}, the client package {own}.",
            field=address,
            remedy=f"Start a server of version {own}, or install the package of version {server}.",
        )
    return client


class Session:
    """One map under this client's control; made by :func:`open_session`."""

    def __init__(self, carla_module: Any, client: carla.Client, world: carla.World, options: ServerOptions) -> None:
        self.carla, self.client, self.world, self.options = carla_module, client, world, options
        self.map: carla.Map = world.get_map()
        self.map_name = str(self.map.name).rsplit("/", 1)[-1]
        self.traffic: carla.TrafficManager = client.get_trafficmanager(options.traffic_port)
        self._spawned: list[int] = []

    def transform(self, pose: CarlaPose) -> carla.Transform:
        """A pose as the package has it."""
        location = self.carla.Location(pose.x, pose.y, pose.z)
        return self.carla.Transform(location, self.carla.Rotation(pose.pitch, pose.yaw, pose.roll))

    def keep(self, actor: carla.Actor) -> carla.Actor:
        """Note an actor to be destroyed when the session closes."""
        self._spawned.append(actor.id)
        return actor

    def destroy_actors(self) -> None:
        """Destroy what the session spawned, in one message; what is already gone does not matter."""
        commands = [self.carla.command.DestroyActor(number) for number in reversed(self._spawned)]
        self._spawned = []
        self.client.apply_batch_sync(commands, False)

    def tick(self) -> carla.WorldSnapshot:
        """Let the world go on by one tick; gives its state. Raises QuadliftError when the state is of another frame."""
        frame = self.world.tick(self.options.timeout_s)
        snapshot = self.world.get_snapshot()
        if snapshot.frame != frame:
            raise QuadliftError(
                f"asked for frame {frame}, the world is at {snapshot.frame}.",
                field="tick",
                remedy="Another client ticks this server: stop it.",
            )
        return snapshot


@contextmanager
def open_session(
    carla_module: Any, options: ServerOptions, map_name: str | None, tick_s: float, weather: Weather, seed: int
) -> Iterator[Session]:
    """A session in synchronous mode, its weather set and parked scenery cars hidden, all undone at the end.

    tick_s: simulated seconds a tick. Raises QuadliftError when there is no server, or when it stops answering.
    """
    client = connect(carla_module, options)
    try:
        with ExitStack() as undo:
            world = _world(client, map_name)
            session = Session(carla_module, client, world, options)
            undo.callback(session.destroy_actors)
            _set_weather(session, weather, undo)
            _hide_parked(session, undo)
            _synchronise(session, tick_s, seed, undo)
            undo.callback(client.set_timeout, min(options.timeout_s, UNDO_TIMEOUT_S))
            yield session
    except RuntimeError as error:
        # What the client raises when the server is gone, or says no.
        raise QuadliftError(f"the CARLA server failed: {error}.", field="carla", remedy=START_REMEDY) from error


def ticks_a_step(rate_hz: float) -> int:
    """Ticks for each recorded step, so that none is longer than ``MAX_TICK_S``."""
    return max(1, math.ceil(1.0 / (rate_hz * MAX_TICK_S) - 1e-9))


def site_origin(session: Session, rig: Rig) -> OriginModel:
    """WGS84 position of the rig's anchor by the map's own projection.

    Some releases (0.9.16) mirror the latitude: a map's y points South, yet their latitude grows with it. The map is asked
    at a point on either side, and the mirrored point taken where it does so.
    """
    anchor = rig.anchor

    def locate(x: float, y: float, z: float) -> carla.GeoLocation:
        return session.map.transform_to_geolocation(session.carla.Location(x, y, z))

    mirrored = locate(0.0, 100.0, 0.0).latitude > locate(0.0, -100.0, 0.0).latitude
    found = locate(anchor.x, -anchor.y if mirrored else anchor.y, anchor.z)
    return OriginModel(lat=found.latitude, lon=found.longitude, alt=found.altitude)


def _world(client: carla.Client, map_name: str | None) -> carla.World:
    world = client.get_world()
    if map_name is None or str(world.get_map().name).rsplit("/", 1)[-1] == map_name:
        return world
    known = sorted(str(name).rsplit("/", 1)[-1] for name in client.get_available_maps())
    if map_name not in known:
        raise NotFoundError(f"the server has no map '{map_name}'.", field="map", remedy=f"It has: {', '.join(known)}.")
    return client.load_world(map_name)


def _set_weather(session: Session, weather: Weather, undo: ExitStack) -> None:
    undo.callback(session.world.set_weather, session.world.get_weather())
    session.world.set_weather(session.carla.WeatherParameters(**PRESETS[weather]))


def _hide_parked(session: Session, undo: ExitStack) -> None:
    """Cars that are part of the map have no actor, hence no truth: they must not be in the pictures."""
    labels = session.carla.CityObjectLabel
    parked = {thing.id for name in _PARKED for thing in session.world.get_environment_objects(getattr(labels, name))}
    if parked:
        undo.callback(session.world.enable_environment_objects, parked, True)
        session.world.enable_environment_objects(parked, False)


def _synchronise(session: Session, tick_s: float, seed: int, undo: ExitStack) -> None:
    """Synchronous mode with a fixed tick, for the world and the traffic manager."""
    world, traffic = session.world, session.traffic
    undo.callback(traffic.set_synchronous_mode, False)
    traffic.set_synchronous_mode(True)
    traffic.set_random_device_seed(seed)
    undo.callback(world.apply_settings, world.get_settings())
    settings = world.get_settings()
    settings.synchronous_mode = True
    settings.fixed_delta_seconds = tick_s
    settings.no_rendering_mode = False
    settings.substepping = True
    settings.max_substep_delta_time = 0.01
    settings.max_substeps = 10
    settings.deterministic_ragdolls = True
    world.apply_settings(settings)
    # Windows count as part of their vehicle, in ids and depth alike.
    world.set_annotations_traverse_translucency(False)
