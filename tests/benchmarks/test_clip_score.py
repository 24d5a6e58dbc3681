"""2D boxes of the roadside protocol, counted by hand."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.clip_score import FlatFinds
from benchmarks.recordings import shown_extents
from service.geometry.camera import Camera

VEHICLES = np.array([[0.0, 0.0, 10.0, 10.0], [100.0, 0.0, 110.0, 10.0]])


@pytest.fixture
def finds() -> FlatFinds:
    """Two pictures: of four vehicles three are found, one of them twice; two boxes stand on nothing."""
    finds = FlatFinds()
    # The worse box on the first vehicle comes first here, and the better one takes it.
    boxes = np.array([[0.0, 0.0, 10.0, 9.0], [0.0, 0.0, 10.0, 10.0], [50.0, 50.0, 60.0, 60.0]])
    finds.add(boxes, np.array([0.3, 0.9, 0.8]), VEHICLES)
    finds.add(np.concatenate([VEHICLES, VEHICLES[:1] + 500]), np.array([0.7, 0.2, 0.1]), VEHICLES)
    return finds


def test_a_vehicle_is_taken_once_by_the_best_box(finds: FlatFinds) -> None:
    assert finds.references == 4
    assert finds.down_to(0.0) == {"recalled": 3, "false": 3}
    assert finds.down_to(0.7) == {"recalled": 2, "false": 1}


@pytest.mark.parametrize(
    ("most", "recalled", "false", "least"), [(0, 1, 0, 0.9), (1, 2, 1, 0.7), (2, 3, 2, 0.2), (9, 3, 3, 0.1)]
)
def test_the_best_scores_up_to_so_many_false(finds: FlatFinds, most: int, recalled: int, false: int, least: float) -> None:
    assert finds.up_to(most) == {"recalled": recalled, "false": false, "least_score": least}


def test_boxes_of_one_score_count_together() -> None:
    finds = FlatFinds()
    finds.add(np.concatenate([VEHICLES, VEHICLES + 300]), np.full(4, 0.5), VEHICLES)
    assert finds.up_to(1) == {"recalled": 0, "false": 0, "least_score": 1.0}
    assert finds.up_to(2) == {"recalled": 2, "false": 2, "least_score": 0.5}


def test_a_box_is_shown_that_lies_before_the_camera_and_mostly_in_the_image() -> None:
    K = [[100.0, 0.0, 99.5], [0.0, 100.0, 49.5], [0.0, 0.0, 1.0]]
    camera = Camera("c", 200, 100, np.array(K), np.eye(4))
    center = np.array([[0.0, 0.0, 10.0], [10.0, 0.0, 10.0], [10.4, 0.0, 10.0], [0.0, 0.0, -10.0], [0.0, 0.0, 0.5]])
    flat = np.tile([2.0, 2.0, 1e-3], (5, 1))
    shown, inside = shown_extents(camera, center, flat, np.zeros(5))
    np.testing.assert_allclose(shown[0], [89.5, 39.5, 109.5, 59.5], atol=0.01)
    # Of the second box half lies beyond the image's right edge, of the third seven tenths.
    np.testing.assert_array_equal(inside, [True, True, False, False, False])
    assert shown[1, 2] == camera.width - 1
