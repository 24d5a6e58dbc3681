"""Decoding and suppression of 2D boxes, without a network."""

from __future__ import annotations

import numpy as np
import pytest

from service.errors import PackError
from service.nets.decoding import decode_heads
from service.nets.detections import Detections, suppress
from service.nets.detector import edge_sigma
from service.nets.detector_spec import DetectorSpec
from service.nets.error_model import ErrorModel

SPEC = DetectorSpec(("car",), (8,), (((20.0, 10.0),),), 672, ErrorModel(0.5, 0.01, 0.0, 3.0))


def head(rows: int = 4, columns: int = 6) -> np.ndarray:
    return np.full((6, rows, columns), -9.0, np.float32)


def test_a_known_cell_gives_a_known_box() -> None:
    logits = head()
    # sigmoid(0) = 1/2: the centre in the middle of the cell, the size that of the anchor.
    logits[:4, 2, 3] = 0.0
    logits[4:, 2, 3] = 9.0
    found = decode_heads([logits], SPEC, 0.5)
    # Cell 3 spans pixels 24..31, whose middle is 27.5.
    np.testing.assert_allclose(found.xyxy_px, [[27.5 - 10, 19.5 - 5, 27.5 + 10, 19.5 + 5]])
    assert found.score[0] == pytest.approx(1.0, abs=1e-3)


def test_nothing_above_the_threshold_gives_nothing() -> None:
    assert len(decode_heads([head()], SPEC, 0.3)) == 0
    assert len(suppress(decode_heads([head()], SPEC, 0.3), 0.5)) == 0


def test_extreme_logits_stay_finite() -> None:
    logits = np.where(np.arange(6)[:, None, None] % 2 == 0, 80.0, -80.0) * np.ones((6, 2, 2), np.float32)
    logits[4:] = 80.0
    found = decode_heads([logits.astype(np.float32)], SPEC, 0.5)
    assert len(found) == 4
    assert np.isfinite(found.xyxy_px).all()


def test_suppression_keeps_the_better_of_two_and_both_of_strangers() -> None:
    boxes = np.array([[0.0, 0, 10, 10], [1.0, 0, 11, 10], [40.0, 0, 50, 10]])
    kept = suppress(Detections(boxes, np.array([0.6, 0.9, 0.5]), np.zeros(3, np.int64)), 0.5)
    np.testing.assert_array_equal(kept.score, [0.9, 0.5])


def test_edge_sigma_grows_with_the_box() -> None:
    sigma = edge_sigma(SPEC, [[0, 0, 10, 10], [0, 0, 100, 100]], [0.9, 0.4], [False, True])
    np.testing.assert_allclose(sigma, [[0.6] * 4, [4.5] * 4])


def test_incomplete_metadata_is_refused() -> None:
    with pytest.raises(PackError, match="anchors_px"):
        DetectorSpec.from_metadata({"classes": ["car"], "strides": [8]})
