"""Makes scenes: draws a world, its traffic, light and cameras from a seed, renders the steps and writes them to disk."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from models_export.data.dataset import SceneTruth, step_name, write_truth
from models_export.data.kitti import calib_of, write_calib, write_labels
from models_export.scenes.cameras import HEIGHT_PX, WIDTH_PX, pole_cameras
from models_export.scenes.layout import RoadWorld
from models_export.scenes.light import Film, Light, sample_film, sample_light
from models_export.scenes.mesh import Array, Mesh
from models_export.scenes.projection import model_matrix
from models_export.scenes.renderer import Renderer, Shot
from models_export.scenes.roads import WORLDS, build_world
from models_export.scenes.surroundings import furnish
from models_export.scenes.traffic import Traffic, Vehicle
from models_export.scenes.truth import kitti_labels, measure_sight
from service.geometry.camera import Camera
from service.geometry.transforms import rotation_z, wrap_angle
from service.site import OriginModel, Site, save_site

GENERATOR = "quadlift-scenes 1"
START_NS = 1_767_225_600_000_000_000
"""Capture time of every scene's first step: 2026-01-01T00:00:00Z."""
_PNG_SPEED = [cv2.IMWRITE_PNG_COMPRESSION, 1]


@dataclass(frozen=True)
class SceneRequest:
    """What to render. A scene follows from these values alone."""

    seed: int
    world: str = "intersection"
    steps: int = 8
    rate_hz: float = 10.0
    cameras: int = 4
    quality: int | None = None
    """JPEG quality; drawn from 75..95 per camera when None."""
    condition: str | None = None
    """One of ``light.CONDITIONS``; drawn when None."""
    vehicles: int | None = None
    """Vehicles in the world, parked ones included; drawn from 4..25 when None."""


@dataclass(frozen=True, eq=False)
class Step:
    """One rendered moment of a scene."""

    index: int
    truth: SceneTruth
    shots: tuple[Shot, ...]
    """One per camera, in the order of the site; images before lens and sensor."""


class SceneMaker:
    """One scene in the making: its site is known at once, its steps come in order."""

    def __init__(self, request: SceneRequest, renderer: Renderer) -> None:
        self.request = request
        self._renderer = renderer
        rng = np.random.default_rng([request.seed, WORLDS.index(request.world)])
        world_rng, traffic_rng, light_rng, camera_rng = rng.spawn(4)
        self.light: Light = sample_light(light_rng, request.condition)
        world = build_world(request.world, world_rng)
        furnish(world, world_rng)
        self._turn_rad = float(world_rng.uniform(-np.pi / 4, np.pi / 4))
        self._traffic = _busy(world, traffic_rng, request, self.light)
        self.site = Site(f"scene-{request.seed}", self._cameras(world, camera_rng), origin=OriginModel())
        self.films: tuple[Film, ...] = tuple(sample_film(light_rng, self.light, request.quality) for _ in self.site.cameras)
        self._static: Mesh = world.ground.build().moved(rotation_z(self._turn_rad), np.zeros(3))

    def _cameras(self, world: RoadWorld, rng: np.random.Generator) -> tuple[Camera, ...]:
        R = rotation_z(self._turn_rad)[:2, :2]
        poles = tuple((R @ foot, R @ target) for foot, target in world.poles)
        return pole_cameras(poles, self.request.cameras, rng)

    def steps(self) -> Iterator[Step]:
        """Render all steps."""
        self._renderer.set_scene(self._static, self.request.seed)
        for index in range(self.request.steps):
            if index:
                self._traffic.step(1.0 / self.request.rate_hz)
            yield self._render(index, list(self._traffic.vehicles))

    def _render(self, index: int, vehicles: list[Vehicle]) -> Step:
        renderer, cameras = self._renderer, self.site.cameras
        poses = self._poses(vehicles)
        dims = np.array([v.model.dims_lwh for v in vehicles]).reshape(-1, 3)
        ids = [v.id for v in vehicles]
        placed = {v.id: model_matrix(pose, v.model.dims_lwh[2]) for v, pose in zip(vehicles, poses, strict=True)}
        renderer.keep_vehicles({v.id: v.model.mesh for v in vehicles})
        renderer.cast_shadows(self.light, placed)
        center = np.column_stack([poses[:, :2], 0.5 * dims[:, 2]])
        patches = np.column_stack([poses, dims[:, :2]])
        shots, sights = [], []
        for camera, film in zip(cameras, self.films, strict=True):
            shot = renderer.shoot(camera, self.light, film, placed, ids, patches)
            sights.append(measure_sight(renderer, camera, shot, ids, placed, (center, dims, poses[:, 2])))
            shots.append(shot)
        velocity = np.array([v.velocity() for v in vehicles]).reshape(-1, 3) @ rotation_z(self._turn_rad).T
        truth = SceneTruth(
            START_NS + round(index * 1e9 / self.request.rate_hz),
            np.array(ids, dtype=np.int64),
            ("Car",) * len(ids),
            center,
            dims,
            wrap_angle(poses[:, 2]),
            velocity,
            np.stack([s.visible for s in sights], 1),
            np.stack([s.truncated for s in sights], 1),
        )
        return Step(index, truth, tuple(shots))

    def _poses(self, vehicles: list[Vehicle]) -> Array:
        """World poses (N, 3): x, y, yaw."""
        poses = np.array([v.pose() for v in vehicles]).reshape(-1, 3)
        poses[:, :2] = poses[:, :2] @ rotation_z(self._turn_rad)[:2, :2].T
        poses[:, 2] += self._turn_rad
        return poses


def _busy(world: RoadWorld, rng: np.random.Generator, request: SceneRequest, light: Light) -> Traffic:
    """Traffic that has run for a while, so that queues and gaps look natural."""
    total = int(rng.integers(4, 26)) if request.vehicles is None else request.vehicles
    parked = min(int(rng.integers(0, 1 + min(10, total // 2))), len(world.bays))
    traffic = Traffic(world, rng, total - parked, parked, lamps_on=light.lamps_on)
    traffic.step(float(rng.uniform(8.0, 20.0)))
    return traffic


def develop(image: NDArray[np.uint8], film: Film, seed: tuple[int, ...]) -> bytes:
    """Lens blur and sensor noise on an image (H, W, 3) RGB, then JPEG."""
    soft = cv2.GaussianBlur(image, (3, 3), film.blur_px)
    grain = np.random.default_rng(seed).integers(0, _NOISE_SPARE, 2)
    rows = _NOISE[grain[0] : grain[0] + image.shape[0], grain[1] : grain[1] + image.shape[1]]
    noisy = cv2.addWeighted(soft.astype(np.int16), 1.0, rows, film.noise / _NOISE_SCALE, 0.0)
    picture = np.clip(noisy, 0, 255).astype(np.uint8)
    return bytes(simplejpeg.encode_jpeg(picture, quality=film.jpeg_quality, colorspace="RGB", colorsubsampling="420"))


_NOISE_SCALE, _NOISE_SPARE = 32.0, 256
_NOISE = (np.random.default_rng(7).normal(0, _NOISE_SCALE, (HEIGHT_PX + _NOISE_SPARE, WIDTH_PX + _NOISE_SPARE, 3))).astype(
    np.int16
)


class SceneWriter:
    """Writes a scene folder; encoding runs on threads while the next step renders."""

    def __init__(self, maker: SceneMaker, path: Path, pool: ThreadPoolExecutor) -> None:
        self._maker, self._path, self._pool = maker, path, pool
        self._pending: list[Future[None]] = []
        for camera in maker.site.cameras:
            for kind in ("image_2", "label_2", "calib", "depth"):
                (path / "cameras" / camera.id / kind).mkdir(parents=True, exist_ok=True)
        (path / "boxes").mkdir(exist_ok=True)
        save_site(maker.site, path / "site.json")

    def add(self, step: Step) -> None:
        """Write one step."""
        ids = tuple(camera.id for camera in self._maker.site.cameras)
        write_truth(self._path / "boxes" / f"{step_name(step.index)}.json", step.index, step.truth, ids)
        # A few steps in flight at most: frames are large.
        while len(self._pending) >= 3 * len(ids):
            self._pending.pop(0).result()
        for index, (camera, shot) in enumerate(zip(self._maker.site.cameras, step.shots, strict=True)):
            self._pending.append(self._pool.submit(self._write_camera, index, camera, step, shot))

    def close(self) -> None:
        """Wait for the files, then mark the scene complete by writing ``scene.json``."""
        for pending in self._pending:
            pending.result()
        request = self._maker.request
        document = {**asdict(request), "condition": self._maker.light.condition, "generator": GENERATOR}
        (self._path / "scene.json").write_text(json.dumps(document, indent=1), "utf-8")

    def _write_camera(self, index: int, camera: Camera, step: Step, shot: Shot) -> None:
        folder, name = self._path / "cameras" / camera.id, step_name(step.index)
        seed = (self._maker.request.seed, step.index, index)
        (folder / "image_2" / f"{name}.jpg").write_bytes(develop(shot.image, self._maker.films[index], seed))
        encoded, png = cv2.imencode(".png", shot.depth, _PNG_SPEED)
        assert encoded
        (folder / "depth" / f"{name}.png").write_bytes(png.tobytes())
        write_labels(folder / "label_2" / f"{name}.txt", kitti_labels(camera, index, step.truth))
        write_calib(folder / "calib" / f"{name}.txt", calib_of(camera))


def render_scene(request: SceneRequest, path: Path, renderer: Renderer, pool: ThreadPoolExecutor) -> Iterator[Step]:
    """Render one scene into a folder, yielding each step when it is drawn."""
    maker = SceneMaker(request, renderer)
    writer = SceneWriter(maker, path, pool)
    for step in maker.steps():
        writer.add(step)
        yield step
    writer.close()


def new_renderer() -> Renderer:
    """A renderer for the default picture size. Raises QuadliftError when there is no OpenGL."""
    return Renderer(WIDTH_PX, HEIGHT_PX)
