"""The figures of ``bench-geometry`` on small and simulated data; the recordings' figures where they are at hand."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.geometry import app
from benchmarks.geometry_kitti import run_kitti
from benchmarks.geometry_rigs import fusion_table, lift_table
from benchmarks.geometry_roadside import run_roadside
from benchmarks.geometry_scores import paired_iou_3d
from benchmarks.recordings import recording
from service.errors import NotFoundError
from service.geometry.iou import iou_3d


def need(name: str) -> None:
    try:
        recording(name)
    except NotFoundError as error:
        pytest.skip(f"needs the recordings: {error}")


def test_paired_iou_is_the_diagonal_of_all_pairs() -> None:
    rng = np.random.default_rng(0)
    a = np.c_[rng.normal(size=(60, 3)), rng.uniform(1, 5, (60, 3)), rng.uniform(-3, 3, 60)]
    b = a + 0.3 * rng.normal(size=a.shape)
    np.testing.assert_allclose(paired_iou_3d(a, b), np.diagonal(iou_3d(a, b)), atol=1e-12)


def test_kitti_figures() -> None:
    need("kitti_text.zip")
    # A quarter of the cars, in a quarter of the time; the bounds leave room for what that changes.
    tables = run_kitti(every=4)
    exact = tables["true boxes, sizes and yaw"]
    assert exact["map, ground: none"]["median_m"] <= 0.10
    assert exact["map, ground: none"]["p90_m"] <= 0.30
    guessed = tables["true boxes, mean sizes, yaw + 4 deg"]
    assert guessed["map, ground: none"]["median_m"] <= 1.03 * 1.03
    assert guessed["map, ground: none"]["p90_m"] <= 3.17 * 1.03
    assert guessed["map, ground: plane 0.06 m + 0.008 Z"]["median_m"] <= 0.91 * 1.03
    assert guessed["map, ground: plane 0.06 m + 0.008 Z"]["p90_m"] <= 2.95 * 1.03
    for rows in tables.values():
        for name, row in rows.items():
            if name.startswith("map") and "constant" not in name:
                assert row["median_m"] <= rows["paper, ground: none"]["median_m"]
                assert row["p90_m"] <= rows["paper, ground: none"]["p90_m"]


def test_roadside_figures() -> None:
    need("tumtraf_intersection.zip")
    rows = run_roadside(every=4)["ground from the other half (alternate scans)"]
    plane, grid, paper = (rows[f"{name}, fused"] for name in ("map, ground: plane", "map, ground: grid", "paper, ground: none"))
    for fused in (plane, grid):
        assert fused["median_m"] < 0.18
        assert fused["p90_m"] < 0.60
        assert fused["iou_above_07_percent"] > 80
        assert fused["association_precision"] > 0.98
        assert fused["association_recall"] > 0.97
        assert fused["median_m"] < 0.8 * paper["median_m"]
    for camera in ("south1", "south2"):
        flat, rolling = rows[f"map, ground: plane, {camera}"], rows[f"map, ground: grid, {camera}"]
        assert rolling["median_m"] < 0.85 * flat["median_m"]
        assert rolling["median_m"] < 0.65 * rows[f"paper, ground: none, {camera}"]["median_m"]


@pytest.mark.parametrize(("rig", "median_m", "p90_m", "good"), [((5.0, 10.0), 0.29, 0.85, 50), ((1.65, 0.0), 0.60, 2.0, 28)])
def test_simulated_lift_reaches_the_documented_table(
    rig: tuple[float, float], median_m: float, p90_m: float, good: float
) -> None:
    rows = lift_table(*rig, count=800)
    ground, depth = rows["map + ground"], rows["map + ground + depth"]
    assert ground["median_m"] <= median_m
    assert ground["p90_m"] <= p90_m
    assert ground["iou_above_07_percent"] >= good
    assert depth["p90_m"] <= 1.02 * ground["p90_m"]
    assert rows["map, edges only"]["median_m"] < rows["paper"]["median_m"]
    for row in rows.values():
        assert 2.3 < row["nees_mean"] < 3.7


def test_simulated_fusion_reaches_the_documented_table() -> None:
    independent, shared = fusion_table(False, count=150), fusion_table(True, count=150)
    assert independent["map + ground, fused"]["median_m"] <= 0.07
    assert independent["map + ground, fused"]["iou_above_07_percent"] >= 99
    assert shared["map + ground, fused"]["median_m"] <= 0.13
    assert shared["map + ground, fused"]["iou_above_07_percent"] >= 94


def test_the_table_prints_and_parses() -> None:
    result = CliRunner().invoke(app, ["rigs", "--json"])
    assert result.exit_code == 0, result.output
    assert set(json.loads(result.output)) == {"rigs", "machine"}
