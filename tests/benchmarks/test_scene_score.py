"""Scoring scenes: laws, the rule of what counts, camera counts, the command."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import accuracy
from benchmarks.scene_grades import grade_of
from benchmarks.scene_plots import write_plots
from benchmarks.scene_report import PAPER_AP, accuracy_table, paper_table
from benchmarks.scene_score import ALL, SINGLE, Scores, score_scenes, settings_of, summaries
from benchmarks.scene_sets import MIN_SHOWN, in_view, open_scene_sets, wanted
from service.errors import InputError, NotFoundError
from service.geometry.camera import Camera
from service.geometry.transforms import Array
from service.pipeline import PipelineSettings
from service.site import Site

Factory = Callable[..., Any]
Cameras = tuple[Camera, ...]
STEPS = 8
ALL_FIT = np.ones(1, dtype=bool)


def score(dataset: Path, make: Any, counts: tuple[int, ...] = (1, 2, 3, 4)) -> Scores:
    return score_scenes(open_scene_sets(dataset), make, PipelineSettings(), counts)


def test_perfect_boxes_score_100(dataset: Path, answering: Factory) -> None:
    figures = summaries(score(dataset, answering()))
    assert list(figures) == ["easy", "moderate", "hard", ALL]
    for views in figures.values():
        assert list(views) == ["1", "2", "3", "4", SINGLE]
        for name, view in views.items():
            assert view["vehicles"] > 0
            for metric in ("ap_3d", "ap_bev"):
                assert view[metric] == {"0.5": {"R11": 100.0, "R40": 100.0}, "0.7": {"R11": 100.0, "R40": 100.0}}, name
            assert view["recall_percent"] == view["precision_percent"] == 100
            assert max(view["rmse_m"].values()) < 1e-5
            if name != SINGLE:
                assert view["tracking"] == {"mota": 100.0, "idf1": 100.0, "hota": 100.0, "switches": 0}


def test_more_cameras_see_more_vehicles(dataset: Path, answering: Factory) -> None:
    figures = summaries(score(dataset, answering()))["easy"]
    counts = [figures[str(n)]["vehicles"] for n in (1, 2, 3, 4)]
    assert counts == sorted(counts)
    assert counts[0] < counts[-1] == 5 * STEPS
    assert figures[SINGLE]["frame_sets"] == 4 * STEPS


def test_a_constant_offset_is_the_rmse(dataset: Path, answering: Factory) -> None:
    view = summaries(score(dataset, answering(offset_m=(0.3, -0.2, 0.1)), (4,)))["easy"]["4"]
    assert view["rmse_m"] == {"x": 0.3, "y": 0.2, "z": 0.1}
    assert view["error_m"]["p50"] == pytest.approx(np.sqrt(0.14), abs=1e-3)


def test_worse_boxes_never_score_better(dataset: Path, answering: Factory) -> None:
    views = [summaries(score(dataset, answering(noise_m=sigma), (4,)))[ALL]["4"] for sigma in (0.0, 0.15, 0.4)]
    for key in ("0.5", "0.7"):
        averages = [view["ap_3d"][key]["R40"] for view in views]
        assert averages == sorted(averages, reverse=True)
        assert averages[2] < 90
    assert views[0]["tracking"]["hota"] > views[1]["tracking"]["hota"] > views[2]["tracking"]["hota"]


def test_dropped_boxes_cost_recall_and_no_precision(dataset: Path, answering: Factory) -> None:
    view = summaries(score(dataset, answering(keep=0.5), (4,)))[ALL]["4"]
    assert 30 < view["recall_percent"] < 70
    assert view["precision_percent"] == 100
    assert view["ap_3d"]["0.7"]["R40"] == pytest.approx(view["recall_percent"], abs=3)


def test_a_golden_score(dataset: Path, answering: Factory) -> None:
    """One exact result; if it moves, the scoring has changed. (Tracking scores are pinned without a tracker, elsewhere.)"""
    view = summaries(score(dataset, answering(noise_m=0.2), (4,)))[ALL]["4"]
    figures = [view["ap_3d"]["0.7"]["R11"], view["ap_3d"]["0.7"]["R40"], view["ap_bev"]["0.7"]["R40"]]
    np.testing.assert_allclose(figures, [20.41, 17.75, 56.42], atol=0.02)


def test_no_answers_at_all(dataset: Path, answering: Factory) -> None:
    view = summaries(score(dataset, answering(keep=0.0), (4,)))["easy"]["4"]
    assert view["ap_3d"]["0.7"] == {"R11": 0.0, "R40": 0.0}
    assert view["recall_percent"] == 0
    assert view["precision_percent"] is None
    assert view["rmse_m"] == {"x": None, "y": None, "z": None}
    assert view["tracking"] == {"mota": 0.0, "idf1": 0.0, "hota": 0.0, "switches": 0}


# ------------------------------------------------------------------ what counts


@pytest.mark.parametrize(
    ("values", "counted"),
    [
        ({"visible": 1.0, "truncated": 0.0}, True),
        ({"visible": MIN_SHOWN + 0.01, "truncated": 0.0}, True),
        ({"visible": MIN_SHOWN, "truncated": 0.0}, False),
        ({"visible": 0.6, "truncated": 0.6}, False),
        ({"visible": 0.6, "truncated": 0.4}, True),
        ({"visible": 1.0, "truncated": 0.0, "x": 40.0}, False),
        ({"visible": 1.0, "truncated": 0.0, "cls": "Van"}, False),
        ({"visible": 1.0, "truncated": 0.0, "cls": "car"}, True),
    ],
)
def test_what_has_to_be_found(values: dict[str, Any], counted: bool, one_car: Factory, cameras: Cameras) -> None:
    assert wanted(one_car(**values), ALL_FIT, "abcd", Site("s", cameras)).counted.tolist() == [counted]


def test_only_the_cameras_in_use_count(one_car: Factory, cameras: Cameras) -> None:
    result = wanted(one_car(1.0, 0.0), ALL_FIT, "abcd", Site("s", cameras[1:]))
    assert not result.counted[0]
    assert result.distance_m[0] == np.inf


def test_distance_is_to_the_nearest_camera_that_shows_it(one_car: Factory, cameras: Cameras) -> None:
    result = wanted(one_car(1.0, 0.0, x=10.0), ALL_FIT, "abcd", Site("s", cameras))
    assert result.distance_m[0] == pytest.approx(np.linalg.norm([28.0, 18.0, 5.25]))


def test_a_place_behind_all_cameras_is_out_of_view(cameras: Cameras) -> None:
    places: Array = np.array([[0.0, 0.0, 0.7], [-60.0, -60.0, 0.7], [0.0, 0.0, 60.0]])
    np.testing.assert_array_equal(in_view(Site("s", cameras), places), [True, False, False])


def test_difficulty_comes_from_the_scenes_scenario(dataset: Path, answering: Factory) -> None:
    sets = open_scene_sets(dataset)
    assert [grade_of(scene).difficulty for scene in sets.scenes] == ["easy", "moderate", "hard"]
    edit_scene(dataset, scenario=None)
    assert list(score(dataset, answering(), (1,))) == ["moderate", "hard", "ungraded", ALL]


def test_an_unknown_scenario_names_the_file(dataset: Path) -> None:
    path = edit_scene(dataset, scenario="sunny")
    with pytest.raises(InputError, match="'sunny'") as caught:
        grade_of(open_scene_sets(dataset).scenes[0])
    assert caught.value.field == str(path)


def test_vehicles_harder_than_their_scene_are_ignored(dataset: Path, answering: Factory) -> None:
    # Against lanes that run another way every car is turned, which is more than an easy scene asks for.
    edit_scene(dataset, axes_rad=[0.3 + np.pi / 4])
    figures = summaries(score(dataset, answering(), (4,)))
    assert figures["easy"]["4"]["vehicles"] == 0
    assert figures["easy"]["4"]["ap_3d"]["0.7"] == {"R11": None, "R40": None}
    assert figures["moderate"]["4"]["vehicles"] == 5 * STEPS


def edit_scene(dataset: Path, **values: object) -> Path:
    path = dataset / "scene-0" / "scene.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | values))
    return path


def test_a_single_difficulty_has_no_total(dataset: Path, answering: Factory) -> None:
    assert list(score(dataset / "scene-1", answering(), (2,))) == ["moderate"]


# ------------------------------------------------------------------ bad input


def edit_boxes(dataset: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    path = dataset / "scene-0" / "boxes" / "000002.json"
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    return path


def test_unknown_classes_are_skipped_and_counted(dataset: Path, answering: Factory) -> None:
    edit_boxes(dataset, lambda d: d["boxes"][1].update({"class": "Hovercraft"}))
    sets = open_scene_sets(dataset)
    view = summaries(score_scenes(sets, answering(), PipelineSettings(), (4,)))["easy"]["4"]
    assert view["vehicles"] == 5 * STEPS - 1
    assert sets.unknown == {"hovercraft": 1}


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_number_that_is_none_names_the_file(dataset: Path, answering: Factory, value: float) -> None:
    path = edit_boxes(dataset, lambda d: d["boxes"][0]["center"].__setitem__(1, value))
    with pytest.raises(InputError, match="box 0 is not finite") as caught:
        score(dataset, answering(), (4,))
    assert caught.value.field == str(path)


def test_a_step_without_truth_names_the_file(dataset: Path, answering: Factory) -> None:
    (dataset / "scene-1" / "boxes" / "000003.json").unlink()
    with pytest.raises(NotFoundError, match=r"000003\.json"):
        score(dataset, answering(), (4,))


def test_a_step_without_a_frame_names_the_file(dataset: Path, answering: Factory) -> None:
    (dataset / "scene-1" / "cameras" / "c" / "image_2" / "000003.jpg").unlink()
    with pytest.raises(NotFoundError, match=r"000003\.jpg"):
        score(dataset, answering(), (4,))


def test_the_papers_method_runs_where_the_pipeline_offers_it() -> None:
    assert settings_of("map") == PipelineSettings()
    if hasattr(PipelineSettings(), "method"):
        assert settings_of("paper").method == "paper"
        return
    with pytest.raises(InputError, match=r"no field 'method'") as caught:
        settings_of("paper")
    assert caught.value.field == "--method"


# ------------------------------------------------------------------ reports and the command


def test_plots_are_pictures(dataset: Path, answering: Factory, tmp_path: Path) -> None:
    paths = write_plots(score(dataset, answering(noise_m=0.2), (1, 4)), tmp_path / "new" / "plots")
    assert [path.name for path in paths] == ["precision_recall.png", "rmse.png"]
    for path in paths:
        assert path.read_bytes()[:4] == b"\x89PNG"
        assert path.stat().st_size > 5000


def test_plots_of_nothing_found(dataset: Path, answering: Factory, tmp_path: Path) -> None:
    assert len(write_plots(score(dataset, answering(keep=0.0), (1,)), tmp_path / "plots")) == 2


def test_the_papers_table_says_that_the_data_differ(dataset: Path, answering: Factory) -> None:
    figures = summaries(score(dataset, answering(), (4,)))
    table = paper_table(figures)
    assert "data differ" in str(table.caption)
    assert [next(iter(column.cells)) for column in table.columns][1:] == [str(value) for value in PAPER_AP.values()]
    assert accuracy_table(figures, "t").row_count == 8


def run(dataset: Path, *options: str) -> tuple[int, str, str]:
    result = CliRunner().invoke(accuracy.app, ["scenes", str(dataset), *options])
    return result.exit_code, result.stdout, result.stderr


@pytest.fixture
def without_networks(monkeypatch: pytest.MonkeyPatch, answering: Factory) -> None:
    """The command with pipelines that answer with the truth."""
    make = answering(noise_m=0.1)
    monkeypatch.setattr(accuracy, "load_pack", lambda name: name)
    monkeypatch.setattr(accuracy, "Pipeline", lambda pack, settings: make(settings))


@pytest.mark.usefixtures("without_networks")
def test_the_command_prints_the_contracts_figures(dataset: Path, tmp_path: Path) -> None:
    code, out, _ = run(dataset, "--json", "--plots", str(tmp_path / "plots"))
    assert code == 0
    report = json.loads(out)
    view = report["difficulties"]["hard"]["4"]
    assert {"ap_3d", "ap_bev", "rmse_m", "recall_percent", "error_m", "by_distance", "tracking"} <= set(view)
    assert report["method"] == "map"
    assert report["rules"]["min_shown"] == MIN_SHOWN
    assert (tmp_path / "plots" / "rmse.png").is_file()


@pytest.mark.usefixtures("without_networks")
def test_the_command_prints_tables(dataset: Path) -> None:
    code, out, _ = run(dataset, "--cameras", "2")
    assert code == 0
    for word in ("each alone", "HOTA", "54.1", "differ"):
        assert word in out


@pytest.mark.usefixtures("without_networks")
@pytest.mark.parametrize(
    ("options", "said"),
    [(("--cameras", "5"), "no scene has 5 cameras"), (("--cameras", "0"), "cameras"), (("--method", "x"), "x")],
)
def test_the_command_refuses_what_it_cannot_do(dataset: Path, options: tuple[str, ...], said: str) -> None:
    code, out, err = run(dataset, *options)
    assert code == 2
    assert out == ""
    assert said in err


def test_a_folder_without_scenes(tmp_path: Path) -> None:
    code, _, err = run(tmp_path / "nothing")
    assert code == 2
    assert "holds no scenes" in err
