"""Guided boxes in the world: covariances against sampling, the road's pull, covariance intersection, joining."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.geometry.boxes import Boxes, box_states
from service.geometry.camera import Camera, ray_azimuth
from service.geometry.ground import GroundPlane
from service.geometry.transforms import pole_camera_pose, wrap_angle
from service.guided_boxes import intersect, join, on_the_road, suppress_bev, world_boxes
from service.nets.guided import GuidedDetections

K = np.array([[350.0, 0.0, 320.5], [0.0, 350.0, 95.5], [0.0, 0.0, 1.0]])
CAMERA = Camera("north", 642, 192, K, pole_camera_pose([3.0, -2.0, 7.0], 0.7, 0.35))
LENS = replace(CAMERA, distortion=np.array([-0.2, 0.05, 0.001, -0.001]))
SIGMA = np.array([2.0, 1.5, 0.8, 0.2, 0.06, 0.05, 0.08])


def detections(center_px: list[float], depth: float, alpha: float, sigma: np.ndarray = SIGMA) -> GuidedDetections:
    return GuidedDetections(
        xyxy_px=np.array([[0.0, 0.0, 10.0, 10.0]]),
        score=np.array([0.7]),
        cls=np.zeros(1, np.int64),
        center_px=np.array([center_px]),
        depth_m=np.array([depth]),
        dims_lwh=np.array([[4.4, 1.8, 1.5]]),
        alpha=np.array([alpha]),
        flip_log_odds=np.array([2.0]),
        sigma=sigma[None],
    )


def boxes_at(xy: list[list[float]], sigma: float = 0.5, score: float = 0.6, yaw: float = 0.3) -> Boxes:
    n = len(xy)
    center = np.column_stack([np.array(xy, dtype=np.float64).reshape(n, 2), np.full(n, 0.75)])
    covariance = np.tile(np.diag([sigma**2, sigma**2, 0.01, 0.04, 0.01, 0.01, 0.01]), (n, 1, 1))
    return Boxes(
        center,
        np.tile([4.4, 1.8, 1.5], (n, 1)),
        np.full(n, yaw),
        np.full(n, score),
        np.zeros(n, np.int64),
        covariance,
        np.ones(n),
    )


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_a_true_box_comes_back_from_its_projection(camera: Camera) -> None:
    center, yaw = np.array([[18.0, 11.0, 0.75]]), 1.1
    pixel, depth = camera.project(center)
    alpha = float(wrap_angle(yaw - ray_azimuth(camera, pixel))[0])
    (box,) = box_states(world_boxes(camera, detections(pixel[0].tolist(), float(depth[0]), alpha), np.array([0])))
    np.testing.assert_allclose(box, [18.0, 11.0, 0.75, 4.4, 1.8, 1.5, yaw], atol=1e-6)


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_the_covariance_is_that_of_samples(camera: Camera) -> None:
    small = 0.5 * SIGMA
    mean = detections([400.0, 110.0], 22.0, 0.4, small)
    noise = np.random.default_rng(0).normal(size=(4000, 7)) * small
    many = GuidedDetections(**{name: np.repeat(value, len(noise), 0) for name, value in vars(mean).items()})
    disturbed = replace(
        many,
        center_px=many.center_px + noise[:, :2],
        depth_m=many.depth_m + noise[:, 2],
        dims_lwh=many.dims_lwh + noise[:, 3:6],
        alpha=many.alpha + noise[:, 6],
    )
    states = box_states(world_boxes(camera, disturbed, disturbed.cls))
    expected = np.cov(states.T)
    ours = world_boxes(camera, mean, np.array([0])).covariance[0]
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((ours - expected) / scale).max() < 0.08


def test_the_road_pulls_along_what_is_uncertain() -> None:
    found = detections([400.0, 110.0], 25.0, 0.4)
    box = world_boxes(CAMERA, found, np.array([0]))
    ground = GroundPlane(offset=float(box.center[0, 2]) - 0.75 - 0.4)
    rested = on_the_road(box, ground, CAMERA, 0.05, 0.003)
    bottom = rested.center[0, 2] - 0.5 * rested.dims_lwh[0, 2]
    assert abs(bottom - ground.offset) < 0.1
    assert np.all(np.linalg.eigvalsh(rested.covariance) > 0)
    assert np.linalg.det(rested.covariance[0, :2, :2]) < np.linalg.det(box.covariance[0, :2, :2])
    # 0.4 m too high along a ray that falls means too near: the update moves the box away from the camera.
    before, after = (np.linalg.norm(b.center[0, :2] - CAMERA.position_m[:2]) for b in (box, rested))
    assert after > before


def test_the_road_moves_nothing_that_stands_on_it() -> None:
    box = boxes_at([[20.0, 5.0]])
    rested = on_the_road(box, GroundPlane(), CAMERA, 0.05, 0.003)
    np.testing.assert_allclose(box_states(rested), box_states(box), atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_intersection_is_never_surer_than_the_surest_nor_less_sure(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = boxes_at([[0.0, 0.0]]), boxes_at([[0.4, -0.3]], yaw=0.35)
    roots = rng.normal(size=(2, 7, 7))
    a, b = (replace(x, covariance=(r @ r.T + 0.05 * np.eye(7))[None]) for x, r in zip((a, b), roots, strict=True))
    joined = intersect(a, b)
    area = [np.linalg.det(x.covariance[0, :2, :2]) for x in (joined, a, b)]
    assert area[0] <= min(area[1:]) * (1 + 1e-9)
    # Honest for any correlation: information is a convex sum of both.
    information = np.linalg.inv(joined.covariance[0])
    first, second = np.linalg.inv(a.covariance[0]), np.linalg.inv(b.covariance[0])
    difference = second - first
    weight = float(((information - first) * difference).sum() / (difference**2).sum())
    assert -1e-6 <= weight <= 1 + 1e-6
    np.testing.assert_allclose(information, first + weight * difference, rtol=1e-4, atol=1e-4)


def test_the_intersection_of_equals_is_the_same_box() -> None:
    a = boxes_at([[3.0, 4.0]])
    joined = intersect(a, a)
    np.testing.assert_allclose(box_states(joined), box_states(a))
    np.testing.assert_allclose(joined.covariance, a.covariance)
    assert joined.score == a.score


def test_a_flipped_heading_counts_against() -> None:
    a, b = boxes_at([[0.0, 0.0]]), boxes_at([[0.0, 0.0]], yaw=0.3 + np.pi)
    surely = replace(b, yaw=wrap_angle(b.yaw), flip_log_odds=np.array([50.0]), covariance=0.5 * b.covariance)
    joined = intersect(a, surely)
    assert abs(float(wrap_angle(joined.yaw - surely.yaw)[0])) < 1e-6
    kept = intersect(
        replace(a, flip_log_odds=np.array([50.0]), covariance=0.5 * a.covariance), replace(b, yaw=wrap_angle(b.yaw))
    )
    assert abs(float(wrap_angle(kept.yaw - a.yaw)[0])) < 1e-6


def test_joining_combines_matches_and_keeps_the_rest() -> None:
    lifted = boxes_at([[0.0, 0.0], [20.0, 0.0]], score=0.5)
    guided = boxes_at([[20.6, 0.0], [40.0, 0.0]], score=0.8)
    out = join(lifted, guided, 9.21, 3.0)
    assert len(out) == 3
    np.testing.assert_allclose(out.center[0], lifted.center[0])
    assert 20.0 <= out.center[1, 0] <= 20.6
    assert out.score.tolist() == [0.5, 0.8, 0.8]
    np.testing.assert_allclose(out.center[2], guided.center[1])
    assert len(join(lifted, Boxes.empty(), 9.21, 3.0)) == 2
    assert len(join(Boxes.empty(), guided, 9.21, 3.0)) == 2
    assert len(join(lifted, guided, 9.21, 0.5)) == 4


def test_suppression_keeps_the_best_of_a_place() -> None:
    boxes = boxes_at([[0.0, 0.0], [0.5, 0.2], [12.0, 0.0]])
    boxes = replace(boxes, score=np.array([0.4, 0.9, 0.5]))
    assert suppress_bev(boxes, 0.1, 1.0).score.tolist() == [0.9, 0.5]
    assert len(suppress_bev(Boxes.empty(), 0.1, 1.0)) == 0
