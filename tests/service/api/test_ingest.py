"""WS /ingest: frames become sets on the stream; every refusal is answered, every frame accounted for."""

from __future__ import annotations

import asyncio
import json
import struct
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest
from starlette.websockets import WebSocket
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from service.api import ingest
from service.schemas import Detections, rfc3339_from_ns


def open_ingest(client: Any, site: str = "demo") -> ClientConnection:
    return connect(f"ws://{client.address}/ingest/{site}", open_timeout=10, close_timeout=1, compression=None)


def message(camera: str, time_ns: int, data: bytes, sequence: int = 0) -> bytes:
    header = json.dumps({"camera": camera, "captured_at": rfc3339_from_ns(time_ns), "sequence": sequence}).encode()
    return struct.pack(">I", len(header)) + header + data


def receive(stream: Any) -> Detections:
    return Detections.model_validate_json(stream.recv(timeout=5))


def error_of(socket: Any) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(socket.recv(timeout=5))
    return dict(document["error"])


def drops(client: Any) -> dict[str, int]:
    counted: dict[str, int] = client.app.state.service.telemetry.drops()
    return {reason: count for reason, count in counted.items() if count}


def join(socket: Any, stream: Any, image: bytes, start_ns: int) -> None:
    """Send sets until one is complete: then both cameras are known."""
    for i in range(10):
        for camera in ("north", "east"):
            socket.send(message(camera, start_ns + i * 100_000_000, image))
        if not receive(stream).degraded:
            return
    pytest.fail("no set was complete")


def test_frames_of_two_connections_make_one_message(client: Any, tools: Any) -> None:
    with client.stream() as stream, open_ingest(client) as north, open_ingest(client) as east:
        start = time.time_ns()
        for i in range(5):
            north.send(message("north", start + i * 100_000_000, tools.jpeg()))
            east.send(message("east", start + i * 100_000_000 + 3_000_000, tools.jpeg()))
            time.sleep(0.1)
        got = receive(stream)
        while got.degraded:
            got = receive(stream)
        assert got.cameras["north"].skew_ms == 0
        assert got.cameras["east"].skew_ms == pytest.approx(3.0)
        assert got.boxes[0].track_id is not None
        with pytest.raises(TimeoutError):
            north.recv(timeout=0.05)
    text = client.get("/metrics").text
    assert "quadlift_skew_seconds_count" in text
    tools.wait_until(lambda: 'quadlift_ingest_connections{site="demo"} 0.0' in client.get("/metrics").text)


def test_one_connection_may_bring_all_cameras(client: Any, tools: Any) -> None:
    with client.stream() as stream, open_ingest(client) as socket:
        join(socket, stream, tools.jpeg(), time.time_ns())


def test_a_camera_that_stays_away_is_missing_and_one_that_sends_rubbish_is_bad(client: Any, tools: Any) -> None:
    with client.stream() as stream, open_ingest(client) as socket:
        start = time.time_ns()
        socket.send(message("north", start, tools.jpeg()))
        assert receive(stream).cameras["east"].status == "missing"
        socket.send(message("east", start + 90_000_000, tools.jpeg()[:-40]))
        assert error_of(socket)["field"] == "east"
        socket.send(message("north", start + 100_000_000, tools.jpeg()))
        bad = receive(stream).cameras["east"]
        assert (bad.status, bad.skew_ms) == ("bad", pytest.approx(-10.0))
        assert bad.message is not None
        assert "truncated" in bad.message
    assert drops(client) == {"frame_refused": 1}


def test_of_refused_frames_in_a_row_one_is_logged_with_its_camera(
    client: Any, tools: Any, caplog: pytest.LogCaptureFixture
) -> None:
    with open_ingest(client) as socket:
        for data in (b"rubbish", b"rubbish", tools.jpeg(), b"rubbish"):
            socket.send(message("east", time.time_ns(), data))
        socket.send(b"?")
        for _ in range(4):
            error_of(socket)
    lines = [record for record in caplog.records if "refused" in record.getMessage()]
    assert [(record.site, record.camera) for record in lines] == [("demo", "east")] * 2  # type: ignore[attr-defined]
    assert drops(client)["frame_refused"] == 4


def test_a_late_frame_stands_in_as_stale(start: Callable[..., Any], tools: Any) -> None:
    client = start(sync_stale_ms=150, sync_clock_ms=60_000)
    with client.stream() as stream, open_ingest(client) as socket:
        begin = time.time_ns()
        join(socket, stream, tools.jpeg(), begin)
        later = begin + 1_500_000_000
        socket.send(message("north", later, tools.jpeg()))
        assert receive(stream).cameras["east"].status == "missing"
        socket.send(message("east", later + 1_000_000, tools.jpeg()))
        socket.send(message("north", later + 100_000_000, tools.jpeg()))
        stale = receive(stream)
        assert stale.cameras["east"].status == "stale"
        assert stale.cameras["east"].skew_ms == pytest.approx(-99.0)
        assert stale.degraded


def test_cameras_join_and_leave_while_the_site_runs(client: Any, tools: Any) -> None:
    with client.stream() as stream, open_ingest(client) as socket:
        begin = time.time_ns()
        socket.send(message("west", begin, tools.jpeg()))
        assert error_of(socket)["code"] == "not_found"
        assert client.put("/sites/demo/cameras/west", json=tools.camera_document("west")).status_code == 201
        socket.send(message("west", begin + 50_000_000, tools.jpeg()))
        assert receive(stream).cameras["west"].status == "ok"
        assert client.delete("/sites/demo/cameras/west").status_code == 204
        socket.send(message("west", begin + 100_000_000, tools.jpeg()))
        assert error_of(socket)["code"] == "not_found"


@pytest.mark.parametrize(
    ("wrong", "code"),
    [("text", "invalid_input"), (b"", "invalid_input"), (b"\xff" * 9, "too_large"), (b"\0" * 9, "invalid_input")],
)
def test_errors_are_answered_and_the_connection_goes_on(client: Any, tools: Any, wrong: str | bytes, code: str) -> None:
    with client.stream() as stream, open_ingest(client) as socket:
        socket.send(wrong)
        assert error_of(socket)["code"] == code
        socket.send(message("north", time.time_ns(), tools.jpeg()))
        assert receive(stream).cameras["north"].status == "ok"


def test_a_sender_of_nothing_but_errors_is_cut(start: Callable[..., Any]) -> None:
    client = start(ingest_max_errors=3)
    with open_ingest(client) as socket:
        for _ in range(3):
            socket.send("x")
            assert error_of(socket)["code"] == "invalid_input"
        with pytest.raises(ConnectionClosed) as caught:
            socket.recv(timeout=5)
        assert caught.value.rcvd is not None
        assert caught.value.rcvd.code == 1008
    assert drops(client) == {"frame_refused": 3}


def test_a_sender_that_was_cut_and_sends_on_is_not_read_any_more(start: Callable[..., Any], tools: Any) -> None:
    """It reads nothing, and so does not learn that it should go: its connection fills up until it is broken off."""
    client = start(ingest_max_errors=1)
    small_text = b"\x81\x81\0\0\0\0x"
    with tools.open_and_never_read(client.address, "/ingest/demo") as stranger:
        stranger.settimeout(1.0)
        with pytest.raises(TimeoutError):
            stranger.sendall(10_000_000 * small_text)
        assert client.get("/health/live").status_code == 200
    assert drops(client) == {"frame_refused": 1}


def test_messages_that_come_before_the_handshake_is_answered_wait_for_it(
    client: Any, tools: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    accept = WebSocket.accept

    async def accept_late(websocket: WebSocket) -> None:
        await asyncio.sleep(0.3)
        await accept(websocket)

    monkeypatch.setattr(WebSocket, "accept", accept_late)
    monkeypatch.setattr(ingest, "_PAUSE_S", 0.0)
    with tools.ask_for_websocket(client.address, "/ingest/demo") as hasty:
        time.sleep(0.1)
        hasty.sendall(3 * b"\x81\x81\0\0\0\0x")
        answer = b""
        while answer.count(b"Send binary messages") < 3:
            part = hasty.recv(4096)
            assert part, answer
            answer += part
    assert answer.startswith(b"HTTP/1.1 101")
    assert not [record for record in caplog.records if record.exc_info]


def test_a_sender_of_rubbish_is_read_slowly_and_one_broken_frame_costs_nothing(
    client: Any, tools: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ingest, "_PAUSE_S", 0.1)
    monkeypatch.setattr(ingest, "_MAX_PAUSE_S", 60.0)
    with open_ingest(client) as socket:
        began = time.monotonic()
        for data in (b"rubbish", b"rubbish", b"rubbish", b"rubbish"):
            socket.send(message("east", time.time_ns(), data))
            error_of(socket)
        # 0.1 s after the second, 0.2 s after the third; what comes after the fourth is not waited for.
        assert time.monotonic() - began >= 0.3
    monkeypatch.setattr(ingest, "_PAUSE_S", 60.0)
    with open_ingest(client) as socket:
        for data in (b"rubbish", tools.jpeg(), b"rubbish", tools.jpeg(), b"rubbish"):
            socket.send(message("east", time.time_ns(), data))
        for _ in range(3):
            error_of(socket)


def test_a_slow_sender_is_cut(start: Callable[..., Any], tools: Any) -> None:
    """Bytes of a message that never ends do not count as a message."""
    client = start(ingest_receive_s=0.3)
    with open_ingest(client) as socket:
        began = time.monotonic()
        socket.socket.sendall(b"\x82\xff\0\0\0\0\0\x01\0\0\0\0\0\0" + b"x" * 10)
        assert "within 0.3 s" in error_of(socket)["message"]
        tools.wait_until(lambda: 'quadlift_ingest_connections{site="demo"} 0.0' in client.get("/metrics").text)
        assert time.monotonic() - began < 3


def test_connections_are_limited(start: Callable[..., Any]) -> None:
    client = start(ingest_max_connections=1)
    with open_ingest(client), pytest.raises(InvalidStatus) as caught:
        open_ingest(client)
    assert caught.value.response.status_code == 503


def test_an_unknown_site_is_refused(client: Any) -> None:
    with pytest.raises(InvalidStatus) as caught:
        open_ingest(client, "nowhere")
    assert caught.value.response.status_code == 404


def test_before_it_is_ready_the_service_refuses(start: Callable[..., Any], pipeline: Any) -> None:
    pipeline.warm.clear()
    with pytest.raises(InvalidStatus) as caught:
        open_ingest(start(ready=False))
    assert caught.value.response.status_code == 503


def test_deleting_the_site_ends_the_connection(client: Any, tools: Any) -> None:
    with open_ingest(client) as socket:
        socket.send(message("north", time.time_ns(), tools.jpeg()))
        tools.wait_until(lambda: "quadlift_ingest_connections" in client.get("/metrics").text)
        assert client.delete("/sites/demo").status_code == 204
        assert client.put("/sites/demo", json=tools.site_body()).status_code == 201
        socket.send(message("north", time.time_ns(), tools.jpeg()))
        assert error_of(socket)["field"] == "site"
        with pytest.raises(ConnectionClosed):
            socket.recv(timeout=5)


def test_under_overload_the_newest_set_wins_and_every_frame_is_counted(client: Any, pipeline: Any, tools: Any) -> None:
    """While the networks are held, sets go by; when they go on, the newest is run."""
    begin = 1_800_000_000 * 10**9
    gates = [pipeline.gates.setdefault(begin + i * 100_000_000, threading.Event()) for i in range(3)]
    with client.stream() as stream, open_ingest(client) as socket:
        for i in range(3):
            socket.send(message("north", begin + i * 100_000_000, tools.jpeg()))
        tools.wait_until(lambda: pipeline.runs == 2)
        for i in range(3, 10):
            socket.send(message("north", begin + i * 100_000_000, tools.jpeg()))
        tools.wait_until(lambda: drops(client).get("superseded") == 7)
        for gate in gates:
            gate.set()
        got = receive(stream)
        while got.sequence != 10:
            got = receive(stream)
    assert pipeline.runs == 3
    assert drops(client)["superseded"] == 7


def test_networks_that_fail_on_a_set_fail_on_it_alone(client: Any, pipeline: Any, tools: Any) -> None:
    with client.stream() as stream, open_ingest(client) as socket:
        pipeline.failure = RuntimeError("a network raised")
        socket.send(message("north", time.time_ns(), tools.jpeg()))
        tools.wait_until(lambda: drops(client) == {"failed": 1})
        pipeline.failure = None
        socket.send(message("north", time.time_ns(), tools.jpeg()))
        assert receive(stream).cameras["north"].status == "ok"
