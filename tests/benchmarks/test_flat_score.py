"""Average precision of 2D boxes over pictures: known answers."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.flat_score import FlatResult, flat_curve, flat_summary
from service.nets.detections import Detections

CARS = np.array([[0.0, 0.0, 20.0, 10.0], [40.0, 0.0, 60.0, 10.0]])
NONE = np.zeros((0, 4))


def result(boxes: np.ndarray, score: list[float], ignored: np.ndarray = NONE) -> FlatResult:
    return FlatResult(Detections(boxes, np.array(score), np.zeros(len(score), np.int64)), CARS, ignored)


def test_the_truth_itself_scores_a_hundred() -> None:
    summary = flat_summary(flat_curve([result(CARS, [0.9, 0.8]), result(CARS[::-1], [0.7, 0.6])]))
    assert summary["ap50_R40"] == 100
    assert summary["vehicles"] == 4
    assert (summary["recall_at_0.3"], summary["precision_at_0.3"]) == (100, 100)


def test_a_false_box_above_all_others_halves_the_precision_of_the_first() -> None:
    boxes = np.concatenate([[[100.0, 0.0, 120.0, 10.0]], CARS])
    found = flat_curve([result(boxes, [0.9, 0.8, 0.1])])
    # Precision 1/2 at recall 1/2, 2/3 at recall 1: the envelope is 2/3 everywhere.
    assert found.average("R40") == pytest.approx(100 * 2 / 3)
    assert flat_summary(found)["precision_at_0.3"] == 50


def test_boxes_on_ignored_places_do_not_count() -> None:
    boxes = np.concatenate([[[100.0, 0.0, 120.0, 10.0]], CARS])
    ignored = np.array([[90.0, 0.0, 130.0, 20.0]])
    assert flat_curve([result(boxes, [0.9, 0.8, 0.7], ignored)]).average("R40") == 100


def test_a_second_box_on_a_vehicle_is_false() -> None:
    found = flat_curve([result(np.concatenate([CARS, CARS[:1] + 0.5]), [0.9, 0.8, 0.7])])
    assert found.precision.tolist() == pytest.approx([1, 1, 2 / 3])
    assert found.recall[-1] == 1


def test_finding_nothing_scores_nothing() -> None:
    assert flat_summary(flat_curve([result(NONE, [])]))["ap50_R40"] == 0
