"""Small synthetic samples and scenes: enough to train on for a moment, with no renderer behind them."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from models_export.data.dataset import DEPTH_UNITS_PER_M, SceneTruth, step_name, write_truth
from models_export.data.samples import Sample
from service.geometry.boxes import clip_extents, project_extents
from service.geometry.camera import Camera
from service.geometry.ground import GroundPlane
from service.geometry.transforms import pole_camera_pose
from service.site import Site, save_site

WIDTH, HEIGHT = 160, 96
SCENE_WIDTH, SCENE_HEIGHT = 320, 160
SCENE_CAMERAS = ("north", "east")
VEHICLES = 4


@pytest.fixture(scope="session")
def toy_samples() -> list[Sample]:
    """Bright rectangles on noise: 8 frames of 160x96 px with two "vehicles" each, and a slanted plane as depth."""
    rng = np.random.default_rng(7)
    K = np.array([[120.0, 0.0, 79.5], [0.0, 120.0, 47.5], [0.0, 0.0, 1.0]])
    camera = Camera("north", WIDTH, HEIGHT, K, pole_camera_pose([0.0, 0.0, 6.0], 0.0, 0.3))
    return [_toy_sample(rng, camera) for _ in range(8)]


@pytest.fixture(scope="session")
def toy_scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of 11 scenes, two cameras: bright boxes on noise, with exact truth. The tenth validates, and is longer."""
    root = tmp_path_factory.mktemp("toy")
    _write_toy_scenes(root, [20 if index == 9 else 4 for index in range(11)])
    return root


def _toy_sample(rng: np.random.Generator, camera: Camera) -> Sample:
    canvas = rng.integers(60, 90, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    boxes = []
    for left in (rng.integers(4, 30), rng.integers(84, 110)):
        top, width, height = rng.integers(20, 50), rng.integers(24, 44), rng.integers(14, 30)
        canvas[top : top + height, left : left + width] = rng.integers(160, 255, 3)
        boxes.append([left, top, left + width - 1, top + height - 1])
    rows = np.arange(HEIGHT // 8)[:, None] + np.zeros(WIDTH // 8)
    return Sample(
        canvas=canvas,
        image_size=(WIDTH, HEIGHT),
        camera=camera,
        xyxy_px=np.array(boxes, dtype=np.float64),
        ignore=np.zeros(2, dtype=bool),
        cls=np.zeros(2, np.int64),
        class_known=np.ones(2, dtype=bool),
        source="simulated/toy",
        dims_lwh=rng.normal([4.4, 1.8, 1.5], 0.1, (2, 3)),
        alpha=rng.uniform(-np.pi, np.pi, 2),
        corners_px=np.array(boxes, dtype=np.float64)[:, [[0, 1], [2, 1], [2, 3], [0, 3]] * 2],
        visible=np.ones(2),
        truncated=np.zeros(2),
        center=rng.uniform([10.0, -4.0, 0.7], [20.0, 4.0, 0.8], (2, 3)),
        ground=GroundPlane(),
        inverse_depth=(0.02 + 0.01 * rows).astype(np.float32),
    )


def _write_toy_scenes(root: Path, steps: list[int]) -> None:
    """A scene of each number of steps, of two cameras, whose vehicles stand in a row that both see."""
    K = np.array([[200.0, 0.0, SCENE_WIDTH / 2 - 0.5], [0.0, 200.0, SCENE_HEIGHT / 2 - 0.5], [0.0, 0.0, 1.0]])
    poses = [pole_camera_pose([0.0, side, 6.0], 0.0, 0.35) for side in (-3.0, 3.0)]
    cameras = tuple(Camera(name, SCENE_WIDTH, SCENE_HEIGHT, K, pose) for name, pose in zip(SCENE_CAMERAS, poses, strict=True))
    for index, count in enumerate(steps):
        _write_scene(root / f"toy-{index:02d}", Site("toy", cameras), index, count)


def _write_scene(folder: Path, site: Site, seed: int, steps: int) -> None:
    rng = np.random.default_rng(seed)
    save_site(site, folder / "site.json")
    (folder / "boxes").mkdir()
    document = {"seed": seed, "world": "toy", "rate_hz": 1.0, "steps": steps, "generator": "toy 1"}
    (folder / "scene.json").write_text(json.dumps({**document, "condition": ("day", "night")[seed % 2]}))
    for step in range(steps):
        truth = _truth(rng, step)
        write_truth(folder / "boxes" / f"{step_name(step)}.json", step, truth, SCENE_CAMERAS)
        for camera in site.cameras:
            _write_frame(folder / "cameras" / camera.id, camera, truth, step, rng)


def _truth(rng: np.random.Generator, step: int) -> SceneTruth:
    dims = rng.normal([4.4, 1.8, 1.5], 0.1, (VEHICLES, 3))
    center = np.stack([rng.uniform(14, 20, VEHICLES), np.linspace(-7.5, 7.5, VEHICLES), dims[:, 2] / 2], 1)
    center[:, 1] += rng.uniform(-0.4, 0.4, VEHICLES)
    yaw = rng.uniform(-np.pi, np.pi, VEHICLES)
    everywhere = np.ones((VEHICLES, len(SCENE_CAMERAS)))
    return SceneTruth(
        step * 10**9, np.arange(VEHICLES), ("Car",) * VEHICLES, center, dims, yaw, np.zeros((VEHICLES, 3)),
        everywhere, 0 * everywhere,
    )  # fmt: skip


def _write_frame(folder: Path, camera: Camera, truth: SceneTruth, step: int, rng: np.random.Generator) -> None:
    picture = rng.integers(60, 90, (SCENE_HEIGHT, SCENE_WIDTH, 3), dtype=np.uint8)
    rows = np.arange(SCENE_HEIGHT)[:, None] + np.zeros(SCENE_WIDTH)
    depth = 60.0 - 0.3 * rows
    extents, _ = project_extents(camera, truth.center, truth.dims_lwh, truth.yaw)
    for row in np.argsort(-truth.center[:, 0]):
        x0, y0, x1, y1 = np.rint(clip_extents(camera, extents)[row]).astype(int)
        picture[y0 : y1 + 1, x0 : x1 + 1] = rng.integers(160, 255, 3)
        depth[y0 : y1 + 1, x0 : x1 + 1] = truth.center[row, 0]
    for kind, name, pixels in (
        ("image_2", f"{step_name(step)}.jpg", picture),
        ("depth", f"{step_name(step)}.png", (depth * DEPTH_UNITS_PER_M).astype(np.uint16)),
    ):
        (folder / kind).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / kind / name), pixels)
