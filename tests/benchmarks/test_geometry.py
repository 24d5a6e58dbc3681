"""The figures of ``bench-geometry`` on small and simulated data; the recordings' figures where they are at hand."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.geometry_kitti import run_kitti
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
