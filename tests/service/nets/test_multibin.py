"""Crops and decoding of the multi-bin head, without a network."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import PackError
from service.geometry.boxes import TANGENT_DEGREES, TANGENT_DIRECTIONS, tangents_of
from service.nets.error_model import ErrorModel
from service.nets.multibin import (
    UNCERTAIN,
    MultibinSpec,
    crop_vehicles,
    crop_windows,
    decode_multibin,
    edges_in_image,
    tangents_in_image,
    window_middles,
)

SPEC = MultibinSpec(
    64, np.array([0.0, np.pi]), np.array([[4.4, 1.8, 1.5]]), (ErrorModel(0.2, 0, 0, 1),) * 3, ErrorModel(0.07, 0, 0, 1)
)

ONE = np.zeros((1, 2))


@given(alpha=st.floats(-np.pi, np.pi - 1e-6), certainty=st.floats(0.1, 9.0))
def test_decoding_inverts_encoding(alpha: float, certainty: float) -> None:
    delta = alpha - SPEC.bin_centers_rad
    vectors = np.stack([np.cos(delta), np.sin(delta)], -1)[None].astype(np.float32)
    nearest = np.abs((delta + np.pi) % (2 * np.pi) - np.pi).argmin()
    confidence = np.where(np.arange(2) == nearest, certainty, 0.0)[None].astype(np.float32)
    estimate = decode_multibin(vectors, confidence, np.array([[0.1, 0.0, -0.1]], np.float32), np.zeros(1, np.int64), ONE, SPEC)
    assert np.cos(estimate.alpha[0] - alpha) == pytest.approx(1.0, abs=1e-6)
    assert -np.pi <= estimate.alpha[0] < np.pi
    assert estimate.flip_log_odds[0] == pytest.approx(certainty, rel=1e-5)
    np.testing.assert_allclose(estimate.dims_lwh, [[4.5, 1.8, 1.4]], rtol=1e-6)


def test_of_many_bins_the_opposite_one_answers_for_the_flip() -> None:
    spec = replace(SPEC, bin_centers_rad=np.arange(4) * np.pi / 2)
    alpha = 0.2
    delta = alpha - spec.bin_centers_rad
    vectors = np.stack([np.cos(delta), np.sin(delta)], -1)[None].astype(np.float32)
    confidence = np.array([[5.0, 4.5, -3.0, 1.0]], np.float32)
    estimate = decode_multibin(vectors, confidence, np.zeros((1, 3), np.float32), np.zeros(1, np.int64), ONE, spec)
    assert estimate.alpha[0] == pytest.approx(alpha, abs=1e-6)
    assert estimate.flip_log_odds[0] == pytest.approx(8.0)


def test_a_vector_without_length_is_no_heading() -> None:
    vectors = np.array([[[0, 0], [1, 0]], [[1, 0], [0, 0]], [[0.6, 0.8], [0, 0]]], np.float32)
    confidence = np.array([[2, 1]] * 3, np.float32)
    estimate = decode_multibin(vectors, confidence, np.zeros((3, 3), np.float32), np.zeros(3, np.int64), np.zeros((3, 2)), SPEC)
    assert np.isnan(estimate.alpha).tolist() == [True, False, False]


def test_a_crop_is_square_centred_and_keeps_the_shape() -> None:
    image = np.zeros((100, 200, 3), np.uint8)
    image[40:60, 80:120] = 255
    crop = crop_vehicles(image, [[80, 40, 119, 59]], 48)[0]
    white = np.argwhere(crop[..., 0] > 127)
    height, width = np.ptp(white, axis=0) + 1
    assert crop.shape == (48, 48, 3)
    assert width / height == pytest.approx(2.0, rel=0.1)
    np.testing.assert_allclose(white.mean(0), 23.5, atol=1.0)


def test_outside_the_image_a_crop_is_grey() -> None:
    image = np.zeros((50, 50, 3), np.uint8)
    crops = crop_vehicles(image, [[-30, -30, 9, 9], [200, 200, 220, 210]], 32)
    assert (crops[0][:12, :12] == 114).all()
    assert (crops[1] == 114).all()


def test_no_boxes_give_no_crops() -> None:
    assert crop_vehicles(np.zeros((50, 50, 3), np.uint8), np.zeros((0, 4)), 32).shape == (0, 32, 32, 3)


@given(x=st.floats(-300, 900), y=st.floats(-300, 500), width=st.floats(0, 400), height=st.floats(0, 300))
def test_a_window_is_square_around_its_box_with_a_margin(x: float, y: float, width: float, height: float) -> None:
    left, top, side = crop_windows([[x, y, x + width, y + height]])[0]
    assert side >= max(width, height)
    assert side == max(round(1.3 * max(width, height)), 4)
    assert abs(left + side / 2 - (x + width / 2)) <= 0.5 + 1e-9
    assert abs(top + side / 2 - (y + height / 2)) <= 0.5 + 1e-9


@given(x=st.floats(0, 500), y=st.floats(0, 300), width=st.floats(5, 200), height=st.floats(5, 150))
def test_edges_come_back_from_the_crop_to_the_image(x: float, y: float, width: float, height: float) -> None:
    box = np.array([[x, y, x + width, y + height]])
    window = crop_windows(box)
    in_crop = (box + 0.5 - window[:, [0, 1, 0, 1]]) / window[:, 2:] - 0.5
    np.testing.assert_allclose(edges_in_image(in_crop, window), box, atol=1e-9)


def test_the_outermost_edges_of_a_crop_lie_between_pixels() -> None:
    np.testing.assert_allclose(edges_in_image([[-0.5, -0.5, 0.5, 0.5]], np.array([[10, 20, 8]])), [[9.5, 19.5, 17.5, 27.5]])


def metadata(**more: object) -> dict[str, object]:
    model = [0.1, 0.0, 0.0, 1.0]
    base = {"crop_px": 64, "bin_centers_rad": [0.0, 3.14], "mean_dims_lwh": [[4, 2, 1.5]], "sigma_alpha_rad": model}
    return {**base, "sigma_dims_lwh": [model] * 3, **more}


def test_a_head_without_predicted_sigmas_is_weighed_by_its_scores() -> None:
    spec = MultibinSpec.from_metadata(metadata())
    assert spec.sigma_scale is None
    estimates = decode_multibin(
        np.zeros((2, 2, 2), "f4"), np.zeros((2, 2), "f4"), np.zeros((2, 3), "f4"), np.zeros(2, int), np.zeros((2, 2)), spec
    )
    alpha, dims = spec.sigmas(estimates, np.ones(2), np.zeros(2, dtype=bool))
    assert (alpha.shape, dims.shape) == ((2,), (2, 3))
    np.testing.assert_allclose(dims, 0.1)


@pytest.mark.parametrize("scale", [[1.0] * 7, [0.0] * 8, [float("nan")] * 8, "much"])
def test_scales_that_are_none_are_refused(scale: object) -> None:
    assert MultibinSpec.from_metadata(metadata(sigma_scale=[1.0] * len(UNCERTAIN))).sigma_scale is not None
    with pytest.raises(PackError, match="incomplete"):
        MultibinSpec.from_metadata(metadata(sigma_scale=scale))


def test_tangents_want_scales_of_their_own_and_known_directions() -> None:
    spec = MultibinSpec.from_metadata(metadata(sigma_scale=[1.0] * 16, tangents_deg=list(TANGENT_DEGREES)))
    assert spec.sigma_scale is not None
    assert spec.sigma_scale.shape == (16,)
    for wrong in ({"sigma_scale": [1.0] * 8, "tangents_deg": list(TANGENT_DEGREES)}, {"tangents_deg": [10, 20]}):
        with pytest.raises(PackError, match="incomplete"):
            MultibinSpec.from_metadata(metadata(**wrong))


def test_tangents_of_a_crop_are_the_images() -> None:
    points = np.array([[120.0, 80.0], [180.0, 95.0], [150.0, 130.0]])
    window = crop_windows([[118.0, 78.0, 190.0, 140.0]])
    told = (tangents_of(points) - TANGENT_DIRECTIONS @ window_middles(window)[0]) / window[0, 2]
    np.testing.assert_allclose(tangents_in_image(told[None], window)[0], tangents_of(points))
