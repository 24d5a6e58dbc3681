from __future__ import annotations

import numpy as np
import pytest

from benchmarks import geometry_speed
from benchmarks.geometry_speed import crossing_boxes, crossing_cameras, run_speed


def test_every_number_of_boxes_gets_its_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(geometry_speed, "BOXES", (1, 64))
    table = run_speed(repeats=3)["speed"]
    assert list(table) == ["1 boxes", "64 boxes"]
    for row in table.values():
        assert row["total_ms"] == pytest.approx(row["lift_ms"] + row["fuse_ms"] + row["track_ms"], abs=0.003)
    assert table["64 boxes"]["vehicles"] == 16
    assert table["64 boxes"]["us_a_box"] < table["1 boxes"]["us_a_box"]


def test_boxes_are_spread_over_the_cameras() -> None:
    cameras = crossing_cameras()
    measurements = crossing_boxes(64, cameras)
    assert np.bincount(measurements.camera_index).tolist() == [16] * 4
    assert (measurements.xyxy_px[:, 2:] > measurements.xyxy_px[:, :2]).all()
