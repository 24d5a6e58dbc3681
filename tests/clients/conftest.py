"""A service that really listens, whose pipeline sees one vehicle; and a tiny clip."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
import uvicorn

from service.api.app import create_app
from service.frames import FrameSet
from service.geometry.boxes import Boxes
from service.pipeline import SetResult
from service.settings import Settings

WIDTH, HEIGHT = 128, 64
CAMERAS = ("north", "east")


def camera_document(camera_id: str) -> dict[str, Any]:
    return {
        "id": camera_id,
        "width": WIDTH,
        "height": HEIGHT,
        "K": [[90.0, 0, 63.5], [0, 90.0, 31.5], [0, 0, 1]],
        "T_cam_world": [[1, 0, 0, 0], [0, -0.17364818, -0.98480775, 6], [0, 0.98480775, -0.17364818, 0], [0, 0, 0, 1]],
    }


class OneVehicle:
    """A pipeline that finds the same vehicle in every frame set."""

    def warm_up(self) -> None:
        pass

    def run(self, frame_set: FrameSet) -> SetResult:
        seen = tuple(frame.camera_id for frame in frame_set.frames)
        boxes = Boxes(
            np.array([[10.0, 5.0, 0.75]]), np.array([[4.2, 1.8, 1.5]]), np.array([0.3]), np.array([0.9]),
            np.zeros(1, np.int64), 0.01 * np.eye(7)[None], np.zeros(1),
        )  # fmt: skip
        stages = dict.fromkeys(("decode", "detect", "orient", "depth", "lift", "fuse", "total"), 1.0)
        return SetResult(
            boxes, np.ones((1, len(seen)), bool), seen, ("car",), [boxes for _ in seen], dict.fromkeys(seen, 1), stages, {}
        )


@pytest.fixture
def site_document() -> dict[str, Any]:
    return {"id": "demo", "cameras": [camera_document(camera_id) for camera_id in CAMERAS]}


@pytest.fixture
def frames() -> dict[str, bytes]:
    grey = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    return {camera_id: simplejpeg.encode_jpeg(grey) for camera_id in CAMERAS}


@pytest.fixture
def service_url() -> Iterator[str]:
    """The root of a running service without sites."""
    app = create_app(Settings(workers=1), lambda _: OneVehicle())
    server = uvicorn.Server(uvicorn.Config(app, port=0, log_config=None, timeout_graceful_shutdown=2))
    thread = threading.Thread(target=server.run)
    thread.start()
    deadline = time.monotonic() + 10
    while not (server.started and app.state.service.phase == "ready"):
        assert thread.is_alive(), "the service ended"
        assert time.monotonic() < deadline, "the service did not start in time"
        time.sleep(0.01)
    yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join(10)
    assert not thread.is_alive(), "the service did not stop"


@pytest.fixture
def clip_folder(tmp_path: Path, site_document: dict[str, Any], frames: dict[str, bytes]) -> Path:
    """A clip of three steps at 10 Hz."""
    folder = tmp_path / "clip"
    for camera_id, data in frames.items():
        (folder / camera_id).mkdir(parents=True)
        for step in range(3):
            (folder / camera_id / f"{step:06d}.jpg").write_bytes(data)
    (folder / "site.json").write_text(json.dumps(site_document))
    steps = [{"step": step, "captured_at_ns": step * 100_000_000, "boxes": []} for step in range(3)]
    (folder / "truth.json").write_text(json.dumps({"rate_hz": 10, "steps": steps}))
    return folder
