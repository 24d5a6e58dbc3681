from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models_export.data.carla_images import (
    bgra,
    depth_m_of,
    field_of_view_deg,
    instance_ids_of,
    intrinsics,
    rgb_of,
    stored_depth,
)
from models_export.data.carla_sight import FILL, measure_boxes
from service.errors import FrameError
from service.geometry.camera import Camera
from service.geometry.transforms import pole_camera_pose


def pixel(b: int, g: int, r: int) -> np.ndarray:
    return np.array([[[b, g, r, 255]]], dtype=np.uint8)


def test_colours_change_sides() -> None:
    picture = bgra(bytes([1, 2, 3, 255, 4, 5, 6, 255]), 2, 1)
    assert rgb_of(picture).tolist() == [[[3, 2, 1], [6, 5, 4]]]
    assert rgb_of(picture).flags.c_contiguous


def test_a_picture_of_another_size_is_refused() -> None:
    with pytest.raises(FrameError, match="7 bytes for 2 x 1 px"):
        bgra(b"1234567", 2, 1)


@pytest.mark.parametrize(("rgb", "metres"), [((0, 0, 0), 0.0), ((255, 255, 255), 1000.0), ((0, 0, 1), 65536 / 16777.215)])
def test_depths_of_the_reference(rgb: tuple[int, int, int], metres: float) -> None:
    assert depth_m_of(pixel(rgb[2], rgb[1], rgb[0]))[0, 0] == pytest.approx(metres)


def test_stored_depth_has_none_for_the_far() -> None:
    stored = stored_depth(np.array([[0.0, 1.0, 254.996, 255.01, 1000.0]]))
    assert stored.dtype == np.uint16
    assert stored.tolist() == [[0, 256, 65279, 0, 0]]


@given(st.integers(0, 0xFFFF))
def test_ids_are_two_bytes_green_first(number: int) -> None:
    assert instance_ids_of(pixel(number >> 8, number & 0xFF, 14))[0, 0] == number


@given(width=st.integers(16, 4000), height=st.integers(16, 4000), fov=st.floats(5, 150))
def test_fields_of_view_come_back(width: int, height: int, fov: float) -> None:
    K = intrinsics(width, height, fov)
    assert field_of_view_deg(width, K[0, 0]) == pytest.approx(fov)
    # The picture's left edge, half a pixel left of the first centre, lies at half the field of view.
    edge = (-0.5 - K[0, 2]) / K[0, 0]
    assert np.rad2deg(np.arctan(-edge)) == pytest.approx(fov / 2)
    assert K[1, 2] == (height - 1) / 2


# ------------------------------------------------------------------ visible fraction

CAMERA = Camera("c", 320, 200, intrinsics(320, 200, 70.0), pole_camera_pose([0, 0, 1.0], 0.0, 0.0))
ONE = (np.array([[20.0, 0.0, 1.0]]), np.array([[4.0, 4.0, 2.0]]), np.zeros(1))
IDS = np.array([70_007])


def scene(columns: slice, wall_m: float | None = None, wall: slice = slice(0)) -> tuple[np.ndarray, np.ndarray]:
    """The box's front face (18 m away) shown on some columns; a wall before it on others."""
    instance, depth = np.zeros((200, 320), np.uint16), np.full((200, 320), 1000.0)
    f, (cx, cy) = CAMERA.K[0, 0], CAMERA.K[:2, 2]
    u, v = np.meshgrid(np.arange(320), np.arange(200))
    face = (np.abs(u - cx) < 2 / 18 * f) & (np.abs(v - cy) < 1 / 18 * f)
    shown = face & np.isin(u, np.arange(320)[columns])
    instance[shown], depth[shown] = 70_007 & 0xFFFF, 18.0
    if wall_m is not None:
        hidden = np.isin(u, np.arange(320)[wall])
        instance[hidden], depth[hidden] = 3, wall_m
    return instance, depth


def test_a_box_that_nothing_hides_is_visible() -> None:
    sight = measure_boxes(CAMERA, IDS, ONE, *scene(slice(0, 320)))
    assert sight.visible.tolist() == [1.0]
    assert sight.truncated.tolist() == [0.0]
    assert sight.own_px[0] == sight.inside_px[0] > 1000


def test_half_a_box_behind_a_wall() -> None:
    sight = measure_boxes(CAMERA, IDS, ONE, *scene(slice(160, 320), 9.0, slice(0, 160)))
    assert sight.visible[0] == pytest.approx(1 / (1 + FILL), abs=0.01)
    # The same wall behind the box hides nothing: half of its projection is then simply empty.
    behind = measure_boxes(CAMERA, IDS, ONE, *scene(slice(160, 320), 30.0, slice(0, 160)))
    assert behind.visible.tolist() == [1.0]


def test_a_box_without_pixels_is_not_seen() -> None:
    sight = measure_boxes(CAMERA, IDS, ONE, *scene(slice(0), 9.0, slice(0, 320)))
    assert (sight.visible[0], sight.truncated[0], sight.own_px[0]) == (0.0, 1.0, 0)


def test_truncation_is_the_share_outside() -> None:
    """A thin wall broadside on, moved so far left that the image's edge halves it."""
    edge_m = (160.0 / CAMERA.K[0, 0]) * 20.0
    box = (np.array([[20.0, edge_m, 1.0]]), np.array([[0.1, 4.0, 2.0]]), np.zeros(1))
    instance, depth = np.zeros((200, 320), np.uint16), np.full((200, 320), 1000.0)
    instance[95:105, 0:20], depth[95:105, 0:20] = 70_007 & 0xFFFF, 20.0
    sight = measure_boxes(CAMERA, IDS, box, instance, depth)
    assert sight.truncated[0] == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize("x", [-20.0, 0.5])
def test_boxes_behind_or_around_the_camera_are_not_seen(x: float) -> None:
    box = (np.array([[x, 0.0, 1.0]]), ONE[1], ONE[2])
    sight = measure_boxes(CAMERA, IDS, box, *scene(slice(0, 320)))
    assert sight.visible.tolist() == [0.0]


def test_no_boxes() -> None:
    sight = measure_boxes(CAMERA, np.zeros(0, np.int64), (np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)), *scene(slice(0)))
    assert len(sight.visible) == len(sight.truncated) == 0
