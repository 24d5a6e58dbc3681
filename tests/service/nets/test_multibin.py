"""Crops and decoding of the multi-bin head, without a network."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.nets.error_model import ErrorModel
from service.nets.multibin import MultibinSpec, crop_vehicles, decode_multibin

SPEC = MultibinSpec(
    64, np.array([0.0, np.pi]), np.array([[4.4, 1.8, 1.5]]), (ErrorModel(0.2, 0, 0, 1),) * 3, ErrorModel(0.07, 0, 0, 1)
)


@given(alpha=st.floats(-np.pi, np.pi - 1e-6), certainty=st.floats(0.1, 9.0))
def test_decoding_inverts_encoding(alpha: float, certainty: float) -> None:
    delta = alpha - SPEC.bin_centers_rad
    vectors = np.stack([np.cos(delta), np.sin(delta)], -1)[None].astype(np.float32)
    nearest = np.abs((delta + np.pi) % (2 * np.pi) - np.pi).argmin()
    confidence = np.where(np.arange(2) == nearest, certainty, 0.0)[None].astype(np.float32)
    estimate = decode_multibin(vectors, confidence, np.array([[0.1, 0.0, -0.1]], np.float32), np.zeros(1, np.int64), SPEC)
    assert np.cos(estimate.alpha[0] - alpha) == pytest.approx(1.0, abs=1e-6)
    assert -np.pi <= estimate.alpha[0] < np.pi
    assert estimate.flip_log_odds[0] == pytest.approx(certainty, rel=1e-5)
    np.testing.assert_allclose(estimate.dims_lwh, [[4.5, 1.8, 1.4]], rtol=1e-6)


def test_a_vector_without_length_is_no_heading() -> None:
    vectors = np.array([[[0, 0], [1, 0]], [[1, 0], [0, 0]], [[0.6, 0.8], [0, 0]]], np.float32)
    confidence = np.array([[2, 1]] * 3, np.float32)
    estimate = decode_multibin(vectors, confidence, np.zeros((3, 3), np.float32), np.zeros(3, np.int64), SPEC)
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
