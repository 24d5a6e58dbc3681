"""Samples of real pictures: geometry of their boxes, unknown classes, and the loss that knows of them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from models_export.data.detection import (
    ANY_VEHICLE,
    IGNORED,
    Labels,
    class_columns,
    detection_sample,
    yolo_labels,
)
from models_export.nets.detector import DetectorConfig
from models_export.train.detector import UNKNOWN_CLASS, detector_loss
from service.errors import InputError

CLASSES = ("car", "van", "truck", "bus")


def picture(width: int, height: int) -> bytes:
    image = np.full((height, width, 3), 90, np.uint8)
    return cv2.imencode(".jpg", image)[1].tobytes()


def test_fractions_become_pixels_with_centres_at_integers() -> None:
    labels = Labels(np.array([[0.0, 0.0, 0.5, 1.0], [0.25, 0.5, 1.0, 1.0]]), ("car", "bus"))
    sample = detection_sample(picture(320, 200), labels, CLASSES, 672, "toy")
    np.testing.assert_allclose(sample.xyxy_px, [[0, 0, 159.5, 199], [79.5, 99.5, 319, 199]])
    assert sample.canvas.shape == (224, 320, 3)
    assert sample.image_size == (320, 200)
    assert sample.cls.tolist() == [0, 3]


def test_pictures_are_decoded_to_the_width_of_training() -> None:
    sample = detection_sample(picture(1280, 720), Labels(np.zeros((0, 4)), ()), CLASSES, 672, "toy")
    assert sample.image_size == (640, 360)
    assert sample.xyxy_px.shape == (0, 4)


def test_what_is_not_asked_for_is_ignored_and_what_is_not_known_has_no_class() -> None:
    cls, known, ignore = class_columns(["car", "truck", ANY_VEHICLE, IGNORED], ("car", "bus"))
    assert cls.tolist() == [0, 0, 0, 0]
    assert known.tolist() == [True, False, False, False]
    assert ignore.tolist() == [False, True, False, True]


def test_small_boxes_are_ignored() -> None:
    labels = Labels(np.array([[0.5, 0.5, 0.51, 0.9], [0.1, 0.1, 0.4, 0.4]]), ("car", "car"))
    assert detection_sample(picture(320, 200), labels, CLASSES, 672, "toy").ignore.tolist() == [True, False]


@given(st.lists(st.tuples(*[st.floats(0.05, 0.9)] * 2, *[st.floats(0.01, 0.1)] * 2), max_size=5))
def test_yolo_lines_are_read_back(boxes: list[tuple[float, float, float, float]]) -> None:
    text = "".join(f"1 {x:.9f} {y:.9f} {w:.9f} {h:.9f}\n0 0.5 0.5 0.1 0.1\n" for x, y, w, h in boxes)
    labels = yolo_labels(text, (None, "van"), "a.txt")
    assert labels.kinds == ("van",) * len(boxes)
    expected = [[x - w / 2, y - h / 2, x + w / 2, y + h / 2] for x, y, w, h in boxes]
    np.testing.assert_allclose(labels.xyxy, np.array(expected).reshape(-1, 4), atol=1e-8)


@pytest.mark.parametrize("line", ["0 0.5 0.5 0.1", "7 0.5 0.5 0.1 0.1", "car 0.5 0.5 0.1 0.1", "0 a b c d"])
def test_a_damaged_label_names_its_line(line: str) -> None:
    with pytest.raises(InputError, match=r"a\.txt:2"):
        yolo_labels(f"0 0.5 0.5 0.1 0.1\n{line}\n", ("car",), "a.txt")


def loss_of(targets: list[list[float]], heads: list[torch.Tensor]) -> dict[str, torch.Tensor]:
    return detector_loss(heads, torch.tensor(targets), DetectorConfig(classes=CLASSES))


def test_an_unknown_class_changes_the_class_loss_only() -> None:
    generator = torch.Generator().manual_seed(3)
    heads = [torch.randn(1, 27, 96 // s, 160 // s, generator=generator) for s in (8, 16, 32)]
    box = [20.0, 30.0, 60.0, 56.0, 0.0]
    known, unknown = loss_of([[0, 2, *box]], heads), loss_of([[0, UNKNOWN_CLASS, *box]], heads)
    assert unknown["classes"] == 0
    assert known["classes"] > 0
    assert unknown["box"] == known["box"]
    assert unknown["objectness"] == known["objectness"]


def test_an_unknown_class_does_not_dilute_the_known_ones() -> None:
    heads = [torch.full((1, 27, 96 // s, 160 // s), 0.3) for s in (8, 16, 32)]
    car = [0, 0, 20.0, 30.0, 60.0, 56.0, 0.0]
    other = [0, UNKNOWN_CLASS, 90.0, 30.0, 130.0, 56.0, 0.0]
    torch.testing.assert_close(loss_of([car, other], heads)["classes"], loss_of([car], heads)["classes"])
