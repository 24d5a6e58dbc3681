"""Precision and recall of boxes by overlap: known answers and laws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.average_precision import outcome, precision_recall
from benchmarks.scored_sets import Found, Wanted
from service.geometry.iou import iou_3d


def cars(x: list[float]) -> np.ndarray:
    """Cars (N, 7) along the x axis, 4 m long."""
    return np.array([[place, 0.0, 0.75, 4.0, 1.8, 1.5, 0.0] for place in x]).reshape(-1, 7)


def found(x: list[float], score: list[float], in_view: bool = True) -> Found:
    return Found(cars(x), np.array(score, dtype=np.float64), np.full(len(x), in_view))


def wanted(x: list[float], counted: list[bool] | None = None) -> Wanted:
    marks = np.ones(len(x), dtype=bool) if counted is None else np.array(counted, dtype=bool)
    return Wanted(cars(x), marks, np.full(len(x), 10.0), np.arange(len(x)))


def averages(f: Found, w: Wanted, overlap: float = 0.5) -> tuple[float, float]:
    curve = precision_recall([f], [w], "3d", overlap)
    return curve.average("R11"), curve.average("R40")


@pytest.mark.parametrize("count", [1, 2, 7, 40, 41, 100])
def test_perfect_boxes_score_100_however_few(count: int) -> None:
    places = [10.0 * k for k in range(count)]
    assert averages(found(places, [0.5] * count), wanted(places)) == (100.0, 100.0)


def test_half_of_two_found() -> None:
    # Recall 0.5 at precision 1: six of the recalls 0, .1 .. 1 and twenty of 1/40 .. 1.
    r11, r40 = averages(found([0.0], [0.9]), wanted([0.0, 20.0]))
    assert r11 == pytest.approx(100 * 6 / 11)
    assert r40 == pytest.approx(50)


def test_a_false_box_before_the_right_one_halves_precision() -> None:
    assert averages(found([50.0, 0.0], [0.9, 0.8]), wanted([0.0])) == (50.0, 50.0)


def test_a_false_box_after_the_right_one_costs_nothing() -> None:
    assert averages(found([50.0, 0.0], [0.8, 0.9]), wanted([0.0])) == (100.0, 100.0)


def test_a_second_box_on_a_vehicle_is_false() -> None:
    f = found([0.0, 0.2], [0.9, 0.8])
    np.testing.assert_array_equal(outcome(f, wanted([0.0]), iou_3d(f.states, cars([0.0])), 0.5), [1, 0])


def test_boxes_on_ignored_vehicles_or_out_of_view_are_left_out() -> None:
    f = found([0.0, 20.0], [0.9, 0.8])
    np.testing.assert_array_equal(outcome(f, wanted([0.0], [False]), iou_3d(f.states, cars([0.0])), 0.5), [-1, 0])
    hidden = found([0.0, 20.0], [0.9, 0.8], in_view=False)
    np.testing.assert_array_equal(outcome(hidden, wanted([0.0]), iou_3d(f.states, cars([0.0])), 0.5), [1, -1])


def test_boxes_that_stand_on_an_ignored_vehicle_are_forgiven() -> None:
    truck = np.array([[0.0, 0.0, 1.6, 12.0, 2.5, 3.2, np.pi / 2]])
    places = np.array([[0.0, 5.0], [0.0, 6.5], [2.0, 0.0]])
    states = np.column_stack([places, np.tile([0.75, 4.0, 1.8, 1.5, 0.0], (3, 1))])
    f = Found(states, np.ones(3), np.ones(3, dtype=bool))
    ignored = Wanted(truck, np.zeros(1, dtype=bool), np.ones(1), np.zeros(1, np.int64))
    np.testing.assert_array_equal(f.forgiven(ignored).in_view, [False, True, True])
    assert f.forgiven(replace(ignored, counted=np.ones(1, dtype=bool))).in_view.all()
    assert f.forgiven(wanted([])).in_view.all()


def test_a_vehicle_that_counts_goes_before_a_nearer_ignored_one() -> None:
    f, w = found([0.4], [0.9]), wanted([0.0, 0.5], [True, False])
    np.testing.assert_array_equal(outcome(f, w, iou_3d(f.states, w.states), 0.5), [1])


def test_overlap_has_to_be_strictly_larger() -> None:
    f, w = found([0.0], [0.9]), wanted([0.0])
    assert outcome(f, w, np.array([[0.7]]), 0.7).tolist() == [0]


def test_height_matters_in_3d_only() -> None:
    raised = Found(cars([0.0]) + np.eye(7)[2] * 0.7, np.ones(1), np.ones(1, dtype=bool))
    assert precision_recall([raised], [wanted([0.0])], "bev", 0.7).average("R40") == 100
    assert precision_recall([raised], [wanted([0.0])], "3d", 0.7).average("R40") == 0


def test_empty_inputs() -> None:
    nothing = found([], [])
    assert averages(nothing, wanted([0.0])) == (0.0, 0.0)
    assert all(np.isnan(averages(found([0.0], [0.9]), wanted([]))))
    assert np.isnan(precision_recall([], [], "3d", 0.5).average("R11"))


def random_sets(seed: int) -> tuple[list[Found], list[Wanted]]:
    rng = np.random.default_rng(seed)
    f, w = [], []
    for _ in range(5):
        truth = rng.uniform(0, 60, rng.integers(0, 8))
        boxes = np.concatenate([truth + rng.normal(0, 0.8, len(truth)), rng.uniform(0, 60, rng.integers(0, 4))])
        w.append(wanted(truth.tolist(), (rng.random(len(truth)) < 0.8).tolist()))
        f.append(Found(cars(boxes.tolist()), rng.random(len(boxes)), rng.random(len(boxes)) < 0.8))
    return f, w


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**31), st.integers(0, 2**31))
def test_order_does_not_matter(seed: int, other: int) -> None:
    f, w = random_sets(seed)
    rng = np.random.default_rng(other)
    order = rng.permutation(len(f))
    shuffled = [f[k].take(rng.permutation(len(f[k]))) for k in order]
    a, b = precision_recall(f, w, "bev", 0.5), precision_recall(shuffled, [w[k] for k in order], "bev", 0.5)
    np.testing.assert_allclose(a.recall, b.recall)
    np.testing.assert_allclose(a.precision, b.precision)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**31))
def test_dropping_boxes_never_raises_recall(seed: int) -> None:
    f, w = random_sets(seed)
    rng = np.random.default_rng(seed + 1)
    fewer = [one.take(rng.random(len(one)) < 0.6) for one in f]
    whole, part = precision_recall(f, w, "bev", 0.5), precision_recall(fewer, w, "bev", 0.5)
    assert part.recall.max(initial=0.0) <= whole.recall.max(initial=0.0) + 1e-12


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**31))
def test_only_the_order_of_scores_matters(seed: int) -> None:
    f, w = random_sets(seed)
    squared = [replace(one, score=one.score**2) for one in f]
    a, b = precision_recall(f, w, "3d", 0.5), precision_recall(squared, w, "3d", 0.5)
    np.testing.assert_array_equal(a.precision, b.precision)
