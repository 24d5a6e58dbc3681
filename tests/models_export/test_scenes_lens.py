"""Bent pictures agree with ``Camera.project``; no OpenGL needed."""

from __future__ import annotations

import numpy as np
import pytest

from models_export.scenes.lens import Lens
from models_export.scenes.renderer import Shot
from service.geometry.camera import Camera
from service.geometry.transforms import Array, pole_camera_pose

LENSES = {
    "barrel": np.array([-0.12, 0.01, 0.001, -0.0008, 0.0]),
    "pincushion": np.array([0.05, 0.0, 0.0, 0.001, 0.0]),
}


def camera(distortion: Array) -> Camera:
    K = np.array([[620.0, 0, 315.0], [0, 625.0, 242.0], [0, 0, 1]])
    return Camera("c", 640, 480, K, pole_camera_pose([0, 0, 6.0], 0.3, 0.3), distortion)


def coordinates(source: Camera) -> Shot:
    """A picture whose depth layer holds each pixel's column and whose instance layer its row."""
    v, u = np.mgrid[: source.height, : source.width].astype(np.uint16)
    return Shot(np.zeros((source.height, source.width, 3), np.uint8), v, u)


@pytest.mark.parametrize("name", LENSES)
def test_a_pixel_shows_what_its_ray_meets(name: str) -> None:
    bent = camera(LENSES[name])
    lens = Lens(bent)
    shot = lens.bend(coordinates(lens.source))
    v, u = np.mgrid[0:480:17, 0:640:13]
    expected = lens.source.pixels_from_normalised(bent.normalised_from_pixels(np.stack([u, v], -1).astype(float)))
    assert shot.instance.shape == (480, 640)
    # Nearest neighbours: half a pixel, and the grid's 0.01.
    assert np.abs(shot.depth[v, u] - expected[..., 0]).max() < 0.52
    assert np.abs(shot.instance[v, u] - expected[..., 1]).max() < 0.52


@pytest.mark.parametrize("name", LENSES)
def test_the_canvas_holds_the_picture_and_knows_its_edge(name: str) -> None:
    bent = camera(LENSES[name])
    lens = Lens(bent)
    border = np.array([[0, 0], [639, 0], [0, 479], [639, 479], [320, 0], [0, 240], [639, 240], [320, 479]], dtype=float)
    inside = lens.source.pixels_from_normalised(bent.normalised_from_pixels(border))
    assert np.all(lens.contains(inside))
    away = (border - bent.K[:2, 2]) / np.linalg.norm(border - bent.K[:2, 2], axis=1, keepdims=True)
    outside = lens.source.pixels_from_normalised(bent.normalised_from_pixels(border + 4 * away))
    assert not np.any(lens.contains(outside))
    size = lens.source.width * lens.source.height
    assert (size > 640 * 480) == (name == "barrel")
    assert int(lens.pixel_counts(Shot(*3 * (np.ones((lens.source.height, lens.source.width), np.uint16),)), 1)[0]) < size


def test_without_distortion_nothing_happens() -> None:
    plain = camera(np.zeros(0))
    lens = Lens(plain)
    shot = coordinates(plain)
    assert lens.source is plain
    assert lens.bend(shot) is shot
    assert lens.contains(np.array([[-0.4, 0.0], [639.4, 479.4], [-0.6, 0.0], [639.6, 0.0]])).tolist() == [
        True,
        True,
        False,
        False,
    ]
