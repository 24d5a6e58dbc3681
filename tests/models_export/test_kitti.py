from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models_export.data.kitti import (
    KittiObject,
    box_to_kitti,
    calib_of,
    kitti_to_box,
    occlusion_level,
    read_calib,
    read_labels,
    write_calib,
    write_labels,
)
from service.errors import InputError
from service.geometry.camera import Camera
from service.geometry.transforms import pole_camera_pose, wrap_angle

K = np.array([[700.0, 0, 641.0], [0, 700.0, 191.0], [0, 0, 1]])
CAR = KittiObject("Car", 0.25, 1, -1.5, (10.5, 20.25, 110.0, 80.0), (1.5, 1.7, 4.2), (-3.0, 1.5, 22.0), 0.7)
KITTI_LINE = "Pedestrian 0.00 0 -0.20 712.40 143.00 810.73 307.92 1.89 0.48 1.20 1.84 1.47 8.41 0.01"


def camera(heading: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Camera:
    return Camera("cam", 1284, 384, K, pole_camera_pose([3.0, -2.0, 6.0], heading, pitch, roll))


@given(st.floats(-3.14, 3.14))
def test_level_camera_facing_east_has_the_known_answer(yaw: float) -> None:
    _, rotation_y, _ = box_to_kitti(camera(), [[20, 0, 0.75]], [yaw], [1.5])
    assert abs(wrap_angle(yaw - (-np.pi / 2 - rotation_y[0]))) < 1e-9


def test_location_is_the_bottom_centre() -> None:
    location, _, alpha = box_to_kitti(camera(), [[23.0, -4.0, 0.8]], [0.0], [1.6])
    # 20 m ahead, 2 m to the right, and the ground 6 m below the camera.
    np.testing.assert_allclose(location, [[2.0, 6.0, 20.0]], atol=1e-9)
    np.testing.assert_allclose(alpha, -np.pi / 2 - np.arctan2(2.0, 20.0))


def test_pitch_bends_rotation_y_away_from_gravity() -> None:
    pitch, yaw = np.deg2rad(25), np.deg2rad(40)
    _, rotation_y, _ = box_to_kitti(camera(pitch=pitch), [[20, 0, 0.75]], [yaw], [1.5])
    # In a camera pitched down by p and facing East a level heading is (-sin yaw, cos yaw sin p.., cos yaw cos p).
    expected = -np.arctan2(np.cos(yaw) * np.cos(pitch), -np.sin(yaw))
    np.testing.assert_allclose(rotation_y, expected)
    assert abs(wrap_angle(yaw + np.pi / 2 + rotation_y[0])) > np.deg2rad(2)


@given(
    yaw=st.floats(-3.14, 3.14),
    heading=st.floats(-3.1, 3.1),
    pitch=st.floats(0, 0.6),
    roll=st.floats(-0.1, 0.1),
    x=st.floats(-30, 30),
)
def test_boxes_come_back_from_any_known_camera(yaw: float, heading: float, pitch: float, roll: float, x: float) -> None:
    cam = camera(heading, pitch, roll)
    center = np.array([[x, 12.0, 0.9]])
    location, rotation_y, _ = box_to_kitti(cam, center, [yaw], [1.8])
    back, back_yaw = kitti_to_box(cam, location, rotation_y, [1.8])
    np.testing.assert_allclose(back, center, atol=1e-9)
    assert abs(wrap_angle(back_yaw[0] - yaw)) < 1e-9


def test_no_boxes() -> None:
    location, rotation_y, alpha = box_to_kitti(camera(), np.zeros((0, 3)), [], [])
    assert location.shape == (0, 3)
    assert len(rotation_y) == len(alpha) == 0


@pytest.mark.parametrize(
    ("visible", "level"), [(1.0, 0), (0.85, 0), (0.8, 1), (0.5, 1), (0.4, 2), (0.15, 2), (0.1, 3), (0.0, 3)]
)
def test_occlusion_levels(visible: float, level: int) -> None:
    assert occlusion_level(visible) == level


def test_labels_and_results_come_back(tmp_path: Path) -> None:
    result = KittiObject(**{**vars(CAR), "score": 0.875, "truncated": -1.0, "occluded": -1})
    for name, objects in (("label.txt", [CAR, CAR]), ("result.txt", [result]), ("none.txt", [])):
        write_labels(tmp_path / name, objects)
        assert read_labels(tmp_path / name) == objects


def test_a_line_of_the_kitti_data_set(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(KITTI_LINE + "\n\n")
    (found,) = read_labels(tmp_path / "a.txt")
    assert (found.type, found.occluded, found.dims_hwl, found.location) == (
        "Pedestrian",
        0,
        (1.89, 0.48, 1.2),
        (1.84, 1.47, 8.41),
    )
    assert found.score is None


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("Car 0 0", "3 columns"),
        (KITTI_LINE.replace("8.41", "nan"), "'nan'"),
        (KITTI_LINE.replace("8.41", "x"), "'x'"),
        (KITTI_LINE.replace("0.00 0 ", "0.00 7 "), "occluded is 7"),
    ],
)
def test_a_bad_label_names_file_and_line(tmp_path: Path, line: str, said: str) -> None:
    path = tmp_path / "bad.txt"
    path.write_text(f"{KITTI_LINE}\n{line}\n")
    with pytest.raises(InputError, match=said) as caught:
        read_labels(path)
    assert caught.value.field == f"{path}:2"
    assert caught.value.remedy


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"absent\.txt"):
        read_labels(tmp_path / "absent.txt")


def test_calibration_comes_back(tmp_path: Path) -> None:
    cam = camera(0.4, 0.3, 0.01)
    write_calib(tmp_path / "c.txt", calib_of(cam))
    calib = read_calib(tmp_path / "c.txt")
    np.testing.assert_allclose(calib.P2, np.column_stack([K, np.zeros(3)]))
    np.testing.assert_allclose(calib.Tr_velo_to_cam, cam.T_cam_world[:3], atol=1e-9)
    point = calib.P2 @ np.append(calib.Tr_velo_to_cam @ [9.0, 4.0, 1.0, 1.0], 1.0)
    np.testing.assert_allclose(point[:2] / point[2], cam.project([9.0, 4.0, 1.0])[0], atol=1e-6)


def test_bad_calibrations_name_what_is_wrong(tmp_path: Path) -> None:
    path = tmp_path / "c.txt"
    write_calib(path, calib_of(camera()))
    text = path.read_text()
    path.write_text(text.replace("R0_rect", "other"))
    with pytest.raises(InputError, match="R0_rect"):
        read_calib(path)
    path.write_text(text.replace("P1: ", "P1: 5 "))
    with pytest.raises(InputError, match="P1 has 13 numbers") as caught:
        read_calib(path)
    assert caught.value.field == f"{path}:2"


def test_distortion_cannot_be_exported() -> None:
    bent = Camera("bent", 1284, 384, K, np.eye(4), np.array([0.1, 0, 0, 0]))
    with pytest.raises(InputError, match="bent"):
        calib_of(bent)
