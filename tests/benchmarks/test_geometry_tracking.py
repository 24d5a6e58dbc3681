"""Parts of the tracking benchmark, and one short run on the recording where it is there."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.geometry_intersection import Scan
from benchmarks.geometry_tracking import FALSE_SHARE, MISS_SHARE, linked_ids, measured_boxes, run_tracking, true_speeds
from service.errors import QuadliftError
from service.geometry.boxes import box_states
from service.geometry.camera import Camera
from service.geometry.transforms import pole_camera_pose

K = np.array([[642.0, 0.0, 641.5], [0.0, 642.0, 191.5], [0.0, 0.0, 1.0]])


def two_cars(steps: int, speeds: tuple[float, float]) -> list[Scan]:
    """Two cars of different size that drive towards and past each other, listed in changing order."""
    scans = []
    for step in range(steps):
        way = 0.1 * step
        rows = np.array([[speeds[0] * way, 0, 0, 4.2, 1.8, 1.5, 0.0], [30 - speeds[1] * way, 3.2, 0, 4.9, 1.9, 1.7, -np.pi]])
        scans.append(Scan(way, rows[:: 1 if step % 3 else -1], np.zeros(2, np.int64)))
    return scans


def test_true_boxes_are_linked_and_their_speeds_known() -> None:
    scans = two_cars(40, (10.0, 6.0))
    ids = linked_ids(scans)
    speeds = true_speeds(scans, ids)
    pairs = zip(scans, ids, strict=True)
    long = [{round(row[3], 1): i for row, i in zip(s.truth.tolist(), own.tolist(), strict=True)} for s, own in pairs]
    assert all(names == long[0] for names in long)
    for scan, speed in zip(scans[4:-4], speeds[4:-4], strict=True):
        np.testing.assert_allclose(speed, np.where(scan.truth[:, 3] < 4.5, 10.0, 6.0))
    assert np.isnan(speeds[0]).all()


def test_noise_is_what_its_covariance_says() -> None:
    rng = np.random.default_rng(0)
    camera = Camera("c", 1284, 384, K, pole_camera_pose([0.0, 0.0, 6.0], 0.0, 0.2))
    truth = np.tile([40.0, 10.0, 0.75, 4.3, 1.8, 1.5, 0.3], (4000, 1))
    boxes = measured_boxes(truth, camera, rng)
    error = box_states(boxes) - truth[0]
    real = np.abs(error[:, :2]).max(1) < 3.0
    assert abs(real.mean() - (1 - FALSE_SHARE)) < 0.02
    assert abs(real.sum() / len(truth) - (1 - MISS_SHARE)) < 0.03
    normalised = np.einsum("ni,nij,nj->n", error[real, :3], np.linalg.inv(boxes.covariance[real, :3, :3]), error[real, :3])
    assert abs(normalised.mean() - 3.0) < 0.2


def test_a_short_run_on_the_recording() -> None:
    try:
        table = run_tracking(sequences=1)["tracking"]
    except QuadliftError as error:
        pytest.skip(str(error))
    both, away = table["both cameras, confirmed"], table["one away for 3 s, confirmed"]
    for figures in (both, away):
        assert float(figures["mota"] or 0) > 75
        assert float(figures["idf1"] or 0) > 80
    assert float(table["both cameras"]["stopped_heading_median_deg"] or 90) < 3
    assert float(table["both cameras"]["speed_error_median_mps"] or 9) < 0.6
