"""Recall and position errors: known answers, bands of distance, nothing at all."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.position_errors import DISTANCE_EDGES_M, MATCH_M, position_errors
from benchmarks.scored_sets import Found, Wanted


def boxes(center: list[list[float]], yaw: float = 0.0) -> np.ndarray:
    return np.array([[*c, 4.0, 1.8, 1.5, yaw] for c in center]).reshape(-1, 7)


def found(center: list[list[float]], yaw: float = 0.0, in_view: bool = True) -> Found:
    return Found(boxes(center, yaw), np.ones(len(center)), np.full(len(center), in_view))


def wanted(center: list[list[float]], distance: float = 15.0, counted: bool = True) -> Wanted:
    n = len(center)
    return Wanted(boxes(center), np.full(n, counted), np.full(n, distance), np.arange(n))


def test_rmse_by_axis_is_the_papers_equation_14() -> None:
    truth = [[0.0, 0.0, 0.75], [20.0, 0.0, 0.75]]
    summary = position_errors([found([[0.3, 0.0, 0.75], [20.4, 0.1, 0.75]])], [wanted(truth)]).summary()
    assert summary["rmse_m"]["x"] == pytest.approx(np.sqrt((0.09 + 0.16) / 2), abs=1e-4)
    assert summary["rmse_m"]["y"] == pytest.approx(np.sqrt(0.01 / 2), abs=1e-4)
    assert summary["rmse_m"]["z"] == 0


def test_errors_are_signed_until_they_are_squared() -> None:
    errors = position_errors([found([[0.3, -0.2, 0.75]])], [wanted([[0.0, 0.0, 0.75]])])
    np.testing.assert_allclose(errors.offset, [[0.3, -0.2, 0.0]])


def test_yaw_wraps() -> None:
    truth = Wanted(boxes([[0, 0, 0]], np.pi - 0.01), np.ones(1, bool), np.full(1, 5.0), np.zeros(1, np.int64))
    summary = position_errors([found([[0, 0, 0]], -np.pi + 0.01)], [truth]).summary()
    assert summary["yaw_error_median_deg"] == pytest.approx(np.degrees(0.02), abs=1e-3)


def test_a_box_too_far_away_is_false_and_its_vehicle_missed() -> None:
    summary = position_errors([found([[MATCH_M + 0.01, 0, 0]])], [wanted([[0, 0, 0]])]).summary()
    assert (summary["recall_percent"], summary["precision_percent"]) == (0, 0)


def test_out_of_view_is_not_false() -> None:
    summary = position_errors([found([[9.0, 0, 0]], in_view=False)], [wanted([[0, 0, 0]])]).summary()
    assert (summary["boxes"], summary["precision_percent"]) == (0, None)


def test_a_box_on_an_ignored_vehicle_counts_nowhere() -> None:
    summary = position_errors([found([[0.1, 0, 0]])], [wanted([[0, 0, 0]], counted=False)]).summary()
    assert (summary["vehicles"], summary["boxes"], summary["recall_percent"]) == (0, 0, None)


@pytest.mark.parametrize(("distance", "band"), [(0.5, 0), (10.0, 0), (10.1, 1), (25.0, 2), (40.0, 3)])
def test_bands_of_distance(distance: float, band: int) -> None:
    summary = position_errors([found([[0.1, 0, 0]])], [wanted([[0, 0, 0]], distance)]).summary()
    counts = [entry["vehicles"] for entry in summary["by_distance"]]
    assert counts == [int(k == band) for k in range(len(DISTANCE_EDGES_M) - 1)]
    assert summary["by_distance"][band]["p50"] == 0.1


def test_order_of_sets_and_boxes_does_not_matter() -> None:
    rng = np.random.default_rng(3)
    truth = [wanted(rng.uniform(-20, 20, (6, 3)).tolist()) for _ in range(4)]
    ours = [Found(t.states + rng.normal(0, 0.3, (6, 7)), np.ones(6), np.ones(6, bool)) for t in truth]
    a = position_errors(ours, truth).summary()
    b = position_errors([ours[k].take(rng.permutation(6)) for k in (2, 0, 3, 1)], [truth[k] for k in (2, 0, 3, 1)]).summary()
    assert a == b


def test_nothing_at_all() -> None:
    for f, w in (([], []), ([found([])], [wanted([])])):
        summary = position_errors(f, w).summary()
        assert summary["recall_percent"] is None
        assert summary["error_m"] == {"p50": None, "p90": None, "p99": None}
