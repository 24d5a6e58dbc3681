"""Small synthetic samples: enough to train on for a moment, with no renderer behind them."""

from __future__ import annotations

import numpy as np
import pytest

from models_export.data.samples import Sample
from service.geometry.camera import Camera
from service.geometry.ground import GroundPlane
from service.geometry.transforms import pole_camera_pose

WIDTH, HEIGHT = 160, 96


@pytest.fixture(scope="session")
def toy_samples() -> list[Sample]:
    """Bright rectangles on noise: 8 frames of 160x96 px with two "vehicles" each, and a slanted plane as depth."""
    rng = np.random.default_rng(7)
    K = np.array([[120.0, 0.0, 79.5], [0.0, 120.0, 47.5], [0.0, 0.0, 1.0]])
    camera = Camera("north", WIDTH, HEIGHT, K, pole_camera_pose([0.0, 0.0, 6.0], 0.0, 0.3))
    return [_toy_sample(rng, camera) for _ in range(8)]


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
        dims_lwh=rng.normal([4.4, 1.8, 1.5], 0.1, (2, 3)),
        alpha=rng.uniform(-np.pi, np.pi, 2),
        visible=np.ones(2),
        truncated=np.zeros(2),
        center=rng.uniform([10.0, -4.0, 0.7], [20.0, 4.0, 0.8], (2, 3)),
        ground=GroundPlane(),
        inverse_depth=(0.02 + 0.01 * rows).astype(np.float32),
    )
