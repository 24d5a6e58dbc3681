"""Captures a scene from CARLA into the simulator's on-disk form: see ``dataset.py`` for the files."""

from __future__ import annotations

import json
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import simplejpeg

from models_export.data.carla_images import depth_m_of, rgb_of, stored_depth
from models_export.data.carla_rig import Rig
from models_export.data.carla_sensors import MissingPictureError, Pictures, SensorArray, open_sensors
from models_export.data.carla_session import ServerOptions, Session, open_session, site_origin, ticks_a_step
from models_export.data.carla_traffic import spawn_traffic
from models_export.data.carla_truth import SubjectList, frame_truth
from models_export.data.carla_weather import Weather
from models_export.data.dataset import SceneTruth, step_name, write_truth
from models_export.data.kitti import calib_of, write_calib, write_labels
from models_export.data.labels import kitti_labels
from service.errors import InputError
from service.geometry.camera import Camera
from service.site import Site, save_site

GENERATOR = "quadlift-carla 1"
START_NS = 1_767_225_600_000_000_000
"""Capture time of a scene's first step, as in simulated scenes: 2026-01-01T00:00:00Z."""
MAX_DROPS = 5
"""Steps that may be dropped one after the other before a capture gives up."""
_PRIMING_TICKS = 2
"""Ticks after the sensors were spawned; the first may go by before they draw."""
_PNG_SPEED = [cv2.IMWRITE_PNG_COMPRESSION, 1]


@dataclass(frozen=True)
class CaptureRequest:
    """What to capture."""

    steps: int = 100
    """Frame sets to write."""
    rate_hz: float = 10.0
    """Frame sets a second of simulated time."""
    weather: Weather = Weather.CLEAR
    vehicles: int = 40
    """Vehicles to put on the road near the rig; as many as find a place."""
    seed: int = 0
    """Of vehicles, paint, places and the traffic manager."""
    warmup_s: float = 5.0
    """Simulated seconds before the first step: cars fall onto their wheels and spread, exposure adapts."""
    quality: int = 90
    """JPEG quality."""
    map: str | None = None
    """Map to load; the rig's, else the one that the server shows, when None."""


@dataclass(frozen=True)
class Progress:
    """How far a capture is."""

    written: int
    """Steps on disk."""
    dropped: int
    """Steps left out because a sensor did not deliver."""
    vehicles: int
    """Vehicles that found a place."""
    without_box: int
    """Actors left out because the server gives them no bounding box."""


def capture(
    carla_module: Any, options: ServerOptions, rig: Rig, request: CaptureRequest, out: Path
) -> Generator[Progress, None, None]:
    """Capture one scene into the folder ``out``, yielding after each step.

    Close the generator, or let it end, to leave the server as it was found. ``scene.json`` is written last; a capture cut
    short still leaves a whole scene of the steps that it wrote. Raises InputError when the folder already holds a scene,
    QuadliftError when there is no server, when it fails, or when its pictures do not come.
    """
    if (out / "scene.json").exists():
        raise InputError("holds a scene already.", field=str(out), remedy="Give another folder.")
    ticks = ticks_a_step(request.rate_hz)
    tick_s = 1.0 / (request.rate_hz * ticks)
    map_name = request.map or rig.map
    with open_session(carla_module, options, map_name, tick_s, request.weather, request.seed) as session:
        vehicles = spawn_traffic(session, rig.anchor, request.vehicles, request.seed)
        for _ in range(round(request.warmup_s / tick_s)):
            session.tick()
        site = rig.site if rig.has_origin else replace(rig.site, origin=site_origin(session, rig))
        with open_sensors(session, rig) as sensors:
            for _ in range(_PRIMING_TICKS):
                session.tick()
            writer = _SceneWriter(site, request, session.map_name, out)
            subjects, dropped = SubjectList(session), 0
            try:
                for truth, pictures in _steps(session, sensors, subjects, rig, request):
                    if truth is None:
                        dropped += 1
                        continue
                    writer.add(truth, pictures)
                    yield Progress(writer.written, dropped, vehicles, subjects.without_box)
            finally:
                writer.close(vehicles, dropped, str(session.client.get_client_version()))


def _steps(
    session: Session, sensors: SensorArray, subjects: SubjectList, rig: Rig, request: CaptureRequest
) -> Iterator[tuple[SceneTruth | None, Sequence[Pictures]]]:
    """Truth and pictures of steps, until enough are whole; None where a sensor did not deliver.

    Raises MissingPictureError when too many are missing one after the other.
    """
    ticks, whole, missing, number = ticks_a_step(request.rate_hz), 0, 0, 0
    while whole < request.steps:
        for _ in range(ticks):
            snapshot = session.tick()
        captured_at_ns = START_NS + round(number * 1e9 / request.rate_hz)
        number += 1
        try:
            pictures = sensors.collect(snapshot.frame, session.options.picture_timeout_s)
        except MissingPictureError:
            missing += 1
            if missing >= MAX_DROPS:
                raise
            yield None, ()
            continue
        whole, missing = whole + 1, 0
        yield frame_truth(snapshot, subjects.present(), rig, pictures, captured_at_ns), pictures


class _SceneWriter:
    """Writes the steps of one scene."""

    def __init__(self, site: Site, request: CaptureRequest, world: str, path: Path) -> None:
        self._site, self._request, self._world, self._path = site, request, world, path
        self.written = 0
        for camera in site.cameras:
            for kind in ("image_2", "label_2", "calib", "depth"):
                (path / "cameras" / camera.id / kind).mkdir(parents=True, exist_ok=True)
        (path / "boxes").mkdir(exist_ok=True)
        save_site(site, path / "site.json")

    def add(self, truth: SceneTruth, pictures: Sequence[Pictures]) -> None:
        """Write one step."""
        ids = tuple(camera.id for camera in self._site.cameras)
        for index, (camera, seen) in enumerate(zip(self._site.cameras, pictures, strict=True)):
            self._write_camera(index, camera, truth, seen)
        write_truth(self._path / "boxes" / f"{step_name(self.written)}.json", self.written, truth, ids)
        self.written += 1

    def close(self, vehicles: int, dropped: int, version: str) -> None:
        """Mark the scene complete, unless it has no steps."""
        if not self.written:
            return
        request = self._request
        document = {
            "seed": request.seed,
            "world": self._world,
            "steps": self.written,
            "rate_hz": request.rate_hz,
            "cameras": len(self._site.cameras),
            "quality": request.quality,
            "condition": request.weather.value,
            "vehicles": vehicles,
            "generator": GENERATOR,
            "carla": version,
            "dropped": dropped,
        }
        (self._path / "scene.json").write_text(json.dumps(document, indent=1), "utf-8")

    def _write_camera(self, index: int, camera: Camera, truth: SceneTruth, seen: Pictures) -> None:
        folder, name = self._path / "cameras" / camera.id, step_name(self.written)
        quality = self._request.quality
        jpeg = simplejpeg.encode_jpeg(rgb_of(seen.rgb), quality=quality, colorspace="RGB", colorsubsampling="420")
        (folder / "image_2" / f"{name}.jpg").write_bytes(jpeg)
        encoded, png = cv2.imencode(".png", stored_depth(depth_m_of(seen.depth)), _PNG_SPEED)
        assert encoded
        (folder / "depth" / f"{name}.png").write_bytes(png.tobytes())
        write_labels(folder / "label_2" / f"{name}.txt", kitti_labels(camera, index, truth))
        write_calib(folder / "calib" / f"{name}.txt", calib_of(camera))
