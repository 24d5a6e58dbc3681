"""What the message says of the hard path."""

from __future__ import annotations

import json

import numpy as np
import pytest

from service.api.messages import detections_message, encode_json
from service.frames import EncodedFrame, FrameSet
from service.geometry.boxes import Boxes
from service.geometry.camera import Camera
from service.geometry.transforms import pole_camera_pose
from service.pipeline import SetResult
from service.site import Site

TIMING = dict.fromkeys(("decode", "detect", "orient", "depth", "lift", "fuse", "total"), 1.0)


def message(timing_ms: dict[str, float], hard: frozenset[str]) -> dict[str, dict[str, object]]:
    K = np.array([[90.0, 0.0, 63.5], [0.0, 90.0, 31.5], [0.0, 0.0, 1.0]])
    cameras = tuple(Camera(name, 128, 64, K, pole_camera_pose([0.0, 0.0, 6.0], 0.0, 0.3)) for name in ("north", "east"))
    frames = tuple(EncodedFrame(camera.id, b"", None) for camera in cameras)
    result = SetResult(
        boxes=Boxes.empty(),
        members=np.zeros((0, 2), dtype=bool),
        camera_ids=("north", "east"),
        classes=("car",),
        per_camera=[Boxes.empty(), Boxes.empty()],
        detections={"north": 0, "east": 0},
        timing_ms=timing_ms,
        failed={},
        hard=hard,
    )
    document: dict[str, dict[str, object]] = json.loads(
        encode_json(detections_message(FrameSet(Site("demo", cameras), frames, 10**18, 1), result, None, 0.1))
    )
    return document


def test_the_hard_path_is_named_where_it_ran() -> None:
    said = message({**TIMING, "guided": 3.0}, frozenset({"east"}))
    assert said["timing_ms"]["guided"] == 3.0
    assert [said["cameras"][name]["hard"] for name in ("north", "east")] == [False, True]  # type: ignore[index]


@pytest.mark.parametrize("key", ["hard", "guided"])
def test_without_a_hard_path_the_message_is_what_it_was(key: str) -> None:
    assert key not in json.dumps(message(TIMING, frozenset()))
