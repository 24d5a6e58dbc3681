"""WS /stream: messages only while somebody reads, newest wins, slow readers delay nobody, tracks in capture order."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import msgpack
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from service.api.live import Reader
from service.api.messages import Encoded
from service.geometry.boxes import Boxes
from service.schemas import Detections, rfc3339_from_ns
from service.telemetry import Telemetry


def at(seconds: float) -> dict[str, str]:
    return {"captured_at": rfc3339_from_ns(round(seconds * 1e9))}


def receive(stream: Any) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(stream.recv(timeout=5))
    return document


def readers(client: Any) -> str:
    text: str = client.get("/metrics").text
    return text


def test_readers_get_the_posted_message_with_tracks(client: Any, tools: Any) -> None:
    with client.stream() as stream, client.stream("/stream/demo?format=msgpack") as packed:
        posted = [tools.detect(client, data=at(100 + 0.1 * i)).json() for i in range(2)]
        got = [receive(stream)]
        if got[0]["sequence"] == 1:
            got.append(receive(stream))
        assert got[-1] == posted[1]
        binary = packed.recv(timeout=5)
        assert isinstance(binary, bytes)
        document = msgpack.unpackb(binary)
        assert document == posted[document["sequence"] - 1]
        Detections.model_validate(document)
    ids = [document["boxes"][0]["track_id"] for document in posted]
    assert ids[0] is not None
    assert ids[0] == ids[1]
    assert len(posted[1]["boxes"][0]["velocity"]) == 3
    assert posted[1]["timing_ms"]["track"] > 0


def test_tracks_end_with_the_last_reader(client: Any, tools: Any) -> None:
    with client.stream():
        assert tools.detect(client).json()["boxes"][0]["track_id"] is not None
    tools.wait_until(lambda: 'quadlift_stream_readers{site="demo"} 0.0' in readers(client))
    assert tools.detect(client).json()["boxes"][0]["track_id"] is None


def test_per_camera_boxes_are_not_published(client: Any, tools: Any) -> None:
    with client.stream() as stream:
        assert "per_camera" in tools.detect(client, per_camera="true").json()
        assert "per_camera" not in receive(stream)


def test_late_sets_are_answered_but_not_tracked(client: Any, tools: Any) -> None:
    with client.stream() as stream:
        first = tools.detect(client, data=at(100)).json()
        assert receive(stream) == first
        late = tools.detect(client, data=at(99.9)).json()
        assert late["boxes"][0]["track_id"] is None
        after = tools.detect(client, data=at(100.1)).json()
        assert receive(stream) == after
        assert after["boxes"][0]["track_id"] == first["boxes"][0]["track_id"]
    assert 'quadlift_dropped_total{reason="late"} 1.0' in readers(client)


def test_a_recording_that_begins_again_begins_new_tracks(client: Any, tools: Any) -> None:
    with client.stream() as stream:
        tools.detect(client, data=at(100))
        receive(stream)
        again = tools.detect(client, data=at(50)).json()
        assert receive(stream) == again
        assert again["boxes"][0]["track_id"] is not None


def test_sets_finished_out_of_order_are_published_in_order(client: Any, pipeline: Any, tools: Any) -> None:
    gate = pipeline.gates.setdefault(100 * 10**9, threading.Event())
    with client.stream() as stream, ThreadPoolExecutor(2) as pool:
        earlier = pool.submit(tools.detect, client, data=at(100))
        tools.wait_until(lambda: pipeline.runs == 1)
        later = pool.submit(tools.detect, client, data=at(100.1))
        tools.wait_until(lambda: pipeline.runs == 2)
        with pytest.raises(TimeoutError):
            stream.recv(timeout=0.1)
        gate.set()
        answers = [earlier.result(5).json(), later.result(5).json()]
        assert [a["boxes"][0]["track_id"] for a in answers] == ["1", "1"]
        published = [receive(stream)]
        if published[0] == answers[0]:
            published.append(receive(stream))
        assert published[-1] == answers[1]


def test_a_reader_that_never_reads_delays_nobody(client: Any, pipeline: Any, tools: Any) -> None:
    """Its buffers are filled with large messages; posts and the quick reader go on, and what it misses is counted."""
    pipeline.boxes = Boxes.concatenate([tools.one_box(float(i)) for i in range(400)])
    with tools.open_and_never_read(client.address), client.stream() as quick:
        drops = client.app.state.service.telemetry.drops
        for i in range(100):
            posted = tools.detect(client, data=at(100 + 0.1 * i)).json()
            while receive(quick)["sequence"] != posted["sequence"]:
                pass
            if drops()["slow_reader"] >= 3:
                break
        assert drops()["slow_reader"] >= 3


def test_a_stalled_reader_is_cut_and_the_others_go_on(start: Callable[..., Any], pipeline: Any, tools: Any) -> None:
    client = start(reader_stall_s=0.2)
    pipeline.boxes = Boxes.concatenate([tools.one_box(float(i)) for i in range(400)])
    drops = client.app.state.service.telemetry.drops
    with tools.open_and_never_read(client.address) as raw, client.stream() as quick:
        for i in range(100):
            posted = tools.detect(client, data=at(100 + 0.1 * i)).json()
            while receive(quick)["sequence"] != posted["sequence"]:
                pass
            if drops()["stalled_reader"]:
                break
        tools.wait_until(lambda: 'quadlift_stream_readers{site="demo"} 1.0' in client.get("/metrics").text)
        with pytest.raises(ConnectionResetError):
            _ = [raw.recv(1 << 16) for _ in range(1000)]
    assert drops()["stalled_reader"] == 1


def test_the_newest_message_wins() -> None:
    async def scenario() -> tuple[Any, Any, dict[str, int]]:
        telemetry = Telemetry()
        reader = Reader("json", telemetry)
        for text in (b"1", b"2", b"3"):
            reader.offer(Encoded(text, None))
        newest = await reader.take()
        reader.close("over")
        return newest, await reader.take(), telemetry.drops()

    newest, end, drops = asyncio.run(scenario())
    assert newest.json == b"3"
    assert end is None
    assert drops["slow_reader"] == 2


@pytest.mark.parametrize(
    ("path", "status", "field"), [("/stream/nowhere", 404, "site"), ("/stream/demo?format=xml", 422, "format")]
)
def test_refusals_have_the_error_form(client: Any, path: str, status: int, field: str) -> None:
    with pytest.raises(InvalidStatus) as caught:
        client.stream(path)
    assert caught.value.response.status_code == status
    assert json.loads(caught.value.response.body)["error"]["field"] == field


def test_readers_are_limited(start: Callable[..., Any]) -> None:
    client = start(max_readers=1)
    with client.stream(), pytest.raises(InvalidStatus) as caught:
        client.stream()
    assert caught.value.response.status_code == 503
    assert caught.value.response.headers["retry-after"]


def test_deleting_a_site_ends_its_streams(client: Any) -> None:
    with client.stream() as stream:
        assert client.delete("/sites/demo").status_code == 204
        with pytest.raises(ConnectionClosed) as caught:
            stream.recv(timeout=5)
        assert caught.value.rcvd is not None
        assert caught.value.rcvd.code == 1001
    assert 'site="demo"' not in readers(client)
