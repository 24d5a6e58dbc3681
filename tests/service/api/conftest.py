"""A service with a pipeline that decodes for real and finds one vehicle a camera; everything else is the true thing."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
import simplejpeg
from fastapi import FastAPI
from websockets.sync.client import ClientConnection, connect

from service.api.app import create_app
from service.api.server import Server, server_config
from service.errors import FrameError
from service.frames import FrameSet, decode
from service.geometry.boxes import Boxes
from service.pipeline import SetResult
from service.settings import Settings

WIDTH, HEIGHT = 128, 64


def camera_document(camera_id: str, **changes: Any) -> dict[str, Any]:
    document = {
        "id": camera_id,
        "width": WIDTH,
        "height": HEIGHT,
        "K": [[90.0, 0, 63.5], [0, 90.0, 31.5], [0, 0, 1]],
        "T_cam_world": [[1, 0, 0, 0], [0, -0.17364818, -0.98480775, 6], [0, 0.98480775, -0.17364818, 0], [0, 0, 0, 1]],
    }
    return {**document, **changes}


def site_body(*cameras: str) -> dict[str, Any]:
    return {"id": "demo", "cameras": [camera_document(c) for c in cameras or ("north", "east")]}


def jpeg(width: int = WIDTH, height: int = HEIGHT) -> bytes:
    x, y = np.meshgrid(np.linspace(0, 255, width), np.linspace(0, 255, height))
    data: bytes = simplejpeg.encode_jpeg(np.ascontiguousarray(np.stack([x, y, x], -1).astype(np.uint8)))
    return data


def png() -> bytes:
    return bytes(cv2.imencode(".png", np.full((HEIGHT, WIDTH, 3), 90, np.uint8))[1])


def one_box(x: float) -> Boxes:
    covariance = 0.01 * np.eye(7)[None]
    return Boxes(
        np.array([[x, 5.0, 0.75]]),
        np.array([[4.2, 1.8, 1.5]]),
        np.array([0.3]),
        np.array([0.9]),
        np.zeros(1, np.int64),
        covariance,
        np.zeros(1),
    )


@dataclass
class FakePipeline:
    """Decodes strictly; every decoded camera sees the same vehicle. Tests may slow it down or make it fail."""

    warm: threading.Event = field(default_factory=threading.Event)
    gates: dict[int, threading.Event] = field(default_factory=dict)
    """A frame set of this capture time (ns) waits for its gate."""
    failure: Exception | None = None
    boxes: Boxes = field(default_factory=lambda: one_box(10.0))
    runs: int = 0

    def warm_up(self) -> None:
        assert self.warm.wait(10)

    def run(self, frame_set: FrameSet) -> SetResult:
        self.runs += 1
        if frame_set.captured_at_ns in self.gates:
            assert self.gates[frame_set.captured_at_ns].wait(10)
        if self.failure is not None:
            raise self.failure
        good, failed = [], {}
        for frame in frame_set.frames:
            try:
                decode(frame.data, frame_set.site.camera(frame.camera_id), 672)
                good.append(frame.camera_id)
            except FrameError as error:
                failed[frame.camera_id] = error
        if not good:
            raise next(iter(failed.values()))
        stages = ("decode", "detect", "orient", "depth", "lift", "fuse")
        return SetResult(
            boxes=self.boxes,
            members=np.ones((len(self.boxes), len(good)), bool),
            camera_ids=tuple(good),
            classes=("car",),
            per_camera=[self.boxes for _ in good],
            detections=dict.fromkeys(good, len(self.boxes)),
            timing_ms={**dict.fromkeys(stages, 1.0), "total": 6.0},
            failed=failed,
        )


@pytest.fixture
def pipeline() -> FakePipeline:
    fake = FakePipeline()
    fake.warm.set()
    return fake


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.005)


class ServiceClient(httpx.Client):
    """A client of a service that really listens, in a thread of the test's process."""

    def __init__(self, settings: Settings, app: FastAPI, headers: dict[str, str] | None = None) -> None:
        self.app = app
        config = server_config(settings, app)
        self._server = Server(config, lambda: app.state.service.drain(), settings.drain_s)
        self._thread = threading.Thread(target=self._server.run)
        self._thread.start()
        wait_until(lambda: self._server.started or not self._thread.is_alive())
        self.address = f"127.0.0.1:{self._server.servers[0].sockets[0].getsockname()[1]}"
        super().__init__(base_url=f"http://{self.address}", timeout=20, headers=headers)

    def stream(self, path: str = "/stream/demo") -> ClientConnection:  # type: ignore[override]
        """Subscribe to a stream."""
        return connect(f"ws://{self.address}{path}", open_timeout=10, compression=None)

    def ask_to_stop(self) -> None:
        """What SIGTERM does."""
        self._server.should_exit = True

    def join(self) -> None:
        """Wait until the service has stopped."""
        self._thread.join(10)
        assert not self._thread.is_alive(), "the service did not stop"

    def shut_down(self) -> None:
        """Stop the service, if it has not."""
        self.close()
        self.ask_to_stop()
        self.join()


@pytest.fixture
def start(pipeline: FakePipeline) -> Iterator[Callable[..., ServiceClient]]:
    """Start a service with settings; by default it has the site ``demo`` with cameras ``north`` and ``east``, and is ready."""
    clients: list[ServiceClient] = []

    def build(ready: bool = True, headers: dict[str, str] | None = None, **options: Any) -> ServiceClient:
        settings = Settings(**{"workers": 2, "port": 0, "drain_s": 2, "run_limit_ms": 60_000, **options})
        client = ServiceClient(settings, create_app(settings, lambda _: pipeline), headers)
        clients.append(client)
        assert client.put("/sites/demo", json=site_body()).status_code == 201
        if ready:
            wait_until(lambda: client.get("/health/ready").status_code == 200)
        return client

    yield build
    pipeline.warm.set()
    for gate in pipeline.gates.values():
        gate.set()
    for client in clients:
        client.shut_down()


@pytest.fixture
def client(start: Callable[..., ServiceClient]) -> ServiceClient:
    return start()


def ask_for_websocket(address: str, path: str) -> socket.socket:
    """A WebSocket peer with a small buffer that has asked for the handshake, and not yet read the answer."""
    host, port = address.split(":")
    raw = socket.socket()
    raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    raw.settimeout(10)
    raw.connect((host, int(port)))
    raw.sendall(
        f"GET {path} HTTP/1.1\r\nHost: {address}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
    )
    return raw


def open_and_never_read(address: str, path: str = "/stream/demo") -> socket.socket:
    """A WebSocket peer, by default a subscriber, with a small buffer that takes no byte after the handshake."""
    raw = ask_for_websocket(address, path)
    assert b"101" in raw.recv(16)
    return raw


class Tools:
    """What tests of the API use; a fixture, since test modules import nothing from each other."""

    jpeg = staticmethod(jpeg)
    ask_for_websocket = staticmethod(ask_for_websocket)
    open_and_never_read = staticmethod(open_and_never_read)
    png = staticmethod(png)
    one_box = staticmethod(one_box)
    camera_document = staticmethod(camera_document)
    site_body = staticmethod(site_body)
    wait_until = staticmethod(wait_until)

    @staticmethod
    def detect(
        client: ServiceClient, frames: dict[str, bytes] | None = None, data: dict[str, str] | None = None, **query: Any
    ) -> httpx.Response:
        """POST frames (default: both cameras') to the site ``demo``."""
        frames = {"north": jpeg(), "east": jpeg()} if frames is None else frames
        files = {camera: (f"{camera}.jpg", content, "image/jpeg") for camera, content in frames.items()}
        response: httpx.Response = client.post("/detect", params={"site": "demo", **query}, files=files, data=data)
        return response

    @staticmethod
    def error(response: httpx.Response, status: int) -> dict[str, Any]:
        """The error of a response, whose form is checked."""
        assert response.status_code == status, response.text
        assert response.headers["content-type"] == "application/json"
        body = response.json()
        assert set(body) == {"error"}
        assert set(body["error"]) == {"code", "message", "field", "remedy"}
        error: dict[str, Any] = body["error"]
        return error


@pytest.fixture
def tools() -> Tools:
    return Tools()
