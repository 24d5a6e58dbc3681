from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.geometry.boxes import Boxes, box_states
from service.geometry.camera import Camera
from service.geometry.transforms import invert_rigid, pole_camera_pose, rigid, rotation_z, wrap_angle
from service.paper_fusion import PaperFusionSettings, fuse_paper, rescaled_score, weighted_clusters

K = np.array([[642.0, 0.0, 641.5], [0.0, 642.0, 191.5], [0.0, 0.0, 1.0]])


def four_cameras():
    """Cameras on the corners of a crossing, 25 m from its middle."""
    azimuths = np.pi / 4 + np.arange(4) * np.pi / 2
    poses = [pole_camera_pose([25 * np.cos(a), 25 * np.sin(a), 6.0], a + np.pi, np.deg2rad(14)) for a in azimuths]
    return [Camera(f"c{row}", 1284, 384, K, pose) for row, pose in enumerate(poses)]


def some_boxes(states, score, flip=2.0):
    states = np.asarray(states, dtype=np.float64).reshape(-1, 7)
    n = len(states)
    return Boxes(
        center=states[:, :3],
        dims_lwh=states[:, 3:6],
        yaw=wrap_angle(states[:, 6]),
        score=np.broadcast_to(np.asarray(score, dtype=np.float64), n).copy(),
        cls=np.zeros(n, np.int64),
        covariance=np.tile(np.diag([0.09, 0.09, 0.01, 0.04, 0.01, 0.01, 0.01]), (n, 1, 1)),
        flip_log_odds=np.broadcast_to(np.asarray(flip, dtype=np.float64), n).copy(),
    )


def car(x=0.0, y=0.0, yaw=0.0):
    return [x, y, 0.75, 4.4, 1.8, 1.5, yaw]


def random_scene(seed, models, overflow_models):
    """Boxes of several models around a few vehicles, in the unit cube; scores without ties."""
    rng = np.random.default_rng(seed)
    vehicles = rng.uniform(0.2, 0.8, (4, 3)), rng.uniform(0.05, 0.2, (4, 3))
    parts = []
    for _ in range(models):
        rows = np.concatenate([np.flatnonzero(rng.random(4) < 0.8), rng.integers(0, 4, overflow_models)])
        center = vehicles[0][rows] + 0.008 * rng.normal(size=(len(rows), 3))
        size = vehicles[1][rows] * (1 + 0.05 * rng.normal(size=(len(rows), 3)))
        parts.append((center, size, rng.uniform(0.05, 1.0, len(rows)), rng.integers(0, 2, len(rows))))
    return parts


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(0, 2), st.booleans(), st.floats(0.3, 0.8))
@settings(max_examples=80, deadline=None)
def test_it_is_ensemble_boxes_at_yaw_zero(seed, models, extra, overflow, iou):
    reference = pytest.importorskip("ensemble_boxes")
    parts = random_scene(seed, models, extra)
    corners = [np.clip(np.c_[c - s / 2, c + s / 2], 0, 1) for c, s, _, _ in parts]
    scale = 50.0  # Metres a side of the unit cube.
    boxes, scores, labels = reference.weighted_boxes_fusion_3d(
        [list(c) for c in corners], [p[2].tolist() for p in parts], [p[3].tolist() for p in parts],
        iou_thr=iou, allows_overflow=overflow,
    )  # fmt: skip
    xyz = scale * np.concatenate(corners)
    states = np.c_[(xyz[:, :3] + xyz[:, 3:]) / 2, xyz[:, 3:] - xyz[:, :3], np.zeros(len(xyz))]
    score, cls = (np.concatenate([p[k] for p in parts]) for k in (2, 3))
    ours = weighted_clusters(states, score, cls, iou)
    views = np.full(len(ours.state), models)
    # The reference lets eq. 13 pass 1.
    ours_score = ours.mean_score * ours.count / models if overflow else rescaled_score(ours.mean_score, ours.count, views)
    order = np.argsort(-ours_score)
    assert len(order) == len(scores)
    np.testing.assert_allclose(ours_score[order], scores, atol=1e-6)
    center, half = ours.state[order, :3] / scale, ours.state[order, 3:6] / scale / 2
    np.testing.assert_allclose(np.c_[center - half, center + half], boxes, atol=1e-6)
    first = np.unique(ours.cluster, return_index=True)[1]
    np.testing.assert_array_equal(cls[first][order], labels)


def test_a_flipped_heading_does_not_collapse_the_box():
    boxes = some_boxes([car(yaw=0.1), car(yaw=0.1 + np.pi), car(yaw=0.1)], [0.9, 0.8, 0.7], flip=[1.0, 1.0, 1.0])
    fused = fuse_paper(boxes, np.arange(3), four_cameras()).boxes
    assert len(fused) == 1
    np.testing.assert_allclose(box_states(fused)[0], car(yaw=0.1), atol=1e-9)
    np.testing.assert_allclose(fused.flip_log_odds, 1.0)
    outvoted = replace(boxes, flip_log_odds=np.array([1.0, 4.0, 1.0]))
    yaw = fuse_paper(outvoted, np.arange(3), four_cameras()).boxes.yaw
    np.testing.assert_allclose(np.abs(wrap_angle(yaw - 0.1)), np.pi, atol=1e-9)


def test_yaw_is_averaged_across_the_wrap():
    boxes = some_boxes([car(yaw=np.pi - 0.02), car(yaw=-np.pi + 0.04)], [0.5, 0.5])
    fused = fuse_paper(boxes, np.arange(2), four_cameras()).boxes
    np.testing.assert_allclose(fused.yaw, -np.pi + 0.01, atol=1e-9)


def test_coordinates_are_weighted_by_score():
    fused = fuse_paper(some_boxes([car(0.0), car(0.4)], [0.9, 0.3]), np.arange(2), four_cameras()).boxes
    np.testing.assert_allclose(fused.center[0, 0], 0.1)


def test_only_an_overlap_strictly_above_the_threshold_joins():
    # Equal boxes shifted along x by d overlap by (l - d) / (l + d): 1/3 exactly at half a length.
    states = np.array([[0, 0, 0, 4, 2, 1, 0], [2, 0, 0, 4, 2, 1, 0]], dtype=np.float64)
    score, cls = np.array([0.9, 0.8]), np.zeros(2, np.int64)
    assert weighted_clusters(states, score, cls, 1 / 3 + 1e-9).count.tolist() == [1, 1]
    assert weighted_clusters(states, score, cls, 1 / 3 - 1e-9).count.tolist() == [2]


def test_the_score_counts_only_cameras_that_have_the_place_in_view():
    cameras = four_cameras()
    inside = fuse_paper(some_boxes([car()] * 3, 0.8), np.arange(3), cameras).boxes
    np.testing.assert_allclose(inside.score, 0.8 * 3 / 4)
    # Where no other camera looks, one is enough.
    alone = fuse_paper(some_boxes([car()], 0.8), np.array([0]), cameras[:1]).boxes
    np.testing.assert_allclose(alone.score, 0.8)
    nowhere = fuse_paper(some_boxes([car(300.0, 300.0)], 0.8), np.array([0]), cameras).boxes
    np.testing.assert_allclose(nowhere.score, 0.8)


def test_equation_12_and_13():
    mean, count, views = np.full(3, 0.4), np.array([1, 2, 4]), np.array([2, 2, 2])
    np.testing.assert_allclose(rescaled_score(mean, count, views), [0.2, 0.4, 0.4])
    np.testing.assert_allclose(rescaled_score(mean, count, views, overflow=True), [0.2, 0.4, 0.8])


def test_nothing_in_nothing_out():
    for cameras in (four_cameras(), []):
        fused = fuse_paper(Boxes.empty(), np.zeros(0, np.int64), cameras)
        assert len(fused.boxes) == 0
        assert fused.members.shape == (0, len(cameras))


@given(st.integers(0, 10_000), st.floats(-3.1, 3.1), st.floats(-300, 300))
@settings(max_examples=15, deadline=None)
def test_moving_the_world_moves_the_boxes_and_their_order_does_not_matter(seed, angle, dx):
    rng = np.random.default_rng(seed)
    states = np.array([car(8.0 * (k // 3), 0.0, 0.3 * (k // 3)) for k in range(9)]) + 0.03 * rng.normal(size=(9, 7))
    boxes, owner, cameras = some_boxes(states, rng.uniform(0.3, 1.0, 9)), np.tile(np.arange(3), 3), four_cameras()
    T, spin = rigid(rotation_z(angle), [dx, 7.0, 2.0]), np.eye(7)
    spin[:3, :3] = T[:3, :3]
    moved = replace(
        boxes,
        center=boxes.center @ T[:3, :3].T + T[:3, 3],
        yaw=wrap_angle(boxes.yaw + angle),
        covariance=spin @ boxes.covariance @ spin.T,
    )
    there_cameras = [replace(camera, T_cam_world=camera.T_cam_world @ invert_rigid(T)) for camera in cameras]
    order = rng.permutation(9)
    here = fuse_paper(boxes, owner, cameras, PaperFusionSettings(view_range_m=200.0))
    there = fuse_paper(moved.take(order), owner[order], there_cameras, PaperFusionSettings(view_range_m=200.0))
    np.testing.assert_array_equal(there.source, here.source[order])
    np.testing.assert_allclose(there.boxes.center, here.boxes.center @ T[:3, :3].T + T[:3, 3], atol=1e-6)
    np.testing.assert_allclose(wrap_angle(there.boxes.yaw - here.boxes.yaw - angle), 0.0, atol=1e-6)
    np.testing.assert_allclose(there.boxes.covariance, spin @ here.boxes.covariance @ spin.T, atol=1e-8)
