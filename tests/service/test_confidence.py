"""How sure a fused box is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.confidence import LEAST_SCORE, MAX_LOG_ODDS, Confidence, evidence, footprint_doubt, mean_score
from service.geometry.boxes import Boxes
from service.odds import log_odds as odds_of
from service.odds import probability


def log_odds(p: np.ndarray) -> np.ndarray:
    return odds_of(p, LEAST_SCORE)


SCORES = st.lists(st.floats(0.01, 0.99), min_size=1, max_size=8)


def standing(yaw: list[float], along_m: float, across_m: float, score: float = 0.7) -> Boxes:
    """Cars of 4 m by 2 m, whose centres are known so well along and across them."""
    count = len(yaw)
    covariance = np.tile(np.eye(7) * 0.01, (count, 1, 1))
    for row, angle in enumerate(yaw):
        axes = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        covariance[row, :2, :2] = axes.T @ np.diag([along_m**2, across_m**2]) @ axes
    dims = np.tile([4.0, 2.0, 1.5], (count, 1))
    return Boxes(
        np.zeros((count, 3)), dims, np.array(yaw), np.full(count, score), np.zeros(count, np.int64), covariance, np.ones(count)
    )


@given(SCORES)
def test_a_vehicle_is_as_sure_as_its_cameras_on_average(scores: list[float]) -> None:
    ours = np.array(scores)
    (mean,) = mean_score(ours, np.zeros(len(ours), np.int64), 1)
    assert ours.min() - 1e-9 <= mean <= ours.max() + 1e-9
    np.testing.assert_allclose(log_odds(np.array(mean)), log_odds(ours).mean(), atol=1e-6)


def test_each_vehicle_has_its_own_mean() -> None:
    np.testing.assert_allclose(mean_score(np.array([0.5, 0.9, 0.5, 0.9]), np.array([0, 1, 0, 1]), 2), [0.5, 0.9])


@given(st.floats(0.0, 1.0))
def test_log_odds_and_probability_undo_each_other(p: float) -> None:
    there = log_odds(np.array(p))
    assert abs(there) <= MAX_LOG_ODDS + 1e-6
    np.testing.assert_allclose(probability(there), p, atol=1e-8)


@pytest.mark.parametrize("yaw", [0.0, 0.3, 2.0, -1.2])
def test_doubt_is_the_part_of_the_footprint_that_is_open(yaw: float) -> None:
    # A tenth of the length and a fifth of the width, whichever way the car points.
    np.testing.assert_allclose(footprint_doubt(standing([yaw], 0.4, 0.4)), 0.3)
    np.testing.assert_allclose(footprint_doubt(standing([yaw], 0.8, 0.2)), 0.3)


@given(st.floats(0.01, 3.0), st.floats(0.01, 3.0), st.floats(0.05, 0.95), st.integers(1, 6), st.integers(0, 4))
def test_each_piece_of_evidence_moves_the_log_odds_by_its_weight(
    along: float, across: float, score: float, cameras: int, silences: int
) -> None:
    boxes = standing([0.4], along, across, score)
    known = evidence(boxes, np.array([cameras]), np.array([float(silences)]))
    weights = Confidence(offset=-1.0, score=0.5, doubt=-2.0, several=-0.3, silent=-0.4)
    expected = -1.0 + 0.5 * log_odds(np.array(score)) - 2.0 * np.log(along / 4 + across / 2)
    expected += -0.3 * (cameras > 1) - 0.4 * silences
    np.testing.assert_allclose(weights.of(known), probability(np.array([expected])), rtol=1e-9)
    np.testing.assert_allclose(Confidence().of(known), score)


def test_a_box_that_knows_its_place_exactly_is_sure_and_finite() -> None:
    known = evidence(standing([0.0], 0.0, 0.0), np.array([1]), np.array([0.0]))
    assert np.isfinite(known).all()
    assert 0.99 < Confidence(doubt=-2.0).of(known)[0] <= 1.0
