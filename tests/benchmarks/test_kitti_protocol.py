"""KITTI's evaluation: the figures of its own evaluator, its rules one by one, and laws."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.kitti_folders import KittiPair, as_set, read_ids, read_pair
from benchmarks.kitti_protocol import (
    DIFFICULTIES,
    RECALL_POINTS,
    as_percent,
    evaluate,
    find_candidates,
    recall_thresholds,
    score_class,
)
from benchmarks.recordings import recording
from models_export.data.kitti import KittiObject
from service.errors import NotFoundError
from service.geometry.iou import iou_2d

RESULTS = "kitti/results/val_2ddetections_Frustum-PointNet_1/data"
METRIC_NAMES = {"2d": "bbox_2d", "bev": "bev", "3d": "3d"}
EASY, MODERATE, HARD = DIFFICULTIES


def pair_of(truth: list[list[KittiObject]], results: list[list[KittiObject]]) -> KittiPair:
    return KittiPair(as_set(truth), as_set(results), len(truth), {})


def thing(x: float = 100.0, **values: object) -> KittiObject:
    """A car 100 px wide and 50 px tall, at a place in the world that goes with its place in the image."""
    place = {"bbox_xyxy": (x, 100.0, x + 100.0, 150.0), "location": (x / 25.0, 1.6, 20.0)}
    base = KittiObject("Car", 0.0, 0, 0.5, place["bbox_xyxy"], (1.5, 1.7, 4.0), place["location"], 0.5)  # type: ignore[arg-type]
    return replace(base, **values)  # type: ignore[arg-type]


def found(x: float = 100.0, score: float = 0.9, **values: object) -> KittiObject:
    return thing(x, **{"truncated": -1.0, "occluded": -1, "score": score, **values})


def precision_at(pair: KittiPair, name: str = "Car", metric: str = "2d", difficulty: int = 0) -> float:
    """Precision of the first recall point, where the best-scored true positives count."""
    curve = score_class(pair, find_candidates(pair, metric), name, metric, 0.5, DIFFICULTIES[difficulty])
    return float(curve.precision[0])


# ------------------------------------------------------------------ KITTI's own figures


@pytest.fixture(scope="module")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording's labels and results of the validation frames, unpacked."""
    try:
        path = recording("kitti_text.zip")
    except NotFoundError as error:
        pytest.skip(str(error))
    folder = tmp_path_factory.mktemp("kitti")
    with zipfile.ZipFile(path) as archive:
        ids = archive.read("kitti/lists/val.txt").decode().split()
        members = [f"{part}/{i}.txt" for part in ("kitti/training/label_2", RESULTS) for i in ids]
        archive.extractall(folder, [*members, "kitti/lists/val.txt", "kitti/EXPECTED_AP.json"])
    return folder


def test_the_eighteen_figures_of_kittis_evaluator(kitti: Path) -> None:
    ids = read_ids(kitti / "kitti/lists/val.txt")
    scores = as_percent(evaluate(read_pair(kitti / "kitti/training/label_2", kitti / RESULTS, ids)))
    expected = json.loads((kitti / "kitti/EXPECTED_AP.json").read_text())["AP"]
    for metric, name in METRIC_NAMES.items():
        for sampling in ("R11", "R40"):
            wanted = [expected[name][d.name][f"AP_{sampling}"] for d in DIFFICULTIES]
            np.testing.assert_allclose(scores["Car"][metric][sampling], wanted, atol=1e-3)
    assert scores["Car"]["aos"] is None


def test_kittis_truth_against_itself_scores_100(kitti: Path) -> None:
    pair = _truth_as_results(kitti)
    for name, metrics in as_percent(evaluate(pair)).items():
        for metric, figures in metrics.items():
            assert figures == {"R11": [100.0] * 3, "R40": [100.0] * 3}, (name, metric)


def _truth_as_results(kitti: Path) -> KittiPair:
    ids = read_ids(kitti / "kitti/lists/val.txt")
    pair = read_pair(kitti / "kitti/training/label_2", kitti / RESULTS, ids)
    return replace(pair, results=replace(pair.truth, score=np.ones(len(pair.truth))))


def test_a_small_subset_gives_what_it_gave(kitti: Path) -> None:
    """A golden score over 120 frames, cheap enough to look into when it moves."""
    ids = read_ids(kitti / "kitti/lists/val.txt")[:120]
    curves = evaluate(read_pair(kitti / "kitti/training/label_2", kitti / RESULTS, ids))["Car"]
    assert [c.counted for c in curves["3d"] or []] == [91, 250, 325]
    np.testing.assert_allclose([c.precision[1:].mean() for c in curves["3d"] or []], [0.80258, 0.7044, 0.63875], atol=1e-5)


# ------------------------------------------------------------------ rules


def test_two_frames_do_not_meet() -> None:
    assert precision_at(pair_of([[thing()], []], [[], [found()]])) == 0
    assert precision_at(pair_of([[thing()], []], [[found()], []])) == 1


@pytest.mark.parametrize(
    ("values", "counted"),
    [
        ({}, [1, 1, 1]),
        ({"occluded": 1}, [0, 1, 1]),
        ({"occluded": 2}, [0, 0, 1]),
        ({"occluded": 3}, [0, 0, 0]),
        ({"truncated": 0.15}, [1, 1, 1]),
        ({"truncated": 0.16}, [0, 1, 1]),
        ({"truncated": 0.31}, [0, 0, 1]),
        ({"truncated": 0.51}, [0, 0, 0]),
        ({"bbox_xyxy": (0.0, 0.0, 100.0, 40.01)}, [1, 1, 1]),
        ({"bbox_xyxy": (0.0, 0.0, 100.0, 40.0)}, [0, 1, 1]),
        ({"bbox_xyxy": (0.0, 0.0, 100.0, 25.0)}, [0, 0, 0]),
        ({"type": "CAR"}, [1, 1, 1]),
        ({"type": "Van"}, [0, 0, 0]),
        ({"type": "Pedestrian"}, [0, 0, 0]),
    ],
)
def test_what_counts(values: dict[str, object], counted: list[int]) -> None:
    curves = evaluate(pair_of([[thing(**values)]], [[]]))["Car"]["2d"]
    assert [curve.counted for curve in curves or []] == counted


@pytest.mark.parametrize("values", [{"type": "Van"}, {"occluded": 3}, {"truncated": 0.9}])
def test_an_ignored_truth_takes_its_detection(values: dict[str, object]) -> None:
    pair = pair_of([[thing(), thing(400, **values)]], [[found(), found(400)]])
    assert precision_at(pair) == 1


def test_another_class_takes_none() -> None:
    pair = pair_of([[thing(), thing(400, type="Truck")]], [[found(), found(400)]])
    assert precision_at(pair) == 0.5


def test_person_sitting_is_ignored_for_pedestrians_only() -> None:
    truth = [[thing(type="Pedestrian"), thing(400, type="Person_sitting")]]
    results = [[found(type="Pedestrian"), found(400, type="Pedestrian")]]
    assert precision_at(pair_of(truth, results), "Pedestrian") == 1
    cyclists = pair_of(
        [[replace(o, type="Cyclist") if o.type == "Pedestrian" else o for o in truth[0]]],
        [[replace(o, type="Cyclist") for o in results[0]]],
    )
    assert precision_at(cyclists, "Cyclist") == 0.5


def test_dontcare_forgives_in_2d_only() -> None:
    region = thing(380, type="DontCare", bbox_xyxy=(380.0, 90.0, 600.0, 200.0), location=(-1000.0,) * 3, dims_hwl=(-1.0,) * 3)
    pair = pair_of([[thing(), region]], [[found(), found(400)]])
    assert precision_at(pair, metric="2d") == 1
    assert precision_at(pair, metric="3d") == 0.5
    assert precision_at(pair, metric="bev") == 0.5


def test_dontcare_measures_against_the_detections_own_box() -> None:
    # 40 of the detection's 100 px lie inside.
    region = thing(type="DontCare", bbox_xyxy=(400.0, 100.0, 440.0, 150.0))
    assert precision_at(pair_of([[thing(), region]], [[found(), found(400)]])) == 0.5


@pytest.mark.parametrize("metric", ["2d", "bev", "3d"])
def test_low_detections_are_ignored_by_their_own_2d_height(metric: str) -> None:
    low = found(400, bbox_xyxy=(400.0, 100.0, 500.0, 139.9))
    pair = pair_of([[thing()]], [[found(), low]])
    assert precision_at(pair, metric=metric) == 1
    assert precision_at(pair, metric=metric, difficulty=1) == 0.5


def test_a_low_detection_on_a_truth_makes_it_neither_found_nor_missed() -> None:
    low = found(400, bbox_xyxy=(400.0, 100.0, 500.0, 139.9), location=thing(400).location)
    pair = pair_of([[thing(), thing(400)]], [[found(score=0.5), low]])
    curve = score_class(pair, find_candidates(pair, "3d"), "Car", "3d", 0.5, EASY)
    assert curve.counted == 2
    np.testing.assert_array_equal(curve.precision[:2], [1, 0])


def test_overlap_has_to_be_strictly_larger() -> None:
    half = found(bbox_xyxy=(100.0, 100.0, 200.0, 200.0))
    pair = pair_of([[thing()]], [[half]])
    assert float(iou_2d(pair.results.bbox, pair.truth.bbox)[0, 0]) == 0.5
    assert precision_at(pair) == 0


def test_a_truth_takes_one_detection_only() -> None:
    assert precision_at(pair_of([[thing()]], [[found(), found()]])) == 0.5


def test_scores_come_from_the_best_scored_and_counts_from_the_best_placed() -> None:
    # Pass one takes the score 0.8 of the worse box; at 0.8 the better box, scored 0.5, is below the threshold.
    pair = pair_of([[thing()]], [[found(score=0.5), found(110.0, score=0.8)]])
    assert precision_at(pair) == 1
    # With a second truth of score 0.4 the better box is in, and is the one that counts.
    pair = pair_of([[thing(), thing(400)]], [[found(score=0.5), found(110.0, score=0.8), found(400, score=0.4)]])
    curve = score_class(pair, find_candidates(pair, "2d"), "Car", "2d", 0.5, EASY)
    np.testing.assert_allclose(curve.precision[:3], [1, 2 / 3, 0])


def test_orientation_similarity_is_over_true_positives_in_place_of_their_number() -> None:
    pair = pair_of([[thing(), thing(400)]], [[found(alpha=0.5), found(400, alpha=0.5 + np.pi / 2), found(800)]])
    curve = score_class(pair, find_candidates(pair, "2d"), "Car", "2d", 0.5, EASY)
    np.testing.assert_allclose(curve.similarity[0], (1 + 0.5) / 3)
    turned = pair_of([[thing()]], [[found(alpha=0.5 - np.pi)]])
    np.testing.assert_allclose(evaluate(turned)["Car"]["aos"][0].similarity, 0, atol=1e-12)  # type: ignore[index]


def test_one_result_without_alpha_switches_orientation_off() -> None:
    pair = pair_of([[thing()]], [[found(), found(400, alpha=-10.0)]])
    scores = evaluate(pair)
    assert scores["Car"]["aos"] is None
    assert scores["Cyclist"]["aos"] is not None


def test_results_without_locations_have_no_3d_figures() -> None:
    pair = pair_of([[thing()]], [[found(location=(-1000.0,) * 3, dims_hwl=(-1.0,) * 3)]])
    figures = as_percent(evaluate(pair))["Car"]
    assert figures["3d"] is None
    assert figures["bev"] is None
    assert figures["2d"]["R11"][0] > 0  # type: ignore[index]


def test_size_along_the_heading_is_length() -> None:
    along = thing(dims_hwl=(1.5, 1.0, 8.0), rotation_y=0.0)
    shifted = replace(along, score=0.9, location=(along.location[0] + 1.0, *along.location[1:]))
    sideways = replace(along, score=0.9, location=(*along.location[:2], along.location[2] + 1.0))
    assert precision_at(pair_of([[along]], [[shifted]]), metric="3d") == 1
    assert precision_at(pair_of([[along]], [[sideways]]), metric="3d") == 0


def test_height_acts_in_3d_and_not_from_above() -> None:
    raised = found(location=(4.0, 0.6, 20.0))
    assert precision_at(pair_of([[thing()]], [[raised]]), metric="bev") == 1
    assert precision_at(pair_of([[thing()]], [[raised]]), metric="3d") == 0


# ------------------------------------------------------------------ thresholds


def test_41_thresholds_at_even_recalls() -> None:
    scores = np.arange(200, 0, -1.0)
    np.testing.assert_array_equal(recall_thresholds(scores, 200)[[0, 1, 2, 40]], [200, 196, 191, 1])


@pytest.mark.parametrize("counted", [41, 50, 60, 79, 80, 81, 97, 120, 1000])
def test_a_perfect_result_reaches_all_recalls_from_41_objects_on(counted: int) -> None:
    assert len(recall_thresholds(np.linspace(0, 1, counted), counted)) == RECALL_POINTS


def test_fewer_objects_cannot_fill_the_recalls() -> None:
    assert len(recall_thresholds(np.ones(10), 10)) == 10
    assert len(recall_thresholds(np.zeros(0), 10)) == 0


# ------------------------------------------------------------------ laws


def plain_counts(
    truth: list[KittiObject], results: list[KittiObject], threshold: float, first_pass: bool
) -> tuple[list[float], int]:
    """Scores of the true positives, and false positives, of one frame by the rules said one after another.

    Cars in 2D, easy, overlap > 0.5.
    """
    overlap = iou_2d(as_set([results]).bbox, as_set([truth]).bbox)
    low = [int(abs(r.bbox_xyxy[3] - r.bbox_xyxy[1])) < 40 for r in results]
    score = [r.score or 0.0 for r in results]
    usable = [score[j] >= threshold and (r.type == "Car" or low[j]) for j, r in enumerate(results)]
    taken: set[int] = set()
    hits = []
    for i, t in enumerate(truth):
        near = [j for j in range(len(results)) if usable[j] and j not in taken and overlap[j, i] > 0.5]
        if t.type not in ("Car", "Van") or not near:
            continue
        good = [j for j in near if not low[j]]
        if first_pass:
            choice = max(near, key=lambda j: (score[j], -j))
        else:
            choice = max(good, key=lambda j: (overlap[j, i], -j)) if good else near[0]
        taken.add(choice)
        tall = t.bbox_xyxy[3] - t.bbox_xyxy[1] > 40
        if t.type == "Car" and tall and t.occluded == 0 and not low[choice]:
            hits.append(score[choice])
    return hits, sum(usable[j] and not low[j] and j not in taken for j in range(len(results)))


def plain_precision(frames: list[tuple[list[KittiObject], list[KittiObject]]], counted: int) -> list[float]:
    """Precision at the kept thresholds, each the largest from there on."""
    scores = [s for t, r in frames for s in plain_counts(t, r, -1.0, True)[0]]
    precision = []
    for threshold in recall_thresholds(np.array(scores), counted):
        counts = [plain_counts(t, r, threshold, False) for t, r in frames]
        hits = sum(len(h) for h, _ in counts)
        precision.append(hits / max(hits + sum(false for _, false in counts), 1))
    return [max(precision[k:]) for k in range(len(precision))]


def random_frame(rng: np.random.Generator) -> tuple[list[KittiObject], list[KittiObject]]:
    truth, results = [], []
    for _ in range(rng.integers(0, 7)):
        x, tall = rng.uniform(0, 250), rng.choice([30.0, 45.0, 60.0])
        name = str(rng.choice(["Car", "Car", "Van", "Truck"]))
        truth.append(thing(x, bbox_xyxy=(x, 0.0, x + 80, tall), type=name, occluded=int(rng.integers(0, 2))))
    for _ in range(rng.integers(0, 9)):
        x, tall = rng.uniform(0, 250), rng.choice([30.0, 39.9, 45.0, 60.0])
        name = str(rng.choice(["Car", "Car", "Pedestrian"]))
        results.append(found(x, float(rng.integers(1, 9)) / 8, bbox_xyxy=(x, 0.0, x + 80, tall), type=name))
    return truth, results


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**31))
def test_all_frames_at_once_count_as_one_after_another(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frames = [random_frame(rng) for _ in range(12)]
    pair = pair_of([t for t, _ in frames], [r for _, r in frames])
    curve = score_class(pair, find_candidates(pair, "2d"), "Car", "2d", 0.5, EASY)
    expected = np.zeros(RECALL_POINTS)
    precision = plain_precision(frames, curve.counted)
    expected[: len(precision)] = precision
    np.testing.assert_allclose(curve.precision, expected)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**31))
def test_the_order_of_frames_does_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frames = [random_frame(rng) for _ in range(10)]
    order = rng.permutation(10)
    a = as_percent(evaluate(pair_of([t for t, _ in frames], [r for _, r in frames])))
    b = as_percent(evaluate(pair_of([frames[k][0] for k in order], [frames[k][1] for k in order])))
    assert a == b


def test_nothing_found_and_nothing_there() -> None:
    for pair in (pair_of([[thing()]], [[]]), pair_of([[]], [[found()]]), pair_of([[]], [[]])):
        scores = as_percent(evaluate(pair))
        assert scores["Car"]["3d"] == {"R11": [0.0] * 3, "R40": [0.0] * 3}
