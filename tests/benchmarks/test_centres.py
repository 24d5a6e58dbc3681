"""Matching by centres, and what counts."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.centres import CentreScore, countable, match_centres, near_cameras
from service.geometry.camera import Camera
from service.geometry.transforms import pole_camera_pose
from service.site import Site

K = np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 96.0], [0.0, 0.0, 1.0]])


def site() -> Site:
    places = {"a": [0.0, 0.0, 6.0], "b": [60.0, 0.0, 6.0]}
    return Site("s", tuple(Camera(i, 640, 192, K, pole_camera_pose(p, 0.0, 0.2)) for i, p in places.items()))


def test_truth_against_itself_is_perfect() -> None:
    center = np.random.default_rng(0).uniform(-20, 20, (9, 3))
    score = CentreScore()
    score.add(center, np.ones(9, bool), center, np.ones(9, bool))
    summary = score.summary()
    assert summary["recall_percent"] == 100
    assert summary["false"] == 0
    assert summary["error_median_m"] == 0


def test_matching_prefers_more_matches_over_a_nearer_one() -> None:
    ours, truth = np.array([[0.0, 0, 0], [0.9, 0, 0]]), np.array([[0.8, 0, 0], [1.7, 0, 0]])
    rows, columns, _ = match_centres(ours, truth)
    assert dict(zip(rows.tolist(), columns.tolist(), strict=True)) == {0: 0, 1: 1}


def test_one_vehicle_forgives_one_box_only() -> None:
    score = CentreScore()
    score.add(np.array([[0.0, 0, 0], [0.1, 0, 0]]), np.ones(2, bool), np.zeros((1, 3)), np.ones(1, bool))
    assert (score.found, score.boxes, score.false) == (1, 2, 1)


def test_a_box_on_an_uncounted_vehicle_is_not_false_and_finds_nothing() -> None:
    score = CentreScore()
    score.add(np.zeros((1, 3)), np.ones(1, bool), np.zeros((1, 3)), np.zeros(1, bool))
    assert (score.vehicles, score.found, score.false) == (0, 0, 0)


def test_nothing_at_all_gives_no_recall_and_no_crash() -> None:
    score = CentreScore()
    score.add(np.zeros((0, 3)), np.zeros(0, bool), np.zeros((2, 3)), np.ones(2, bool))
    assert score.summary()["recall_percent"] == 0


def test_two_cameras_must_see_it_from_near() -> None:
    center = np.array([[30.0, 0, 0.7], [30.0, 0, 0.7], [10.0, 0, 0.7]])
    visible = np.array([[0.9, 0.6], [0.9, 0.5], [0.9, 0.9]])
    # The third stands 50 m from the second camera.
    np.testing.assert_array_equal(countable(site(), center, visible), [True, False, False])
    np.testing.assert_array_equal(near_cameras(site(), center), [2, 2, 1])


def test_the_limit_is_inclusive() -> None:
    rows, _, distance = match_centres(np.zeros((1, 3)), np.array([[1.0, 0, 0]]))
    assert len(rows) == 1
    assert distance[0] == pytest.approx(1.0)
