from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models_export.data.carla_convert import (
    CarlaPose,
    box_enu,
    camera_from_enu,
    camera_pose,
    flip_y,
    pose_carla,
    pose_enu,
    rotation_enu,
)
from models_export.data.kitti import box_to_kitti
from service.geometry.camera import Camera
from service.geometry.transforms import pole_camera_pose, transform_points, wrap_angle

F = np.diag([1.0, -1.0, 1.0, 1.0])
METRES = st.floats(-400, 400, width=32)
poses = st.builds(
    CarlaPose,
    METRES,
    METRES,
    st.floats(-50, 50, width=32),
    st.floats(-90, 90, width=32),
    st.floats(-180, 180, width=32),
    st.floats(-180, 180, width=32),
)
points = st.lists(st.floats(-60, 60, width=32), min_size=3, max_size=3)


@pytest.fixture(scope="module")
def carla() -> Any:
    return pytest.importorskip("carla", reason="needs CARLA's client: pip install 'quadlift[carla]'")


def packaged(carla: Any, pose: CarlaPose) -> Any:
    return carla.Transform(carla.Location(pose.x, pose.y, pose.z), carla.Rotation(pose.pitch, pose.yaw, pose.roll))


# ------------------------------------------------------------------ against the package, which computes in float32


@given(pose=poses)
def test_matrices_are_the_package_s_mirrored(carla: Any, pose: CarlaPose) -> None:
    transform = packaged(carla, pose)
    T, T_inverse = pose_enu(pose), np.linalg.inv(pose_enu(pose))
    theirs, their_inverse = np.array(transform.get_matrix()), np.array(transform.get_inverse_matrix())
    scale = 1.0 + np.abs(T[:3, 3]).max()
    np.testing.assert_allclose((F @ theirs @ F)[:3, :3], T[:3, :3], atol=1e-6)
    np.testing.assert_allclose((F @ theirs @ F)[:, 3], T[:, 3], atol=1e-6)
    np.testing.assert_allclose((F @ their_inverse @ F)[:3, :3], T_inverse[:3, :3], atol=1e-6)
    np.testing.assert_allclose((F @ their_inverse @ F)[:, 3], T_inverse[:, 3], atol=1e-6 * scale)


@given(pose=poses, point=points)
def test_points_go_where_the_package_moves_them(carla: Any, pose: CarlaPose, point: list[float]) -> None:
    transform, T = packaged(carla, pose), pose_enu(pose)
    scale = 1.0 + np.abs(T[:3, 3]).max() + np.abs(point).max()
    there, back = transform.transform(carla.Vector3D(*point)), transform.inverse_transform(carla.Vector3D(*point))
    np.testing.assert_allclose(transform_points(T, flip_y(point)), flip_y([there.x, there.y, there.z]), atol=1e-6 * scale)
    mine = transform_points(np.linalg.inv(T), flip_y(point))
    np.testing.assert_allclose(mine, flip_y([back.x, back.y, back.z]), atol=1e-6 * scale)


@given(pose=poses)
def test_axes_are_the_package_s_vectors(carla: Any, pose: CarlaPose) -> None:
    R = pose_enu(pose)[:3, :3]
    transform = packaged(carla, pose)
    forward, right, up = transform.get_forward_vector(), transform.get_right_vector(), transform.get_up_vector()
    for column, axis in ((R[:, 0], forward), (-R[:, 1], right), (R[:, 2], up)):
        np.testing.assert_allclose(column, flip_y([axis.x, axis.y, axis.z]), atol=1e-6)


@given(pose=poses, point=points)
def test_camera_axes_are_y_minus_z_x_of_the_sensor(carla: Any, pose: CarlaPose, point: list[float]) -> None:
    local = packaged(carla, pose).inverse_transform(carla.Vector3D(*point))
    mine = transform_points(camera_from_enu(pose), flip_y(point))
    scale = 1.0 + max(abs(pose.x), abs(pose.y), abs(pose.z)) + np.abs(point).max()
    np.testing.assert_allclose(mine, [local.y, -local.z, local.x], atol=1e-6 * scale)


@given(pose=poses, offset=points, turn=st.floats(-180, 180, width=32))
def test_a_box_has_the_package_s_corners(carla: Any, pose: CarlaPose, offset: list[float], turn: float) -> None:
    """For an upright actor the eight corners are CARLA's own, whatever the box's offset and turn."""
    pose = CarlaPose(pose.x, pose.y, pose.z, yaw=pose.yaw)
    box = carla.BoundingBox(carla.Location(*offset), carla.Vector3D(2.25, 1.0, 0.75))
    box.rotation = carla.Rotation(yaw=turn)
    corners = np.array([[v.x, v.y, v.z] for v in box.get_world_vertices(packaged(carla, pose))])
    center, dims, yaw = box_enu(pose, offset, CarlaPose(yaw=turn), [2.25, 1.0, 0.75])
    scale = 1.0 + max(abs(pose.x), abs(pose.y), abs(pose.z)) + np.abs(offset).max()
    local = (flip_y(corners) - center) @ np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    np.testing.assert_allclose(np.abs(local), np.broadcast_to(dims / 2, (8, 3)), atol=2e-6 * scale)
    np.testing.assert_allclose(dims, [4.5, 2.0, 1.5])


# ------------------------------------------------------------------ laws and known answers


@given(pose=poses)
def test_poses_come_back(pose: CarlaPose) -> None:
    np.testing.assert_allclose(pose_enu(pose_carla(pose_enu(pose))), pose_enu(pose), atol=1e-8)
    np.testing.assert_allclose(camera_from_enu(camera_pose(camera_from_enu(pose))), camera_from_enu(pose), atol=1e-7)


@given(yaw=st.floats(-180, 180), roll=st.floats(-180, 180), pitch=st.sampled_from([-90.0, 90.0]))
def test_a_nose_straight_up_or_down_comes_back(yaw: float, roll: float, pitch: float) -> None:
    T = pose_enu(CarlaPose(1.0, 2.0, 3.0, pitch, yaw, roll))
    np.testing.assert_allclose(pose_enu(pose_carla(T)), T, atol=1e-7)


@given(pitch=st.floats(-90, 90), yaw=st.floats(-360, 360), roll=st.floats(-360, 360))
def test_rotations_are_rotations(pitch: float, yaw: float, roll: float) -> None:
    R = rotation_enu(pitch, yaw, roll)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)


@pytest.mark.parametrize(("yaw_deg", "expected"), [(0.0, 0.0), (90.0, -np.pi / 2), (-90.0, np.pi / 2), (180.0, -np.pi)])
def test_clockwise_turns_become_counter_clockwise(yaw_deg: float, expected: float) -> None:
    center, _, yaw = box_enu(CarlaPose(10, 20, 0, yaw=yaw_deg), [0, 0, 0.7], CarlaPose(), [2, 1, 0.7])
    np.testing.assert_allclose(center, [10, -20, 0.7], atol=1e-12)
    assert abs(wrap_angle(yaw - expected)) < 1e-12


def test_the_heading_of_a_tilted_car_is_about_gravity() -> None:
    _, _, yaw = box_enu(CarlaPose(pitch=20, yaw=-30, roll=12), [0, 0, 0], CarlaPose(), [2, 1, 0.7])
    assert yaw == pytest.approx(np.deg2rad(30))


def test_a_pole_camera_is_the_same_either_way() -> None:
    """Heading 40 degrees counter-clockwise, 15 down: in CARLA yaw -40, pitch -15."""
    pole = pole_camera_pose([5.0, 7.0, 6.0], np.deg2rad(40), np.deg2rad(15))
    pose = camera_pose(pole)
    np.testing.assert_allclose([pose.x, pose.y, pose.z, pose.pitch, pose.yaw, pose.roll], [5, -7, 6, -15, -40, 0], atol=1e-9)


@given(yaw_deg=st.floats(-180, 180))
def test_kitti_of_an_actor_on_a_level_camera(yaw_deg: float) -> None:
    """(x, y, z)_kitti = (Y, -Z, X) of the actor in the camera's frame; rotation_y = CARLA's relative yaw - 90 degrees."""
    sensor = CarlaPose(3.0, -4.0, 5.0, yaw=25.0)
    camera = Camera("c", 64, 32, np.eye(3), camera_from_enu(sensor))
    center, dims, yaw = box_enu(CarlaPose(20.0, 9.0, 0.0, yaw=yaw_deg), [0, 0, 0.75], CarlaPose(), [2, 1, 0.75])
    location, rotation_y, _ = box_to_kitti(camera, center, yaw, dims[2])
    c, s = np.cos(np.deg2rad(25)), np.sin(np.deg2rad(25))
    ahead, right = c * 17 + s * 13, -s * 17 + c * 13
    np.testing.assert_allclose(location, [[right, 5.0, ahead]], atol=1e-9)
    assert abs(wrap_angle(rotation_y[0] - np.deg2rad(yaw_deg - 25 - 90))) < 1e-9
