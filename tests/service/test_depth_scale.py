"""Scale and shift of the inverse-depth map, found on the road despite what stands on it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.depth_scale import DepthScale, DepthScales, cell_pixels, fit_scale, ground_inverse_depth, read_boxes
from service.geometry.camera import Camera
from service.geometry.ground import GroundGrid, GroundPlane
from service.geometry.transforms import pole_camera_pose
from service.nets.depth import UNBIASED, InverseDepth, ReadingError

STRIDE = 8
SHAPE = (24, 80)
K = np.array([[330.0, 0.0, 320.0], [0.0, 330.0, 96.0], [0.0, 0.0, 1.0]])
CAMERA = Camera("north", 640, 192, K, pole_camera_pose([3.0, -2.0, 6.0], 0.7, 0.25))
GROUND = GroundPlane()
BOX = np.array([[100.0, 60.0, 140.0, 90.0]])


def road_map(scale: float, shift: float) -> np.ndarray:
    """An inverse-depth map of an empty road as the net would give it, up to ``scale`` and ``shift``."""
    inverse = np.nan_to_num(ground_inverse_depth(CAMERA, GROUND, SHAPE, STRIDE), nan=0.005)
    return ((inverse - shift) / scale).astype(np.float32)


def test_ground_inverse_depth_is_the_depth_of_the_ground() -> None:
    inverse = ground_inverse_depth(CAMERA, GROUND, SHAPE, STRIDE)
    usable = np.isfinite(inverse)
    points = CAMERA.unproject(cell_pixels(SHAPE, STRIDE)[usable], 1 / inverse[usable])
    assert usable.sum() > 500
    np.testing.assert_allclose(points[:, 2], 0.0, atol=1e-9)


def test_ground_inverse_depth_follows_a_grid() -> None:
    axis = np.arange(-80.0, 81.0, 4.0)
    x, y = np.meshgrid(axis, axis)
    rolling = GroundGrid(np.array([-80.0, -80.0]), 4.0, 0.03 * x + 0.4 * np.sin(y / 20))
    inverse = ground_inverse_depth(CAMERA, rolling, SHAPE, STRIDE)
    usable = np.isfinite(inverse)
    points = CAMERA.unproject(cell_pixels(SHAPE, STRIDE)[usable], 1 / inverse[usable])
    assert usable.sum() > 300
    np.testing.assert_allclose(points[:, 2], rolling.height_at(points), atol=0.02)


@settings(deadline=None, max_examples=25)
@given(scale=st.floats(0.01, 5), shift=st.floats(-0.2, 0.2), seed=st.integers(0, 1000))
def test_the_fit_finds_the_scale_though_a_third_of_the_road_is_hidden(scale: float, shift: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = road_map(scale, shift)
    # Vehicles: blocks nearer than the road behind them.
    for _ in range(6):
        row, column = rng.integers(6, 20), rng.integers(0, 70)
        block = values[row : row + 4, column : column + 10]
        block += np.float32(0.02 / scale)
    found = fit_scale(values, ground_inverse_depth(CAMERA, GROUND, SHAPE, STRIDE))
    assert found is not None
    assert found.scale == pytest.approx(scale, rel=0.02)
    assert found.shift == pytest.approx(shift, abs=0.002)


def test_no_road_in_view_means_no_scale() -> None:
    sky = Camera("up", 640, 192, K, pole_camera_pose([0.0, 0.0, 6.0], 0.0, -0.6))
    assert fit_scale(road_map(1.0, 0.0), ground_inverse_depth(sky, GROUND, SHAPE, STRIDE)) is None


def test_a_map_that_does_not_grow_with_nearness_fits_no_scale() -> None:
    target = ground_inverse_depth(CAMERA, GROUND, SHAPE, STRIDE)
    assert fit_scale(-road_map(1.0, 0.0), target) is None
    assert fit_scale(np.zeros(SHAPE, np.float32), target) is None


def test_boxes_read_the_surface_in_their_middle() -> None:
    values = road_map(1.0, 0.0)
    values[10:16, 30:40] = 1 / 20.0
    scale = fit_scale(values, ground_inverse_depth(CAMERA, GROUND, SHAPE, STRIDE))
    boxes = np.array([[30 * 8.0, 10 * 8.0, 40 * 8.0 - 1, 16 * 8.0 - 1], [240.0, 80.0, 242.0, 81.0]])
    readings = read_boxes(InverseDepth(values, STRIDE), scale, boxes, ReadingError(0.0, 0.1))
    np.testing.assert_allclose(readings.depth_m, 20.0, rtol=0.03)
    assert np.all(readings.sigma_m >= 0.1 * readings.depth_m)


def test_a_known_bias_is_taken_off() -> None:
    values = np.full(SHAPE, 1 / 22.0, np.float32)
    reading = read_boxes(InverseDepth(values, STRIDE), DepthScale(1.0, 0.0, 0.0), BOX, ReadingError(0.1, 0.05))
    np.testing.assert_allclose(reading.depth_m, 20.0, rtol=1e-6)
    np.testing.assert_allclose(reading.sigma_m, 1.0, rtol=1e-6)


def test_where_the_map_is_no_number_there_is_no_reading() -> None:
    values = np.full_like(road_map(1.0, 0.0), 0.1)
    scale = DepthScale(1.0, 0.0, 0.0)
    assert np.isfinite(read_boxes(InverseDepth(values, STRIDE), scale, BOX, UNBIASED).depth_m).all()
    x, y = (0.5 * (BOX[0, :2] + BOX[0, 2:]) / STRIDE).astype(int)
    values[y, x] = np.nan
    assert np.isnan(read_boxes(InverseDepth(values, STRIDE), scale, BOX, UNBIASED).depth_m).all()


def test_without_a_scale_there_are_no_readings() -> None:
    readings = read_boxes(InverseDepth(road_map(1.0, 0.0), STRIDE), None, np.zeros((3, 4)), UNBIASED)
    assert np.isnan(readings.depth_m).all()
    assert len(read_boxes(InverseDepth(road_map(1.0, 0.0), STRIDE), None, np.zeros((0, 4)), UNBIASED).depth_m) == 0


def test_a_camera_keeps_its_scale_between_fits_and_loses_it_with_its_calibration() -> None:
    scales = DepthScales()
    first = scales.update(CAMERA, CAMERA, GROUND, InverseDepth(road_map(2.0, 0.0), STRIDE))
    kept = scales.update(CAMERA, CAMERA, GROUND, InverseDepth(road_map(4.0, 0.0), STRIDE))
    assert first is not None
    assert kept is first
    again = Camera("north", 640, 192, K, CAMERA.T_cam_world)
    fresh = scales.update(again, again, GROUND, InverseDepth(road_map(4.0, 0.0), STRIDE))
    assert fresh is not None
    assert fresh.scale == pytest.approx(4.0, rel=0.02)
