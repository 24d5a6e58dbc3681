import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.transforms import invert_rigid, pole_camera_pose, rigid, rotation_z, transform_points, wrap_angle

angles = st.floats(-1e3, 1e3)
coordinates = st.tuples(*[st.floats(-500, 500)] * 3)


@given(st.floats(-1e6, 1e6))
def test_wrapped_angles_lie_in_the_half_open_interval_and_point_the_same_way(angle):
    wrapped = wrap_angle(angle)
    assert -np.pi <= wrapped < np.pi
    np.testing.assert_allclose([np.cos(wrapped), np.sin(wrapped)], [np.cos(angle), np.sin(angle)], atol=1e-9)


@pytest.mark.parametrize("angle", [np.pi, -np.pi, 3 * np.pi, -np.pi - 1e-17, np.nextafter(-np.pi, -4), np.nextafter(np.pi, 4)])
def test_wrap_limits(angle):
    assert -np.pi <= wrap_angle(angle) < np.pi


def test_wrap_known_answers():
    np.testing.assert_allclose(wrap_angle([np.pi, 1.5 * np.pi, -1.5 * np.pi, 0.0]), [-np.pi, -np.pi / 2, np.pi / 2, 0.0])
    assert wrap_angle(np.zeros((0, 2))).shape == (0, 2)


@given(coordinates, angles, angles, angles)
def test_a_pose_times_its_inverse_is_the_identity(position, heading, pitch, roll):
    T = pole_camera_pose(position, heading, pitch, roll)
    np.testing.assert_allclose(T @ invert_rigid(T), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(invert_rigid(invert_rigid(T)), T, atol=1e-9)


@given(coordinates, angles, coordinates, angles, coordinates)
def test_transforms_compose(position_a, angle_a, position_b, angle_b, point):
    A, B = rigid(rotation_z(angle_a), position_a), rigid(rotation_z(angle_b), position_b)
    np.testing.assert_allclose(transform_points(A @ B, point), transform_points(A, transform_points(B, point)), atol=1e-8)


def test_inverse_of_a_batch_is_the_inverse_of_each():
    T = np.stack([pole_camera_pose([i, 2.0, 3.0], 0.3 * i, 0.2) for i in range(4)])
    np.testing.assert_allclose(invert_rigid(T), np.stack([invert_rigid(one) for one in T]))
    assert invert_rigid(np.zeros((0, 4, 4))).shape == (0, 4, 4)


def test_rotation_is_counter_clockwise():
    np.testing.assert_allclose(rotation_z(np.pi / 2) @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)


def test_level_camera_to_the_east_has_south_on_its_right_and_the_ground_below():
    T = pole_camera_pose([0.0, 0.0, 5.0], heading_rad=0.0, pitch_rad=0.0)
    np.testing.assert_allclose(transform_points(T, [10.0, -2.0, 4.0]), [2.0, 1.0, 10.0], atol=1e-12)


def test_positive_pitch_looks_down_and_positive_roll_turns_the_picture_counter_clockwise():
    down = pole_camera_pose([0.0, 0.0, 5.0], 0.0, np.deg2rad(45))
    np.testing.assert_allclose(transform_points(down, [5.0, 0.0, 0.0]), [0.0, 0.0, 5 * np.sqrt(2)], atol=1e-12)
    rolled = pole_camera_pose([0.0, 0.0, 0.0], 0.0, 0.0, np.deg2rad(90))
    # A point on the right moves to the top of the picture: y down, so negative.
    np.testing.assert_allclose(transform_points(rolled, [0.0, -1.0, 0.0]), [0.0, -1.0, 0.0], atol=1e-12)
