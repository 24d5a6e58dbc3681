"""Tracking scores: figures of the trackeval package, known answers, laws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.scored_sets import Found, Wanted
from benchmarks.tracking_scores import Moment, count_scene, moments, no_counts


def busy_scene(seed: int, n: int = 6, steps: int = 12) -> list[Moment]:
    """Vehicles and tracks that come and go, mostly alike where their numbers agree."""
    rng = np.random.default_rng(seed)
    scene = []
    for _ in range(steps):
        v, t = np.flatnonzero(rng.random(n) < 0.8), np.flatnonzero(rng.random(n + 2) < 0.8)
        similarity = rng.uniform(0, 0.55, (len(v), len(t)))
        similarity = np.where(v[:, None] == t[None], rng.uniform(0.3, 1, similarity.shape), similarity)
        scene.append(Moment(v, t, similarity))
    return scene


def steady(tracks: list[int], similarity: float = 1.0) -> list[Moment]:
    """One vehicle, found at each step by the given track; -1: not at all."""
    scene = []
    for track in tracks:
        ids = np.array([track] if track >= 0 else [], dtype=np.int64)
        scene.append(Moment(np.zeros(1, np.int64), ids, np.full((1, len(ids)), similarity)))
    return scene


def test_figures_of_trackeval() -> None:
    """MOTA, IDF1, HOTA and switches that trackeval 1.3.0 gives for these three scenes together."""
    total = sum((count_scene(busy_scene(seed)) for seed in range(3)), start=no_counts()).summary()
    assert total == {"mota": -13.26, "idf1": 48.38, "hota": 38.22, "switches": 44}


def test_perfect_tracks_score_100() -> None:
    assert count_scene(steady([3] * 10)).summary() == {"mota": 100.0, "idf1": 100.0, "hota": 100.0, "switches": 0}


def test_one_switch_half_way() -> None:
    summary = count_scene(steady([0] * 5 + [1] * 5)).summary()
    assert summary["switches"] == 1
    assert summary["mota"] == 90.0
    assert summary["idf1"] == 50.0
    # Detection 1, association 5 / 10 of each match.
    assert summary["hota"] == pytest.approx(100 * np.sqrt(0.5), abs=0.01)


def test_a_gap_is_a_miss_and_no_switch() -> None:
    summary = count_scene(steady([0, 0, -1, 0])).summary()
    assert (summary["mota"], summary["switches"]) == (75.0, 0)


def test_similarity_below_the_limit_matches_nothing_but_in_hota() -> None:
    summary = count_scene(steady([0] * 4, similarity=0.42)).summary()
    assert (summary["mota"], summary["idf1"]) == (-100.0, 0.0)
    # Eight of the nineteen thresholds, 0.05 .. 0.4, are reached.
    assert summary["hota"] == pytest.approx(100 * 8 / 19, abs=0.01)


def test_names_of_tracks_do_not_matter() -> None:
    scene = busy_scene(5)
    names = np.random.default_rng(0).permutation(8)
    renamed = [replace(moment, tracks=names[moment.tracks]) for moment in scene]
    assert count_scene(scene).summary() == count_scene(renamed).summary()


def test_scenes_add_up_in_any_order() -> None:
    a, b, c = (count_scene(busy_scene(seed)) for seed in range(3))
    assert (a + b + c).summary() == (c + a + b).summary()


def test_nothing_to_track() -> None:
    nothing = {"mota": None, "idf1": None, "hota": None, "switches": 0}
    assert no_counts().summary() == nothing
    assert count_scene([]).summary() == nothing
    only_false = Moment(np.zeros(0, np.int64), np.array([4]), np.zeros((0, 1)))
    assert count_scene([only_false]).false == 1
    assert count_scene([only_false]).summary() == nothing


def test_what_does_not_count_is_left_out_before() -> None:
    states = np.array([[x, 0.0, 0.75, 4.0, 1.8, 1.5, 0.0] for x in (0.0, 20.0)])
    truth = Wanted(states, np.array([True, False]), np.full(2, 10.0), np.array([7, 9]))
    places = np.array([[x, 0.0, 0.75, 4.0, 1.8, 1.5, 0.0] for x in (0.0, 20.0, 40.0, 60.0)])
    ours = Found(places, np.ones(4), np.array([True, True, True, False]), ("a", "b", "c", "d"))
    (moment,) = moments([ours], [truth])
    # Left: the vehicle that counts; the box on it, and the false one in view.
    assert (len(moment.vehicles), moment.tracks.tolist()) == (1, [0, 2])
    np.testing.assert_allclose(moment.similarity, [[1.0, 0.0]])
