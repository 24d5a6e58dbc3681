"""The teacher: views that agree make a label, those that do not make a region; nothing is lost on the way to disk."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from models_export.data.detection import ANY_VEHICLE, IGNORED, Labels
from models_export.data.teacher import (
    AgreeConfig,
    Candidates,
    View,
    agreed,
    candidates,
    read_candidates,
    shown_whole,
    views,
    write_candidates,
)
from service.errors import InputError
from service.nets.detections import Detections

NOTHING = Labels.concatenate([])


class BrightThings:
    """A teacher that finds the white rectangles of a black picture, however it is cut or mirrored."""

    def detect(self, images: Sequence[np.ndarray], *, score_threshold: float) -> list[Detections]:
        found = []
        for image in images:
            _, _, stats, _ = cv2.connectedComponentsWithStats((image[..., 0] > 128).astype(np.uint8))
            xywh = stats[1:, :4].astype(np.float64)
            xyxy = np.concatenate([xywh[:, :2], xywh[:, :2] + xywh[:, 2:]], 1) - 0.5
            found.append(Detections(xyxy, np.full(len(xyxy), 0.7), np.zeros(len(xyxy), np.int64)))
        return found


def test_views_agree_on_what_all_of_them_show() -> None:
    image = np.zeros((200, 320, 3), np.uint8)
    image[90:110, 150:170] = 255  # the middle, which every view has
    image[20:40, 30:60] = 255  # one corner: the picture and one tile, each twice
    seen = candidates(BrightThings(), image)
    assert seen.found.tolist() == [10, 4]
    assert seen.possible.tolist() == [10, 4]
    np.testing.assert_allclose(seen.xyxy * [320, 200, 320, 200], [[150, 90, 170, 110], [30, 20, 60, 40]], atol=1e-6)


def test_a_tile_does_not_vote_on_what_its_border_cuts() -> None:
    tile = View(0.4, 0.0, 1.0, 0.6, False)
    boxes = np.array([[0.401, 0.1, 0.5, 0.2], [0.5, 0.0, 0.6, 0.2], [0.9, 0.1, 1.0, 0.2], [0.5, 0.5, 0.6, 0.6]])
    assert shown_whole(boxes, tile, 640, 360).tolist() == [False, True, True, False]
    assert len(views()) == 10


def one(found: int, possible: int, score: float, box: Sequence[float] = (0.2, 0.2, 0.3, 0.3)) -> Candidates:
    return Candidates(np.array([box]), np.array([score]), np.array([found]), np.array([possible]))


@pytest.mark.parametrize(
    ("seen", "kinds"),
    [
        (one(4, 4, 0.6), (ANY_VEHICLE,)),
        (one(2, 2, 0.6), (ANY_VEHICLE,)),  # as many as had it whole
        (one(2, 4, 0.6), (IGNORED,)),
        (one(4, 10, 0.6), (IGNORED,)),
        (one(4, 4, 0.3), (IGNORED,)),
        (one(1, 4, 0.3), ()),  # noise
        (one(1, 4, 0.5, (0.1, 0.1, 0.6, 0.6)), ()),  # a doubt that would blank a quarter of the picture
    ],
)
def test_what_becomes_of_a_candidate(seen: Candidates, kinds: tuple[str, ...]) -> None:
    assert agreed(seen, NOTHING, AgreeConfig()).kinds == kinds


def test_what_is_labelled_already_adds_nothing() -> None:
    labelled = Labels(np.array([[0.18, 0.18, 0.32, 0.32]]), ("car",))
    assert agreed(one(4, 4, 0.9), labelled, AgreeConfig()).kinds == ()


def test_candidates_are_read_back(tmp_path: Path) -> None:
    path = tmp_path / "seen.json"
    write_candidates(path, {"a/0": one(3, 4, 0.61), "b": Candidates(np.zeros((0, 4)), *(np.zeros(0, int),) * 3)})
    back = read_candidates(path)
    assert list(back) == ["a/0", "b"]
    np.testing.assert_allclose(back["a/0"].xyxy, [[0.2, 0.2, 0.3, 0.3]])
    assert (back["a/0"].found[0], back["a/0"].possible[0], len(back["b"].score)) == (3, 4, 0)


def test_another_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "seen.json"
    path.write_text("[1, 2]")
    with pytest.raises(InputError, match="not a teacher's file"):
        read_candidates(path)
