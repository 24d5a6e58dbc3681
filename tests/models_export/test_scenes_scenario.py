"""The paper's easy, moderate and hard, and the fixed evaluation set; no OpenGL needed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from models_export.data.dataset import SceneTruth
from models_export.scenes import evaluation
from models_export.scenes.evaluation import (
    EVALUATION_SHA256,
    drawn_requests,
    evaluation_digest,
    evaluation_folder,
    evaluation_requests,
)
from models_export.scenes.light import CLEAR_WEATHERS
from models_export.scenes.plan import ScenePlan
from models_export.scenes.request import FIRST_RESERVED_SEED, SceneRequest
from models_export.scenes.scenario import (
    HIDDEN_BELOW,
    ROTATION_THRESHOLD_RAD,
    SCENARIOS,
    is_hard_weather,
    rotation_from_axes,
    vehicle_difficulty,
)
from models_export.scenes.writer import scene_document
from service.errors import InputError, QuadliftError


def truth_of(yaw: list[float], visible: list[list[float]]) -> SceneTruth:
    n = len(yaw)
    zeros = np.zeros((n, 3))
    return SceneTruth(
        0,
        np.arange(n),
        ("Car",) * n,
        zeros,
        zeros + 1,
        np.array(yaw),
        zeros,
        np.array(visible).reshape(n, 2),
        np.zeros((n, 2)),
    )


def test_rotation_is_from_the_nearest_lane_and_both_ways_count() -> None:
    axes = (0.0, np.pi / 2)
    yaw = np.deg2rad([0, 180, -180, 90, -90, 45, -45, 100, 170, 359])
    np.testing.assert_allclose(np.rad2deg(rotation_from_axes(yaw, axes)), [0, 0, 0, 0, 0, 45, 45, 10, 10, 1], atol=1e-9)
    np.testing.assert_allclose(np.rad2deg(rotation_from_axes(np.deg2rad([90.0]), (0.0,))), [90])
    # The world may be turned as a whole.
    np.testing.assert_allclose(rotation_from_axes(yaw + 0.7, tuple(a + 0.7 for a in axes)), rotation_from_axes(yaw, axes))
    assert rotation_from_axes(np.zeros(0), axes).shape == (0,)


def test_difficulty_of_vehicles() -> None:
    r = ROTATION_THRESHOLD_RAD
    seen, hidden, gone = [1.0, 0.2], [HIDDEN_BELOW - 0.01, 0.1], [0.0, 0.0]
    truth = truth_of([0.0, r - 1e-6, r + 1e-6, 0.0, 1.0, 1.0], [seen, seen, seen, hidden, hidden, gone])
    assert vehicle_difficulty(truth, "day", (0.0,)).tolist() == ["easy", "easy", "moderate", "hard", "hard", "unseen"]
    assert vehicle_difficulty(truth, "fog", (0.0,)).tolist() == ["hard"] * 5 + ["unseen"]
    assert vehicle_difficulty(truth_of([], []), "day", (0.0,)).shape == (0,)
    assert [is_hard_weather(w) for w in ("day", "clear", "indoor", "dim", "dusk", "night-rain")] == [False] * 3 + [True] * 3


@pytest.mark.parametrize("world", ["intersection", "curve", "garage"])
@pytest.mark.parametrize("scenario", ["moderate", "hard"])
def test_scenarios_shape_scenes(world: str, scenario: str) -> None:
    rotated = 0
    for seed in range(4):
        plan = ScenePlan(SceneRequest(seed, world, steps=1, scenario=scenario))
        moment = next(plan.moments())
        kinds = np.array(moment.kinds)
        vehicles = ~np.isin(kinds, ("pedestrian", "cyclist"))
        rotated += int(np.sum(rotation_from_axes(moment.poses[vehicles, 2], plan.axes_rad) > ROTATION_THRESHOLD_RAD))
        crowded = len(kinds) >= 16
        assert (plan.light.weather in CLEAR_WEATHERS) == (scenario == "moderate") or crowded
    assert rotated > 0 or scenario == "hard"


@pytest.mark.parametrize("world", ["intersection", "straight", "t-junction", "garage"])
def test_nobody_turns_in_easy_scenes(world: str) -> None:
    for seed in range(5):
        plan = ScenePlan(SceneRequest(seed, world, steps=3, rate_hz=0.5, scenario="easy"))
        for moment in plan.moments():
            vehicles = ~np.isin(moment.kinds, ("pedestrian", "cyclist"))
            assert np.all(rotation_from_axes(moment.poses[vehicles, 2], plan.axes_rad) < ROTATION_THRESHOLD_RAD)
        assert plan.light.weather in CLEAR_WEATHERS


def test_evaluation_sets_are_large_and_reserved() -> None:
    seeds = []
    for scenario in SCENARIOS:
        requests = evaluation_requests(scenario)
        assert sum(r.steps for r in requests) >= 50
        assert all(r.scenario == scenario and r.cameras == 4 for r in requests)
        assert len({r.world for r in requests}) >= 4
        assert {r.rig for r in requests} == {"poles", "sides", "turn"}
        assert any(r.distorted for r in requests)
        for request in requests:
            request.check()
            seeds.append(request.seed)
    assert min(seeds) >= FIRST_RESERVED_SEED
    assert len(set(seeds)) == len(seeds)


def test_the_evaluation_set_is_the_published_one() -> None:
    """Fails when the generator changes: then scores stop comparing, and GENERATOR and the digest must be raised together."""
    assert evaluation_digest() == EVALUATION_SHA256


def test_the_digest_notices_a_moved_vehicle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluation, "SCENES", 1)
    before = evaluation_digest(("easy",))
    assert evaluation_digest(("easy",)) == before
    original = evaluation._moment_description

    def moved(moment: object) -> dict[str, object]:
        found = original(moment)  # type: ignore[arg-type]
        return {**found, "center": found["center"] + 0.002}  # type: ignore[operator]

    monkeypatch.setattr(evaluation, "_moment_description", moved)
    assert evaluation_digest(("easy",)) != before
    with pytest.raises(QuadliftError, match="another evaluation set"):
        evaluation.check_digest()


def test_only_missing_scenes_are_rendered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluation, "SCENES", 3)
    first, second, third = evaluation_requests("easy")
    for request, text in (
        (first, json.dumps(scene_document(ScenePlan(first)))),
        (second, json.dumps({**scene_document(ScenePlan(second)), "generator": "quadlift-scenes 1"})),
        (third, "{"),
    ):
        folder = tmp_path / evaluation_folder(request)
        folder.mkdir()
        (folder / "scene.json").write_text(text)
    assert evaluation.missing_requests(tmp_path, ("easy",)) == [second, third]


def test_drawn_sets_are_reserved_repeatable_and_never_the_fixed_one() -> None:
    first, again, other = (drawn_requests(draw, 5, 2) for draw in (7, 7, 8))
    assert first == again
    assert [r.scenario for r in first] == [scenario for scenario in SCENARIOS for _ in range(5)]
    fixed = {r.seed for scenario in SCENARIOS for r in evaluation_requests(scenario)}
    seeds = [r.seed for r in (*first, *other)]
    assert len(set(seeds)) == len(seeds)
    assert not fixed & set(seeds)
    for request in (*first, *other):
        request.check()
        with pytest.raises(InputError, match="reserved"):
            request.check(reserved=False)
