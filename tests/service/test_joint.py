"""Vehicles of several cameras, solved as one box from all their terms."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.fusion import FusionSettings, fuse
from service.geometry.boxes import Boxes, box_states, project_extents
from service.geometry.camera import Camera
from service.geometry.ground import GroundPlane
from service.geometry.transforms import invert_rigid, pole_camera_pose, rigid, rotation_z, wrap_angle
from service.joint import shared_covariance, solve_jointly
from service.lifting import LiftSettings, lift_with_terms
from service.measurements import Measurements
from service.residuals import FIXED_ROWS, normal_equations, residuals
from service.solver import SolverSettings, covariance_of

K = np.array([[642.0, 0.0, 641.5], [0.0, 642.0, 191.5], [0.0, 0.0, 1.0]])
SIGMA = np.array([2.0, 2.0, 2.0, 2.0, 0.2, 0.06, 0.06, 0.07])
"""Edges in px, length, width, height in metres, yaw in radians."""
CONVERGED = SolverSettings(iterations=60, step_tolerance=1e-6)
EXACT_CAMERAS = FusionSettings(calibration_sigma_m=0.0, calibration_sigma_rad=0.0)
GROUND = LiftSettings(ground_sigma_per_m=0.0)


def cameras():
    """Two cameras 6 m up, 25 m south and west of the place they look at."""
    poses = [pole_camera_pose([25 * np.cos(a), 25 * np.sin(a), 6.0], a + np.pi, np.deg2rad(14)) for a in (-np.pi / 2, -np.pi)]
    return [Camera(f"c{row}", 1284, 384, K, pose) for row, pose in enumerate(poses)]


def seen(count, rng, noise=1.0, size_noise_shared=False):
    """States (count, 7) of cars at the crossing, and what both cameras measure: vehicle by vehicle."""
    dims = np.array([4.3, 1.8, 1.55]) + SIGMA[4:7] * rng.normal(size=(count, 3))
    z = dims[:, 2] / 2 + 0.05 * noise * rng.normal(size=count)
    truth = np.c_[rng.uniform(-5, 5, (count, 2)), z, dims, rng.uniform(-3, 3, count)]
    parts = [project_extents(camera, truth[:, :3], truth[:, 3:6], truth[:, 6])[0] for camera in cameras()]
    errors = noise * SIGMA * rng.normal(size=(2, count, 8))
    if size_noise_shared:
        errors[1, :, 4:7] = errors[0, :, 4:7]
    rows = np.arange(2 * count).reshape(2, count).T.ravel()
    xyxy, errors, states = np.concatenate(parts)[rows], errors.reshape(-1, 8)[rows], np.concatenate([truth, truth])[rows]
    n = 2 * count
    return truth, Measurements(
        camera_index=np.tile([0, 1], count),
        xyxy_px=xyxy + errors[:, :4],
        sigma_px=np.full((n, 4), SIGMA[0]),
        dims_lwh=states[:, 3:6] + errors[:, 4:7],
        sigma_dims=np.tile(SIGMA[4:7], (n, 1)),
        yaw=wrap_angle(states[:, 6] + errors[:, 7]),
        sigma_yaw=np.full(n, SIGMA[7]),
        flip_log_odds=np.full(n, 2.0),
        score=np.linspace(0.5, 0.9, n),
        cls=np.zeros(n, np.int64),
        depth_m=np.full(n, np.nan),
        sigma_depth_m=np.full(n, np.nan),
    )


def lifted(measurements, rig=None, ground=None):
    return lift_with_terms(rig or cameras(), ground or GroundPlane(), measurements, GROUND)


def pairs(boxes):
    """Rows of the first cameras' boxes, and the vehicle of every box."""
    return np.arange(0, len(boxes), 2), np.repeat(np.arange(len(boxes) // 2), 2)


def test_exact_measurements_give_the_exact_box():
    truth, measurements = seen(100, np.random.default_rng(0), noise=0.0)
    boxes, terms = lifted(measurements)
    first, vehicle = pairs(boxes)
    state, _ = solve_jointly(terms, vehicle, box_states(boxes)[first], CONVERGED)
    assert np.quantile(np.linalg.norm(state[:, :3] - truth[:, :3], axis=1), 0.95) < 0.01


def test_the_joint_solve_is_honest_and_beats_adding_up_boxes():
    """Mean normalised squared error 3 for 3 degrees of freedom, though both cameras have the size wrong by the same amount."""
    truth, measurements = seen(600, np.random.default_rng(1), size_noise_shared=True)
    boxes, terms = lifted(measurements)
    first, vehicle = pairs(boxes)
    state, covariance = solve_jointly(terms, vehicle, box_states(boxes)[first], SolverSettings())
    error = state[:, :3] - truth[:, :3]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance[:, :3, :3]), error)
    assert 2.5 < nees.mean() < 3.5
    added = [fuse(boxes.take(rows), np.arange(2), cameras(), EXACT_CAMERAS).boxes for rows in np.split(np.arange(1200), 600)]
    one = np.array([len(b) == 1 for b in added])
    apart = np.array([np.linalg.norm(b.center[0] - t[:3]) for b, t in zip(added, truth, strict=True)])
    assert one.mean() > 0.97
    assert np.sqrt(np.mean(np.sum(error[one] ** 2, 1))) < 0.97 * np.sqrt(np.mean(apart[one] ** 2))


def test_of_one_camera_it_is_the_lifted_box():
    _, measurements = seen(20, np.random.default_rng(2))
    boxes, terms = lift_with_terms(cameras(), GroundPlane(), measurements, replace(GROUND, solver=CONVERGED))
    state, covariance = solve_jointly(terms, np.arange(40), box_states(boxes), CONVERGED)
    np.testing.assert_allclose(state[:, :3], boxes.center, atol=1e-4)
    np.testing.assert_allclose(covariance, boxes.covariance, rtol=1e-2, atol=1e-5)


def test_two_cameras_that_are_one_know_size_and_road_no_better():
    """With edges that say nothing, what is left is the size and the ground, which are the same in both."""
    _, measurements = seen(10, np.random.default_rng(3))
    _, terms = lifted(replace(measurements, sigma_px=np.full((20, 4), 1e3)))
    start = terms.prior[::2]
    _, once = solve_jointly(terms.take(np.arange(0, 20, 2)), np.arange(10), start, CONVERGED)
    _, twice = solve_jointly(terms.take(np.repeat(np.arange(0, 20, 2), 2)), np.repeat(np.arange(10), 2), start, CONVERGED)
    shared = [2, 3, 4, 5]
    np.testing.assert_allclose(twice[:, shared, shared], once[:, shared, shared], rtol=0.02)
    np.testing.assert_allclose(twice[:, 6, 6], once[:, 6, 6] / 2, rtol=0.02)


def test_a_camera_that_contradicts_a_surer_one_gives_way():
    """The second camera's outlines lie 25 px too low, and it knows its edges half as well."""
    truth, measurements = seen(60, np.random.default_rng(6), noise=0.3)
    second = measurements.camera_index == 1
    wrong = replace(
        measurements,
        xyxy_px=measurements.xyxy_px + 25.0 * second[:, None] * np.array([0.0, 1.0, 0.0, 1.0]),
        sigma_px=measurements.sigma_px * np.where(second, 1.0, 0.5)[:, None],
    )
    boxes, terms = lift_with_terms(cameras(), GroundPlane(), wrong, replace(GROUND, tail_sigmas=1.4))
    joined = replace(EXACT_CAMERAS, gate=1e4, max_distance_m=20.0, tail_share=0.5)
    apart = []
    for number, own in enumerate(np.split(np.arange(120), 60)):
        fused = fuse(boxes.take(own), np.arange(2), cameras(), joined, terms.take(own)).boxes
        assert len(fused) == 1
        centers = np.concatenate([fused.center, boxes.center[own]])
        apart.append(np.linalg.norm(centers - truth[number, :3], axis=1))
    ours, surer, other = np.median(apart, axis=0)
    assert other > 1.0
    assert ours < 1.2 * surer


def test_a_flipped_heading_is_the_same_axis():
    _, measurements = seen(10, np.random.default_rng(4))
    turned = replace(measurements, yaw=wrap_angle(measurements.yaw + np.pi * (np.arange(20) % 2)))
    first, vehicle = pairs(range(20))
    states = []
    for m in (measurements, turned):
        boxes, terms = lifted(m)
        states.append(solve_jointly(terms, vehicle, box_states(boxes)[first], CONVERGED)[0])
    np.testing.assert_allclose(states[1], states[0], atol=1e-6)


def test_a_shifted_picture_counts_as_correlated_edges():
    """Marginalising the shift is the same as edges whose errors have its variance in common."""
    _, measurements = seen(5, np.random.default_rng(5))
    boxes, terms = lifted(measurements)
    shift = np.linspace(1e-3, 1e-2, 10)
    loose = replace(terms, shift_sigma=shift, tail=np.full_like(terms.tail, 1e9))
    states = box_states(boxes)
    residual, jacobian = residuals(loose, states)
    equations = normal_equations(loose, states)
    for row in range(10):
        noise = np.eye(FIXED_ROWS)
        moved = np.zeros((FIXED_ROWS, 2))
        moved[[2, 4], 0], moved[[3, 5], 1] = terms.edge_weight[row, [0, 2]], terms.edge_weight[row, [1, 3]]
        information = np.linalg.inv(noise + shift[row] ** 2 * moved @ moved.T)
        hessian = jacobian[row].T @ information @ jacobian[row] + np.diag(terms.prior_weight[row] ** 2)
        np.testing.assert_allclose(equations.hessian[row], hessian, rtol=1e-6, atol=1e-6)
        offset = states[row] - terms.prior[row]
        cost = 0.5 * residual[row] @ information @ residual[row] + 0.5 * np.sum((offset * terms.prior_weight[row]) ** 2)
        np.testing.assert_allclose(equations.cost[row], cost, rtol=1e-6)


def test_doubt_about_calibration_widens_the_covariance():
    _, measurements = seen(10, np.random.default_rng(6))
    boxes, terms = lifted(measurements)
    camera_index = measurements.camera_index
    sure = fuse(boxes, camera_index, cameras(), EXACT_CAMERAS, terms).boxes.covariance
    unsure = fuse(boxes, camera_index, cameras(), FusionSettings(), terms).boxes.covariance
    assert np.linalg.det(unsure[:, :2, :2]).mean() > 1.2 * np.linalg.det(sure[:, :2, :2]).mean()


def test_what_cameras_share_is_part_of_the_covariance():
    _, measurements = seen(50, np.random.default_rng(7))
    boxes, terms = lifted(measurements)
    shared = shared_covariance(boxes.covariance, terms)
    assert (np.linalg.eigvalsh(shared) > -1e-12).all()
    assert (np.linalg.eigvalsh(boxes.covariance[:, :2, :2] - shared) > -1e-9).mean() > 0.95
    blind = lift_with_terms(cameras(), GroundPlane(), measurements, LiftSettings(ground_sigma_m=1e3))
    assert shared[:, 0, 0].mean() > shared_covariance(boxes.covariance, blind[1])[:, 0, 0].mean()


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_order_of_cameras_and_boxes_does_not_matter(order):
    rng = np.random.default_rng(8)
    _, measurements = seen(8, rng)
    boxes, terms = lifted(measurements)
    here = fuse(boxes, measurements.camera_index, cameras(), terms=terms)
    shuffle = rng.permutation(16)
    rig = [cameras()[row] for row in order]
    renamed = np.array(order)[measurements.camera_index[shuffle]]
    there = fuse(boxes.take(shuffle), renamed, rig, terms=terms.take(shuffle))
    np.testing.assert_allclose(box_states(there.boxes), box_states(here.boxes), atol=1e-6)
    np.testing.assert_allclose(there.boxes.covariance, here.boxes.covariance, atol=1e-8)
    np.testing.assert_array_equal(there.source, here.source[shuffle])


@given(st.floats(-3.1, 3.1), st.floats(-200, 200), st.floats(-200, 200))
@settings(max_examples=8, deadline=None)
def test_moving_the_world_moves_the_fused_boxes_with_it(angle, dx, dy):
    _, measurements = seen(6, np.random.default_rng(9))
    T = rigid(rotation_z(angle), [dx, dy, 1.5])
    rig = [replace(camera, T_cam_world=camera.T_cam_world @ invert_rigid(T)) for camera in cameras()]
    precise = replace(FusionSettings(), solver=CONVERGED)
    results = []
    moved_ground = GroundPlane(np.array([0.0, 0.0, 1.0]), 1.5)
    moved = replace(measurements, yaw=wrap_angle(measurements.yaw + angle))
    for place, ground, m in ((cameras(), GroundPlane(), measurements), (rig, moved_ground, moved)):
        boxes, terms = lift_with_terms(place, ground, m, replace(GROUND, solver=CONVERGED))
        fused = fuse(boxes, m.camera_index, place, precise, terms)
        results.append(fused.boxes.take(fused.source))
    here, there = results
    np.testing.assert_allclose(there.center, here.center @ T[:3, :3].T + T[:3, 3], atol=2e-3)
    np.testing.assert_allclose(np.sin(there.yaw - here.yaw - angle), 0.0, atol=1e-3)
    rotated = T[:3, :3] @ here.covariance[:, :3, :3] @ T[:3, :3].T
    np.testing.assert_allclose(there.covariance[:, :3, :3], rotated, rtol=0.05, atol=1e-4)


def test_the_covariance_is_that_of_the_hessian():
    rng = np.random.default_rng(10)
    root = rng.normal(size=(5, 7, 7)) * 10.0 ** rng.uniform(-2, 2, (5, 1, 7))
    hessian = root.transpose(0, 2, 1) @ root
    np.testing.assert_allclose(covariance_of(hessian) @ hessian, np.tile(np.eye(7), (5, 1, 1)), atol=1e-3)


def test_one_camera_alone_and_no_boxes():
    _, measurements = seen(1, np.random.default_rng(11))
    alone = Measurements(**{f.name: getattr(measurements, f.name)[::2] for f in fields(Measurements)})
    boxes, terms = lifted(alone)
    fused = fuse(boxes, alone.camera_index, cameras(), EXACT_CAMERAS, terms)
    np.testing.assert_allclose(box_states(fused.boxes.take(fused.source)), box_states(boxes), atol=1e-9)
    none = lift_with_terms(
        cameras(), GroundPlane(), Measurements(**{f.name: getattr(alone, f.name)[:0] for f in fields(alone)})
    )
    assert none[1] is None
    assert len(fuse(Boxes.empty(), np.zeros(0, np.int64), cameras(), terms=none[1]).boxes) == 0
