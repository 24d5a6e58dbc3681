"""The CARLA frames: what is read, and that no test frame is near a training frame."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from models_export.data.carla2d import ARCHIVE, GAP_TICKS, list_frames, read_frames
from models_export.data.detection import ANY_VEHICLE
from service.errors import NotFoundError

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


@pytest.fixture(scope="module")
def archive() -> Path:
    path = DATA / ARCHIVE
    if not path.is_file():
        pytest.skip(f"{path} is absent")
    return path


def test_the_split_is_complete_and_apart(archive: Path) -> None:
    sides = {side: list_frames(archive, side) for side in ("training", "gap", "test")}
    assert {side: len(frames) for side, frames in sides.items()} == {"training": 524, "gap": 25, "test": 230}
    for test in sides["test"]:
        near = [t.tick for t in sides["training"] if t.town == test.town and abs(t.tick - test.tick) < GAP_TICKS]
        assert not near


def test_boxes_are_vehicles_of_unknown_class(archive: Path) -> None:
    kinds = Counter(kind for _, _, labels in read_frames(archive, "test") for kind in labels.kinds)
    assert kinds == {ANY_VEHICLE: 276}


def test_an_absent_archive_says_so(tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="no such archive"):
        list_frames(tmp_path / ARCHIVE, "test")
