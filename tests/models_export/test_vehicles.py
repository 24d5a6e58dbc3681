"""Vehicles cut out of images: what a crop shows, and what the head should say of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models_export.data.augment import AugmentConfig, border_within
from models_export.data.detection import VehicleSample
from models_export.data.vehicles import Vehicle, vehicles_of
from models_export.train.multibin import MAX_JITTER, jittered, mirrored_outline, vehicle_odds
from service.geometry.boxes import tangents_of
from service.geometry.camera import Camera, ray_azimuth
from service.geometry.transforms import Array, pole_camera_pose, wrap_angle
from service.nets.canvas import PAD_VALUE
from service.nets.multibin import crop_windows, edges_in_image, tangents_in_image

K = np.array([[300.0, 0.0, 199.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]])
CAMERA = Camera("north", 400, 240, K, pole_camera_pose([0.0, 0.0, 6.0], 0.0, 0.3))


def outline_of(xyxy: list[float]) -> Array:
    """Corners (1, 8, 2) of a box whose outline is a rectangle."""
    x0, y0, x1, y1 = xyxy
    return np.array([[[x0, y0], [x1, y0], [x1, y1], [x0, y1]] * 2])


def white_box(xyxy: list[int]) -> Vehicle:
    """A white rectangle on black as the only vehicle of an image."""
    image = np.zeros((240, 400, 3), np.uint8)
    x0, y0, x1, y1 = xyxy
    image[y0 : y1 + 1, x0 : x1 + 1] = 255
    zero = np.zeros(1, np.int64)
    (vehicle,) = vehicles_of(
        VehicleSample(
            canvas=image,
            image_size=(400, 240),
            xyxy_px=np.array([[x0 - 0.5, y0 - 0.5, x1 + 0.5, y1 + 0.5]]),
            ignore=zero > 0,
            cls=zero,
            class_known=zero == 0,
            source="toy",
            camera=CAMERA,
            dims_lwh=np.array([[4.0, 1.8, 1.5]]),
            alpha=np.array([0.4]),
            corners_px=outline_of([x0 - 0.5, y0 - 0.5, x1 + 0.5, y1 + 0.5]),
        ),
        crop_px=96,
    )
    return vehicle


@given(seed=st.integers(0, 10_000))
def test_the_edges_are_where_the_crop_shows_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x0, y0 = rng.integers(60, 200), rng.integers(60, 120)
    vehicle = white_box([x0, y0, x0 + rng.integers(30, 120), y0 + rng.integers(25, 60)])
    crop, _, outline = vehicle.crop(jittered(vehicle.xyxy_px, rng), 96)
    white = np.argwhere(crop[..., 0] > 127)
    shown = np.array([*(white.min(0)[::-1] - 0.5), *(white.max(0)[::-1] + 0.5)])
    np.testing.assert_allclose(np.clip((outline[:4] + 0.5) * 96 - 0.5, -0.5, 95.5), shown, atol=1.1)
    corners = outline_of(((outline[:4] + 0.5) * 96 - 0.5).tolist())[0] - 47.5
    np.testing.assert_allclose(outline[4:] * 96, tangents_of(corners), atol=1.1)


@given(seed=st.integers(0, 10_000))
def test_a_mirrored_outline_is_the_outline_in_the_mirror(seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-0.5, 0.5, (8, 2))
    mirrored = points * [-1.0, 1.0]
    outline, expected = (np.concatenate([p.min(0), p.max(0), tangents_of(p)]) for p in (points, mirrored))
    np.testing.assert_allclose(mirrored_outline(outline), expected, atol=1e-12)


def test_alpha_follows_the_ray_through_the_crop() -> None:
    vehicle = white_box([100, 80, 180, 120])
    moved = vehicle.xyxy_px + 20.0
    alpha = vehicle.crop(moved, 64)[1]
    centers = np.array([[140.0, 100.0], [160.0, 120.0]])
    turn = ray_azimuth(CAMERA, centers)
    assert abs(wrap_angle(alpha + turn[1] - vehicle.alpha - turn[0])) < 1e-9


def test_a_large_vehicle_is_kept_small_and_its_edges_agree_with_the_service() -> None:
    vehicle = white_box([20, 20, 380, 200])
    assert max(vehicle.patch.shape) <= 176
    _, _, outline = vehicle.crop(vehicle.xyxy_px, 96)
    windows = crop_windows([vehicle.xyxy_px])
    np.testing.assert_allclose(edges_in_image([outline[:4]], windows)[0], vehicle.xyxy_px, atol=4.0)
    np.testing.assert_allclose(tangents_in_image(outline[None, 4:], windows)[0], vehicle.tangents_px, atol=4.0)


@given(seed=st.integers(0, 1000))
def test_jitter_is_bounded(seed: int) -> None:
    box = np.array([10.0, 10.0, 50.0, 30.0])
    moved = jittered(box, np.random.default_rng(seed))
    assert np.abs(moved - box).max() <= MAX_JITTER * 40.0 + 1e-9


@given(seed=st.integers(0, 10_000), side=st.integers(0, 3))
def test_beyond_a_border_a_crop_is_grey_and_the_outline_goes_on(seed: int, side: int) -> None:
    rng = np.random.default_rng(seed)
    vehicle = white_box([100, 80, 160, 120])
    border = np.array([-np.inf, -np.inf, np.inf, np.inf])
    border[side] = rng.integers(115, 145) if side % 2 == 0 else rng.integers(90, 110)
    border[side] -= 0.5
    cut = vehicle.within(border)
    crop, alpha, outline = cut.crop(cut.xyxy_px, 96)
    _, whole_alpha, whole_outline = vehicle.crop(cut.xyxy_px, 96)
    low_high = [border[side] + 0.5, border[side] - 0.5]
    assert cut.xyxy_px[side] == low_high[side // 2]
    np.testing.assert_allclose(np.delete(cut.xyxy_px, side), np.delete(vehicle.xyxy_px, side))
    np.testing.assert_allclose(outline[4:], whole_outline[4:], atol=1e-9)
    assert abs(wrap_angle(alpha - whole_alpha)) < 1e-9
    at = (outline[side] + 0.5) * 96
    beyond = crop[:, : int(at) - 2] if side == 0 else crop[:, int(at) + 3 :]
    if side % 2:
        beyond = crop[: int(at) - 2] if side == 1 else crop[int(at) + 3 :]
    assert (beyond == PAD_VALUE).all()


@given(seed=st.integers(0, 10_000))
def test_a_border_leaves_a_part_of_the_vehicle(seed: int) -> None:
    rng = np.random.default_rng(seed)
    box = np.array([100.0, 80.0, 180.0, 130.0])
    border = border_within(box, rng, AugmentConfig())
    shown = np.clip(box, np.tile(border[:2], 2), np.tile(border[2:], 2))
    share = (shown[2:] - shown[:2]) / (box[2:] - box[:2])
    assert share.min() >= 0.3 - 1e-9
    assert share.min() < 1
    assert np.isfinite(border).sum() in (1, 2)
    assert np.isfinite(border[[0, 2]]).sum() <= 1
    assert np.isfinite(border[[1, 3]]).sum() <= 1


def test_high_and_cut_vehicles_are_drawn_more_often() -> None:
    def at(xyxy: list[float]) -> Vehicle:
        return replace(white_box([200, 100, 240, 130]), xyxy_px=np.array(xyxy))

    # 30 px high in a picture 672 px wide is plain; this one is 400 px wide.
    plain = 30 * 400 / 672
    odds = vehicle_odds(
        [
            at([200, 100, 240, 100 + plain]),
            at([200, 100, 240, 100 + 2 * plain]),
            at([200, 20, 240, 20 + 9 * plain]),
            at([200, 100, 203, 102]),
            at([359, 100, 399, 100 + plain]),
        ]
    )
    assert odds.sum() == pytest.approx(1)
    np.testing.assert_allclose(odds / odds[0], [1.0, 2.0, 2.5, 0.4, 1.5])
