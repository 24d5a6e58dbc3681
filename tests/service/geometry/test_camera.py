import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.camera import Camera, ray_azimuth, yaw_from_alpha
from service.geometry.transforms import pole_camera_pose, wrap_angle

K = np.array([[642.0, 0.0, 641.5], [0.0, 640.0, 191.5], [0.0, 0.0, 1.0]])
LENSES = {
    "none": [],
    "four": [-0.2, 0.05, 0.001, -0.002],
    "five": [-0.3, 0.09, 0.001, -0.001, 0.0],
    "rational": [-0.1, 0.02, 0.001, 0.0, 0.01, 0.2, 0.02, 0.005],
}


def pole_camera(lens="none", heading=0.0, pitch=0.26, skew=0.0):
    intrinsics = K.copy()
    intrinsics[0, 1] = skew
    pose = pole_camera_pose([3.0, -4.0, 6.0], heading, pitch)
    return Camera("north", 1284, 384, intrinsics, pose, np.array(LENSES[lens]))


@pytest.mark.parametrize("lens", LENSES)
@given(st.floats(0, 1283), st.floats(0, 383), st.floats(1, 200))
def test_project_undoes_unproject(lens, u, v, depth):
    camera = pole_camera(lens, skew=0.5)
    pixels, depths = camera.project(camera.unproject([u, v], depth))
    np.testing.assert_allclose(pixels, [u, v], atol=1e-6)
    np.testing.assert_allclose(depths, depth, rtol=1e-9)


@pytest.mark.parametrize("lens", LENSES)
def test_round_trips_keep_the_shape_also_of_nothing(lens):
    camera = pole_camera(lens)
    assert camera.normalised_from_pixels(np.full((2, 5, 2), 100.0)).shape == (2, 5, 2)
    assert camera.unproject(np.zeros((0, 2)), np.zeros(0)).shape == (0, 3)
    assert camera.project_cam(np.zeros((0, 8, 3))).shape == (0, 8, 2)


def test_undistorting_far_outside_of_the_picture_stays_finite():
    pixels = np.array([[-1e5, 50.0], [1e6, 1e6], [641.5, -3e4]])
    assert np.isfinite(pole_camera("five").normalised_from_pixels(pixels)).all()


def test_lens_moves_points_as_the_model_says():
    camera = Camera("c", 1284, 384, K, np.eye(4), np.array([-0.2, 0.0, 0.0, 0.0]))
    # At x/z = 0.5: r^2 = 0.25, factor 1 - 0.2 * 0.25 = 0.95.
    np.testing.assert_allclose(camera.project_cam([1.0, 0.0, 2.0]), [641.5 + 642 * 0.5 * 0.95, 191.5])


def test_optical_axis_hits_the_principal_point_and_position_is_the_pole():
    camera = pole_camera(pitch=np.deg2rad(45))
    np.testing.assert_allclose(camera.position_m, [3.0, -4.0, 6.0])
    pixels, depth = camera.project([9.0, -4.0, 0.0])
    np.testing.assert_allclose(pixels, [641.5, 191.5], atol=1e-9)
    np.testing.assert_allclose(depth, 6 * np.sqrt(2))


def test_points_behind_the_camera_have_negative_depth_and_finite_pixels():
    pixels, depth = pole_camera().project([-20.0, -4.0, 6.0])
    assert depth < 0
    assert np.isfinite(pixels).all()


def test_scaled_camera_sees_the_middle_of_each_pixel_block():
    camera = pole_camera()
    half = camera.scaled(642, 192)
    full, _ = camera.project([20.0, -3.0, 0.5])
    small, _ = half.project([20.0, -3.0, 0.5])
    # Pixel 0 of the half image covers pixels 0 and 1, whose middle is 0.5.
    np.testing.assert_allclose(2 * small + 0.5, full, atol=1e-9)
    back = half.scaled(1284, 384)
    np.testing.assert_allclose(back.K, camera.K, atol=1e-9)


def test_yaw_is_the_ray_azimuth_for_a_vehicle_that_drives_straight_away():
    camera = pole_camera(heading=np.deg2rad(70), pitch=np.deg2rad(20))
    target = camera.position_m + np.array([8.0, 14.0, -6.0])
    pixels, _ = camera.project(target)
    np.testing.assert_allclose(ray_azimuth(camera, pixels), np.arctan2(14.0, 8.0))
    np.testing.assert_allclose(yaw_from_alpha(camera, 0.0, pixels), np.arctan2(14.0, 8.0))


@given(st.floats(-3.1, 3.1), st.floats(0.0, 0.6), st.floats(-3.1, 3.1), st.floats(100, 1180), st.floats(100, 380))
def test_yaw_from_alpha_is_about_gravity_at_every_pitch(heading, pitch, alpha, u, v):
    camera = pole_camera(heading=heading, pitch=pitch)
    ground_ray = camera.rays_world([u, v])
    yaw = yaw_from_alpha(camera, alpha, [u, v])
    np.testing.assert_allclose(wrap_angle(yaw - np.arctan2(ground_ray[1], ground_ray[0]) - alpha), 0.0, atol=1e-9)


@given(st.floats(-3.1, 3.1))
def test_tilt_trap_level_camera_to_the_east(rotation_y):
    """World yaw of KITTI's rotation_y seen by a level camera that faces East is -pi/2 - rotation_y."""
    camera = pole_camera(heading=0.0, pitch=0.0)
    heading_cam = np.array([np.cos(rotation_y), 0.0, -np.sin(rotation_y)])
    heading_world = heading_cam @ camera.R_cam_world
    yaw = np.arctan2(heading_world[1], heading_world[0])
    np.testing.assert_allclose(wrap_angle(yaw - (-np.pi / 2 - rotation_y)), 0.0, atol=1e-9)


def test_tilt_trap_pitched_camera_sees_another_rotation_y():
    """Heading North-East before a camera that faces East and is pitched by 30 degrees.

    d = (1/sqrt 2)(East + North); in the camera: right = -North, forward = cos 30 East, so d_x = -1/sqrt 2 and
    d_z = cos 30 / sqrt 2; rotation_y = -atan2(d_z, d_x). Reading it as if the camera were level misses the yaw by 4.1 degrees.
    """
    camera = pole_camera(heading=0.0, pitch=np.deg2rad(30))
    yaw = np.pi / 4
    d = camera.R_cam_world @ [np.cos(yaw), np.sin(yaw), 0.0]
    rotation_y = -np.arctan2(d[2], d[0])
    np.testing.assert_allclose(rotation_y, -np.arctan2(np.cos(np.pi / 6), -1.0))
    naive = wrap_angle(-np.pi / 2 - rotation_y)
    np.testing.assert_allclose(np.rad2deg(naive - yaw), 4.1066, atol=1e-3)
