"""The drive's truth and counting on boxes made here; the real drive with a real detector where both lie at hand."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.accuracy import app
from benchmarks.drive_score import Finds, detect_in, match, score_drive
from benchmarks.drive_truth import DriveFrame, truth_of, visible_part
from benchmarks.recordings import PANDASET_CLIP, recording
from models_export.data.pandaset import PandasetBoxes
from service.errors import NotFoundError
from service.geometry.camera import Camera
from service.geometry.transforms import pole_camera_pose
from service.nets.detections import Detections

K = np.array([[600.0, 0.0, 639.5], [0.0, 600.0, 359.5], [0.0, 0.0, 1.0]])
CAMERA = Camera("front", 1280, 720, K, pole_camera_pose([0.0, 0.0, 1.5], 0.0, 0.0))
"""Looks East from 1.5 m above the road."""


def boxes_at(*places: tuple[float, float, str]) -> PandasetBoxes:
    """Cars of 4 x 2 x 1.5 m that head East, at x, y, of labels."""
    count = len(places)
    center = np.array([[x, y, 0.75] for x, y, _ in places])
    labels = tuple(label for _, _, label in places)
    return PandasetBoxes(center, np.tile([4.0, 2.0, 1.5], (count, 1)), np.zeros(count), labels, labels)


def test_only_vehicles_in_front_and_tall_enough_are_asked_for() -> None:
    places = [(12.0, 0.0, "Car"), (14.0, 4.0, "Pickup Truck"), (60.0, 8.0, "Car"), (-12.0, 0.0, "Car"), (12.0, -4.0, "Cones")]
    asked, clear, ignored = truth_of(CAMERA, boxes_at(*places))
    assert len(asked) == 2
    assert clear.tolist() == [True, True]
    # The far one only: what is behind or no vehicle leaves no trace.
    assert len(ignored) == 1
    # The near face of the first: 2 m wide, 10 m away, its lower edge on the road.
    np.testing.assert_allclose(asked[0], [579.5, 359.5, 699.5, 449.5])


def test_what_resembles_a_vehicle_or_reaches_behind_the_camera_is_ignored() -> None:
    asked, _, ignored = truth_of(CAMERA, boxes_at((12.0, 0.0, "Towed Object"), (1.0, 2.5, "Car")))
    assert len(asked) == 0
    assert len(ignored) == 2
    assert np.all((ignored >= 0) & (ignored <= [1279, 719, 1279, 719]))


def test_a_hidden_vehicle_is_asked_for_but_not_clear() -> None:
    asked, clear, _ = truth_of(CAMERA, boxes_at((18.0, 0.0, "Car"), (12.0, 0.0, "Car")))
    assert len(asked) == 2
    assert clear.tolist() == [False, True]


def test_the_visible_part_is_what_nearer_boxes_leave() -> None:
    xyxy = np.array([[100.0, 100.0, 299.0, 199.0], [200.0, 0.0, 400.0, 400.0], [0.0, 0.0, 1279.0, 719.0]])
    part = visible_part(CAMERA, xyxy, np.array([20.0, 10.0, 5.0]), np.array([True, True, False]))
    assert part[0] == pytest.approx(0.5, abs=0.03)
    assert part[1] == pytest.approx(1.0)
    assert part[2] == 0.0


def test_each_box_finds_one_vehicle_and_ignored_places_excuse() -> None:
    truth = np.array([[0.0, 0.0, 10.0, 10.0], [20.0, 0.0, 30.0, 10.0]])
    ours = np.array([[0.0, 0.0, 10.0, 9.0], [0.0, 0.0, 10.0, 10.0], [50.0, 50.0, 60.0, 60.0], [80.0, 80.0, 90.0, 90.0]])
    taken, false = match(ours, truth, np.array([[45.0, 45.0, 70.0, 70.0]]))
    assert taken.tolist() == [True, False]
    assert false == 2
    assert match(np.zeros((0, 4)), truth, np.zeros((0, 4)))[1] == 0
    assert match(ours, np.zeros((0, 4)), np.zeros((0, 4)))[1] == 4


class Painted:
    """Finds fixed boxes, given in a picture half as wide."""

    def __init__(self, xyxy_px: list[list[float]], score: list[float]) -> None:
        self.found = Detections(np.array(xyxy_px), np.array(score), np.zeros(len(score), np.int64))

    def detect(self, images: list[np.ndarray], *, score_threshold: float) -> list[Detections]:
        keep = self.found.score > score_threshold
        return [Detections(self.found.xyxy_px[keep], self.found.score[keep], self.found.cls[keep]) for _ in images]


def test_counts_by_threshold_in_the_recordings_pixels() -> None:
    truth = np.array([[99.5, 99.5, 199.5, 199.5]])
    _, png = cv2.imencode(".png", np.zeros((720, 1280, 3), np.uint8))
    frame = DriveFrame(CAMERA, 0, png.tobytes(), truth, np.array([True]), np.zeros((0, 4)))
    detector: Finds = Painted([[49.5, 49.5, 99.5, 99.5], [0.0, 0.0, 5.0, 5.0]], [0.6, 0.2])
    np.testing.assert_allclose(detect_in(detector, CAMERA.width // 2, frame, 0.5).xyxy_px, truth)
    low, middle, high = score_drive(detector, CAMERA.width // 2, [frame, frame], [0.1, 0.5, 0.9])
    assert (low.vehicles, low.found, low.clear_found, low.false) == (2, 2, 2, 2)
    assert (middle.found, middle.false, high.found, high.false) == (2, 0, 0, 0)
    assert middle.summary()["recall_percent"] == 100.0


def test_the_command_scores_the_shipped_pack_on_the_real_drive() -> None:
    try:
        recording(PANDASET_CLIP)
    except NotFoundError as error:
        pytest.skip(str(error))
    done = CliRunner().invoke(app, ["pandaset", "--every", "60", "--score", "0.3", "--json"])
    assert done.exit_code == 0, done.output
    (score,) = json.loads(done.stdout)["scores"]["ONNX Runtime"]
    assert score["frames"] == 6
    assert 0 < score["found"] < score["vehicles"]
