"""When a view counts as hard: one law and known answers."""

from __future__ import annotations

import numpy as np
import pytest

from service.hardness import HardnessSettings, covered_share, hardness_of

NONE = np.zeros((0, 4))
SETTINGS = HardnessSettings()


def picture(low: int, high: int) -> np.ndarray:
    """Left half at one grey level, right half at another."""
    image = np.full((96, 160, 3), low, np.uint8)
    image[:, 80:] = high
    return image


def row_of(count: int, step: float) -> np.ndarray:
    """Boxes of 40x20 px in a row, ``step`` px apart."""
    left = step * np.arange(count)
    return np.stack([left, np.zeros(count), left + 40, np.full(count, 20.0)], 1)


@pytest.mark.parametrize(
    ("image", "boxes", "hard"),
    [
        (picture(60, 200), NONE, False),
        (picture(10, 110), NONE, True),
        (picture(150, 200), NONE, True),
        (picture(60, 200), row_of(8, 50), False),
        (picture(60, 200), row_of(8, 10), True),
        (picture(60, 200), row_of(4, 10), False),
    ],
    ids=["clear", "dark", "fog", "apart", "crowded", "a few"],
)
def test_a_view_is_hard_when_it_is_dark_dull_or_crowded(image: np.ndarray, boxes: np.ndarray, hard: bool) -> None:
    assert hardness_of(image, boxes, SETTINGS).is_hard(SETTINGS) is hard


def test_what_is_measured() -> None:
    measured = hardness_of(picture(60, 200), row_of(2, 10), SETTINGS)
    assert measured.grey == 130.0
    assert measured.contrast == 140.0
    assert measured.overlapped == 2


def test_the_covered_share_is_of_the_boxes_own_area() -> None:
    boxes = np.array([[0.0, 0.0, 10.0, 10.0], [5.0, 0.0, 25.0, 10.0], [50.0, 50.0, 60.0, 60.0]])
    np.testing.assert_allclose(covered_share(boxes), [0.5, 0.25, 0.0])
    assert covered_share(NONE).shape == (0,)
