"""Scenes on disk without a renderer, and pipelines that answer with the truth and a chosen error."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from models_export.data.dataset import SceneTruth, open_scene, write_truth
from service.frames import FrameSet
from service.geometry.boxes import Boxes
from service.geometry.camera import Camera
from service.geometry.transforms import pole_camera_pose, wrap_angle
from service.pipeline import PipelineSettings, SetResult
from service.site import Site, save_site

STEPS = 8
SCENES = ("easy", "moderate", "hard")
K = np.array([[640.0, 0.0, 320.0], [0.0, 640.0, 120.0], [0.0, 0.0, 1.0]])


@pytest.fixture(scope="session")
def cameras() -> tuple[Camera, ...]:
    """Poles at the corners of a 36 m square, looking at its centre."""
    corners = {"a": (-18.0, -18.0), "b": (18.0, -18.0), "c": (18.0, 18.0), "d": (-18.0, 18.0)}
    return tuple(
        Camera(name, 640, 240, K, pole_camera_pose([x, y, 6.0], np.arctan2(-y, -x), 0.22)) for name, (x, y) in corners.items()
    )


def moving_cars(scene: int, step: int, cameras: Sequence[Camera]) -> SceneTruth:
    """Five cars on parallel lanes and a van; a camera sees those whose centre is in its image, and every third one badly."""
    n = 6
    yaw = np.where(np.arange(n) % 2, 0.3, 0.3 - np.pi)
    speed = np.where(np.arange(n) == 0, 0.0, 8.0)
    along = np.column_stack([np.cos(yaw), np.sin(yaw)])
    start = np.column_stack([np.linspace(-5, 5, n), 4.0 * np.arange(n) - 10.0 + 0.3 * scene])
    center = np.column_stack([start + along * (speed * 0.1 * step)[:, None], np.full(n, 0.75)])
    visible = np.zeros((n, len(cameras)))
    for column, camera in enumerate(cameras):
        pixels, depth = camera.project(center)
        inside = np.all((pixels >= 0) & (pixels <= [camera.width - 1, camera.height - 1]), axis=1) & (depth > 0)
        visible[:, column] = np.where((np.arange(n) + column) % 3 == 0, 0.2, 1.0) * inside
    return SceneTruth(
        captured_at_ns=10**15 * (scene + 1) + 10**8 * step,
        ids=np.arange(n) + 100 * scene,
        classes=("Car",) * (n - 1) + ("Van",),
        center=center,
        dims_lwh=np.tile([4.2, 1.8, 1.5], (n, 1)),
        yaw=wrap_angle(yaw),
        velocity=np.column_stack([along * speed[:, None], np.zeros(n)]),
        visible=visible,
        truncated=np.where(visible > 0, 0.0, 1.0),
    )


@pytest.fixture
def dataset(tmp_path: Path, cameras: tuple[Camera, ...]) -> Path:
    """Three scenes of eight steps, easy, moderate and hard, of four cameras."""
    ids = tuple(camera.id for camera in cameras)
    for number, scenario in enumerate(SCENES):
        folder = tmp_path / f"scene-{number}"
        save_site(Site(f"scene-{number}", cameras), folder / "site.json")
        (folder / "boxes").mkdir()
        document: dict[str, object] = {"seed": number, "world": "straight", "rate_hz": 10.0, "steps": STEPS}
        document |= {"scenario": scenario, "condition": "day", "axes_rad": [0.3]}
        (folder / "scene.json").write_text(json.dumps(document))
        for step in range(STEPS):
            write_truth(folder / "boxes" / f"{step:06d}.json", step, moving_cars(number, step, cameras), ids)
            for name in ids:
                frame = folder / "cameras" / name / "image_2" / f"{step:06d}.jpg"
                frame.parent.mkdir(parents=True, exist_ok=True)
                frame.write_bytes(b"not read")
    return tmp_path


@dataclass
class TruthPipeline:
    """Answers each frame set with its truth, moved by a constant offset (3,) in metres and by noise of a sigma."""

    truths: dict[int, SceneTruth]
    settings: PipelineSettings
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    noise_m: float = 0.0
    keep: float = 1.0
    """Share of the boxes that are answered."""

    def run(self, frame_set: FrameSet) -> SetResult:
        truth = self.truths[frame_set.captured_at_ns]
        rng = np.random.default_rng(frame_set.captured_at_ns % 2**32)
        score = rng.uniform(0.4, 0.9, len(truth))
        center = truth.center + self.offset_m + rng.normal(0, self.noise_m, truth.center.shape)
        covariance = np.tile(np.diag([0.01] * 7), (len(truth), 1, 1))
        everything = Boxes(
            center, truth.dims_lwh, truth.yaw, score, np.zeros(len(truth), np.int64), covariance, np.full(len(truth), 4.0)
        )
        shown = rng.random(len(truth)) < self.keep
        seen = [truth.visible[:, c] > 0.3 for c in range(len(frame_set.site.cameras))]
        some = np.any(seen, axis=0) & shown
        cameras = tuple(camera.id for camera in frame_set.site.cameras)
        return SetResult(
            boxes=everything.take(some),
            members=np.stack(seen, 1)[some],
            camera_ids=cameras,
            classes=("car",),
            per_camera=[everything.take(mask & shown) for mask in seen],
            detections={},
            timing_ms={},
            failed={},
        )


@pytest.fixture
def truths(dataset: Path) -> dict[int, SceneTruth]:
    """The truth of every frame set of the data set, by capture time."""
    found = {}
    for path in sorted(dataset.iterdir()):
        scene = open_scene(path)
        for step in range(scene.steps):
            truth = scene.truth(step)
            found[truth.captured_at_ns] = truth
    return found


@pytest.fixture
def answering(truths: dict[int, SceneTruth]) -> Callable[..., Callable[[PipelineSettings], TruthPipeline]]:
    """Factories of pipelines that answer with the truth: ``answering(noise_m=0.2)``."""

    def factory(**errors: object) -> Callable[[PipelineSettings], TruthPipeline]:
        template = TruthPipeline(truths, PipelineSettings(), **errors)  # type: ignore[arg-type]
        return lambda settings: replace(template, settings=settings)

    return factory


@pytest.fixture
def one_car(cameras: tuple[Camera, ...]) -> Callable[..., SceneTruth]:
    """Truths of one vehicle that only the first camera sees: ``one_car(visible, truncated, x, cls)``."""

    def make(visible: float, truncated: float, x: float = 0.0, cls: str = "Car") -> SceneTruth:
        many = moving_cars(0, 0, cameras)
        only = {name: value[:1] for name, value in vars(many).items() if isinstance(value, np.ndarray)}
        shown = {"visible": np.array([[visible, 0, 0, 0]]), "truncated": np.array([[truncated, 1, 1, 1]])}
        return replace(many, **(only | shown | {"center": np.array([[x, 0.0, 0.75]])}), classes=(cls,))

    return make
