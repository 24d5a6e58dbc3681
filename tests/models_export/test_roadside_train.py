"""The roadside frames: clips, the split by clips, and the regions where labels are missing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from models_export.data.detection import Labels
from models_export.data.roadside_train import (
    ARCHIVE,
    GANTRY,
    HIGHWAYS,
    OVERPASSES,
    VALIDATION_CLIPS,
    RoadsideFrame,
    clip_of,
    far_zone,
    read_frames,
)

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


@pytest.fixture(scope="module")
def frames() -> list[RoadsideFrame]:
    path = DATA / ARCHIVE
    if not path.is_file():
        pytest.skip(f"{path} is absent")
    return read_frames(path)


@pytest.mark.parametrize(
    ("member", "clip"),
    [
        (f"{GANTRY}/images/malam_04112021_mp4-383_jpg.jpg", f"{GANTRY}/malam_04112021"),
        (f"{OVERPASSES}/images/12_mp4-24_jpg.jpg", f"{OVERPASSES}/12"),
        (f"{HIGHWAYS}/images/102_png.jpg", f"{HIGHWAYS}/curve"),
        (f"{HIGHWAYS}/images/102563_png.jpg", f"{HIGHWAYS}/night"),
        (f"{HIGHWAYS}/images/10260014_png.jpg", f"{HIGHWAYS}/motorway"),
        (f"{HIGHWAYS}/images/10260070010_png.jpg", f"{HIGHWAYS}/us-highway"),
        (f"{HIGHWAYS}/images/C7_png.jpg", f"{HIGHWAYS}/boulevard-c"),
        (f"{HIGHWAYS}/images/D2_png.jpg", f"{HIGHWAYS}/boulevard"),
    ],
)
def test_a_file_names_its_clip(member: str, clip: str) -> None:
    assert clip_of(member) == clip


def test_whole_clips_are_held_out(frames: list[RoadsideFrame]) -> None:
    clips = {frame.clip for frame in frames}
    assert len(frames) == 935
    assert clips >= VALIDATION_CLIPS
    assert {clip.split("/")[0] for clip in VALIDATION_CLIPS} == {GANTRY, HIGHWAYS, OVERPASSES}
    assert sum(frame.clip in VALIDATION_CLIPS for frame in frames) == 152


def test_the_far_zone_ends_where_labels_become_rare() -> None:
    rows = np.linspace(0.3, 0.9, 101)
    boxes = np.stack([np.full(101, 0.4), rows - 0.02, np.full(101, 0.5), rows + 0.02], 1)
    zone = far_zone([Labels(boxes[:50], ("car",) * 50), Labels(boxes[50:], ("car",) * 51)])
    np.testing.assert_allclose(zone, [[0.0, 0.17, 1.0, 0.33]])


def test_a_clip_without_boxes_has_a_far_zone_too() -> None:
    assert far_zone([Labels(np.zeros((0, 4)), ())]).shape == (1, 4)
