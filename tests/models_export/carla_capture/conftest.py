"""A small CARLA world in memory. Its values (transforms, boxes, weather, settings) are the real client package's; the fakes
stand for what needs a server, and ``test_names.py`` sees to it that they have no public name that the package has not."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from models_export.data.carla_capture import CaptureRequest, Progress, capture
from models_export.data.carla_rig import parse_rig
from models_export.data.carla_session import ServerOptions

try:
    import carla
except ImportError:
    carla = None

WIDTH, HEIGHT, FOV = 192, 112, 80.0
FIRST_ID = 70_000
"""Above sixteen bits: the instance pictures hold the lower ones only."""
XODR = """<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="4" name="" version="1" date="" north="0" south="0"
east="0" west="0"><geoReference><![CDATA[+proj=tmerc +lat_0=48 +lon_0=11 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs]]>
</geoReference></header><road name="r" length="100" id="0" junction="-1"><planView><geometry s="0" x="0" y="0" hdg="0"
length="100"><line/></geometry></planView><lanes><laneSection s="0"><center><lane id="0" type="none" level="false"/></center>
<right><lane id="-1" type="driving" level="false"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></right></laneSection>
</lanes></road></OpenDRIVE>"""
RIG = {
    "id": "junction",
    "anchor": {"x": 40.0, "y": -25.0, "z": 0.0},
    "cameras": [
        {
            "id": "north", "width": WIDTH, "height": HEIGHT, "fov_deg": FOV,
            "location": {"x": 20.0, "y": -25.0, "z": 6.0}, "rotation": {"pitch": -14.0},
        },
        {
            "id": "east", "width": WIDTH, "height": HEIGHT, "fov_deg": FOV,
            "location": {"x": 40.0, "y": -5.0, "z": 7.0}, "rotation": {"pitch": -20.0, "yaw": -90.0, "roll": 2.0},
        },
    ],
}  # fmt: skip
KINDS = {"sensor.camera.rgb": "rgb", "sensor.camera.depth": "depth", "sensor.camera.instance_segmentation": "instance"}


class FakeAttribute:
    def __init__(self, value: str, choices: tuple[str, ...] = ()) -> None:
        self._value, self.recommended_values = value, list(choices)

    def as_int(self) -> int:
        return int(self._value)


class FakeBlueprint:
    def __init__(self, name: str, attributes: dict[str, FakeAttribute], base_type: str = "") -> None:
        self.id, self._attributes, self._base_type = name, attributes, base_type
        self._set: dict[str, str] = {}

    def has_attribute(self, id: str) -> bool:
        return id in self._attributes

    def get_attribute(self, id: str) -> FakeAttribute:
        return self._attributes[id]

    def set_attribute(self, id: str, value: str) -> None:
        assert isinstance(value, str)
        self._set[id] = value


class FakeLibrary:
    def __init__(self) -> None:
        color = FakeAttribute("0,0,0", ("1,2,3", "4,5,6"))
        four, two = {"number_of_wheels": FakeAttribute("4"), "color": color}, {"number_of_wheels": FakeAttribute("2")}
        self._all = [
            FakeBlueprint("vehicle.b.van", dict(four), "van"),
            FakeBlueprint("vehicle.a.sedan", dict(four), "car"),
            FakeBlueprint("vehicle.c.bike", two, "bicycle"),
        ]

    def filter(self, wildcard_pattern: str) -> list[FakeBlueprint]:
        assert wildcard_pattern == "vehicle.*"
        return self._all

    def find(self, id: str) -> FakeBlueprint:
        return FakeBlueprint(id, {})


class FakeActor:
    def __init__(self, number: int, type_id: str, transform: Any, base_type: str = "") -> None:
        self.id, self.type_id = number, type_id
        self.attributes = {"base_type": base_type} if base_type else {}
        self.bounding_box = carla.BoundingBox(carla.Location(0.1, 0.0, 0.75), carla.Vector3D(2.2, 0.9, 0.75))
        self._transform, self._velocity, self._port, self._alive = transform, carla.Vector3D(), None, True

    def set_autopilot(self, enabled: bool = True, port: int = 8000) -> None:
        self._port = port if enabled else None
        forward = self._transform.get_forward_vector()
        self._velocity = carla.Vector3D(6.0 * forward.x, 6.0 * forward.y, 0.0)


class FakeSensor:
    def __init__(self, number: int, blueprint: FakeBlueprint, transform: Any) -> None:
        self.id, self._kind, self._set, self._transform = number, KINDS[blueprint.id], blueprint._set, transform
        self._callback: Callable[[Any], None] | None = None

    def listen(self, callback: Callable[[Any], None]) -> None:
        self._callback = callback

    def stop(self) -> None:
        self._callback = None


class FakeState:
    def __init__(self, actor: FakeActor) -> None:
        at, turn = actor._transform.location, actor._transform.rotation
        self._transform = carla.Transform(carla.Location(at.x, at.y, at.z), carla.Rotation(turn.pitch, turn.yaw, turn.roll))
        self._velocity = actor._velocity

    def get_transform(self) -> Any:
        return self._transform

    def get_velocity(self) -> Any:
        return self._velocity


class FakeSnapshot:
    def __init__(self, frame: int, actors: list[FakeActor]) -> None:
        self.frame, self._states = frame, {actor.id: FakeState(actor) for actor in actors}

    def find(self, actor_id: int) -> FakeState | None:
        return self._states.get(actor_id)


class FakeActorList(list[FakeActor]):
    def filter(self, wildcard_pattern: str) -> FakeActorList:
        return FakeActorList(a for a in self if a.type_id.startswith(wildcard_pattern.rstrip("*")))


class FakeMap:
    def __init__(self) -> None:
        self.name, self._real = "Carla/Maps/Town99", carla.Map("Town99", XODR)

    def get_spawn_points(self) -> list[Any]:
        near = [(48.0, -25.0, 0.0), (60.0, -29.0, 180.0), (40.0, -35.0, 90.0), (36.0, -18.0, 35.0), (55.0, -22.0, 10.0)]
        points = [*near, (400.0, 0.0, 0.0)]
        return [carla.Transform(carla.Location(x, y, 0.0), carla.Rotation(yaw=yaw)) for x, y, yaw in points]

    def transform_to_geolocation(self, location: Any) -> Any:
        return self._real.transform_to_geolocation(location)


class FakeTraffic:
    def __init__(self, log: list[str]) -> None:
        self._log = log

    def set_synchronous_mode(self, mode_switch: bool) -> None:
        self._log.append(f"traffic sync {mode_switch}")

    def set_random_device_seed(self, value: int) -> None:
        self._log.append(f"traffic seed {value}")

    def set_global_distance_to_leading_vehicle(self, distance: float) -> None:
        self._log.append(f"gap {distance}")

    def update_vehicle_lights(self, actor: FakeActor, do_update: bool) -> None:
        assert do_update


class FakeWorld:
    """A flat road with boxes on it; faults of the sensors are given by (camera's number, kind)."""

    def __init__(self) -> None:
        self._log: list[str] = []
        self._map, self._library, self._traffic = FakeMap(), FakeLibrary(), FakeTraffic(self._log)
        self._settings, self._weather, self._frame = carla.WorldSettings(), carla.WeatherParameters(cloudiness=77.0), 1000
        self._settings.fixed_delta_seconds = None
        self._actors: list[FakeActor] = []
        self._sensors: list[FakeSensor] = []
        self._next_id, self._spawned = FIRST_ID, 0
        self._parked = {101: True, 102: True}
        self._lost: Callable[[int, FakeSensor], bool] = lambda frame, sensor: False
        self._after_tick: Callable[[int], None] = lambda frame: None
        self._reverse = self._wrong_ids = self._deaf = False
        self._held: list[tuple[FakeSensor, Any]] = []

    def get_map(self) -> FakeMap:
        return self._map

    def get_settings(self) -> Any:
        copy = carla.WorldSettings()
        for name in ("synchronous_mode", "fixed_delta_seconds", "no_rendering_mode", "max_substeps"):
            setattr(copy, name, getattr(self._settings, name))
        return copy

    def apply_settings(self, settings: Any, seconds: float = 0.0) -> int:
        self._settings = settings
        self._log.append(f"sync {settings.synchronous_mode}")
        return self._frame

    def get_weather(self) -> Any:
        return self._weather

    def set_weather(self, weather: Any) -> None:
        self._weather = weather

    def get_environment_objects(self, object_type: Any = None) -> list[Any]:
        if object_type != carla.CityObjectLabel.Car:
            return []
        return [SimpleNamespace(id=number) for number in self._parked]

    def enable_environment_objects(self, env_objects_ids: set[int], enable: bool) -> None:
        self._parked.update(dict.fromkeys(env_objects_ids, enable))

    def set_annotations_traverse_translucency(self, enable: bool) -> None:
        self._log.append(f"through glass {enable}")

    def get_blueprint_library(self) -> FakeLibrary:
        return self._library

    def try_spawn_actor(self, blueprint: FakeBlueprint, transform: Any) -> FakeActor | None:
        self._spawned += 1
        if self._spawned == 2:
            return None
        self._next_id += 1
        actor = FakeActor(self._next_id, blueprint.id, transform, blueprint._base_type)
        self._actors.append(actor)
        return actor

    def spawn_actor(self, blueprint: FakeBlueprint, transform: Any) -> FakeSensor:
        self._next_id += 1
        self._sensors.append(FakeSensor(self._next_id, blueprint, transform))
        return self._sensors[-1]

    def get_actors(self) -> FakeActorList:
        return FakeActorList(self._actors)

    def get_snapshot(self) -> FakeSnapshot:
        return FakeSnapshot(self._frame + self._deaf, self._actors)

    def tick(self, seconds: float = 0.0) -> int:
        assert self._settings.synchronous_mode
        self._frame += 1
        dt = self._settings.fixed_delta_seconds
        for actor in self._actors:
            at, v = actor._transform.location, actor._velocity
            actor._transform.location = carla.Location(at.x + v.x * dt, at.y + v.y * dt, at.z)
        self._deliver()
        self._after_tick(self._frame)
        return self._frame

    def _as_found(self) -> bool:
        """Whether everything that a capture changes is as at the start."""
        idle = (self._settings.synchronous_mode, self._settings.fixed_delta_seconds) == (False, None)
        empty = not self._sensors and not any(actor.id > FIRST_ID for actor in self._actors)
        return idle and empty and self._weather.cloudiness == 77.0 and all(self._parked.values())

    def _deliver(self) -> None:
        fresh = [(s, self._image(s)) for s in self._sensors if s._callback and not self._lost(self._frame, s)]
        self._held += fresh
        # Pictures of two ticks come in the wrong order, from another thread, as CARLA's do.
        if self._reverse and self._frame % 2:
            return
        held, self._held = self._held[:: -1 if self._reverse else 1], []

        def send() -> None:
            for sensor, image in held:
                callback = sensor._callback
                if callback:
                    callback(image)

        threading.Thread(target=send).start()

    def _image(self, sensor: FakeSensor) -> Any:
        entry, owner = self._cast(sensor._transform)
        if sensor._kind == "depth":
            value = np.round(np.minimum(entry, 1000.0) / 1000.0 * (2**24 - 1)).astype(np.int64)
            channels = [value >> 16, (value >> 8) & 255, value & 255]
        elif sensor._kind == "instance":
            ids = np.where(owner > 0, owner + (7 if self._wrong_ids else 0), 0)
            channels = [(ids >> 8) & 255, ids & 255, np.where(owner > 0, 14, 1)]
        else:
            channels = [np.full(owner.shape, 90), owner * 53 % 200, np.where(owner > 0, 200, 60)]
        raw = np.stack([*channels, np.full(owner.shape, 255)], -1).astype(np.uint8).tobytes()
        return FakeImage(self._frame, raw, sensor)

    def _cast(self, transform: Any) -> tuple[np.ndarray, np.ndarray]:
        """Depth and actor of each pixel by CARLA's own matrices, left-handed throughout."""
        u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
        f = WIDTH / 2 / np.tan(np.deg2rad(FOV / 2))
        rays = np.stack([np.ones_like(u), (u - WIDTH / 2) / f, (HEIGHT / 2 - v) / f], -1)
        M = np.array(transform.get_matrix())
        start, along = M[:3, 3], rays @ M[:3, :3].T
        with np.errstate(divide="ignore"):
            depth = np.where(along[..., 2] < 0, -start[2] / along[..., 2], np.inf)
        owner = np.zeros(depth.shape, np.int64)
        for actor in self._actors:
            box, inverse = actor.bounding_box, np.array(actor._transform.get_inverse_matrix())
            offset = np.array([box.location.x, box.location.y, box.location.z])
            half = np.array([box.extent.x, box.extent.y, box.extent.z])
            s, a = inverse[:3, :3] @ start + inverse[:3, 3] - offset, along @ inverse[:3, :3].T
            with np.errstate(divide="ignore"):
                low, high = (-half - s) / a, (half - s) / a
            near, far = np.minimum(low, high).max(-1), np.maximum(low, high).min(-1)
            hit = (near < far) & (near > 0) & (near < depth)
            depth, owner = np.where(hit, near, depth), np.where(hit, actor.id, owner)
        return depth, owner


class FakeImage:
    def __init__(self, frame: int, raw: bytes, sensor: FakeSensor) -> None:
        self.frame, self.raw_data, self.transform = frame, raw, sensor._transform
        self.width, self.height = int(sensor._set["image_size_x"]), int(sensor._set["image_size_y"])
        self.fov = float(sensor._set["fov"])


class FakeClient:
    def __init__(self, world: FakeWorld) -> None:
        self._world, self._timeouts, self._version = world, [], "0.9.16"

    def set_timeout(self, seconds: float) -> None:
        self._timeouts.append(seconds)

    def get_server_version(self) -> str:
        return self._version

    def get_client_version(self) -> str:
        return "0.9.16"

    def get_world(self) -> FakeWorld:
        return self._world

    def get_available_maps(self) -> list[str]:
        return ["/Game/Carla/Maps/Town01", "/Game/Carla/Maps/Town99"]

    def load_world(self, map_name: str) -> FakeWorld:
        self._world._map.name = map_name
        return self._world

    def get_trafficmanager(self, client_connection: int = 8000) -> FakeTraffic:
        return self._world._traffic

    def apply_batch_sync(self, commands: list[Any], due_tick_cue: bool = False) -> list[Any]:
        world, gone = self._world, {command.actor_id for command in commands}
        world._actors = [actor for actor in world._actors if actor.id not in gone]
        world._sensors = [sensor for sensor in world._sensors if sensor.id not in gone]
        return []


REAL = {
    FakeAttribute: "ActorAttribute", FakeBlueprint: "ActorBlueprint", FakeLibrary: "BlueprintLibrary", FakeActor: "Vehicle",
    FakeSensor: "Sensor", FakeState: "ActorSnapshot", FakeSnapshot: "WorldSnapshot", FakeActorList: "ActorList",
    FakeMap: "Map", FakeTraffic: "TrafficManager", FakeWorld: "World", FakeImage: "Image", FakeClient: "Client",
}  # fmt: skip


@pytest.fixture(autouse=True)
def _needs_carla() -> None:
    if carla is None:
        pytest.skip("needs CARLA's client: pip install 'quadlift[carla]'")


@pytest.fixture
def real_names(_needs_carla: None) -> dict[type, str]:
    """The package's class for each fake."""
    return REAL


@pytest.fixture
def rig_document() -> dict[str, Any]:
    return RIG


@pytest.fixture
def new_actor(_needs_carla: None) -> type[FakeActor]:
    return FakeActor


@pytest.fixture
def new_world(_needs_carla: None) -> type[FakeWorld]:
    return FakeWorld


@pytest.fixture
def world(new_world: type[FakeWorld]) -> FakeWorld:
    return new_world()


@pytest.fixture
def package(world: FakeWorld) -> Any:
    """The real package, but for the client; ``package.client`` is the one that it makes."""
    client = FakeClient(world)
    names = ("Location", "Rotation", "Transform", "WeatherParameters", "CityObjectLabel", "command")
    return SimpleNamespace(Client=lambda host, port: client, client=client, **{name: getattr(carla, name) for name in names})


@pytest.fixture
def captured(package: Any, tmp_path: Path) -> Callable[..., list[Progress]]:
    """Captures three steps, every second tick, into a folder of ``tmp_path``."""

    def run(name: str = "s", wait_s: float = 5.0, **rig_changes: Any) -> list[Progress]:
        request = CaptureRequest(steps=3, rate_hz=5.0, vehicles=4, seed=3, warmup_s=0.4)
        rig = parse_rig({**RIG, **rig_changes})
        return list(capture(package, ServerOptions(picture_timeout_s=wait_s), rig, request, tmp_path / name))

    return run
