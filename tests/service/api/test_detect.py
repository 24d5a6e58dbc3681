"""POST /detect: good frame sets, and every kind of bad one; after each the service answers the next good request."""

from __future__ import annotations

import math
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import numpy as np
import pytest

from service.geometry.boxes import Boxes
from service.schemas import Detections

FORM = {"content-type": "multipart/form-data; boundary=b"}


def test_a_whole_set(client: httpx.Client, tools: Any) -> None:
    times = {"captured_at": "2026-11-22T01:02:03.040Z", "captured_at.east": "2026-11-22T02:02:03.0431+01:00"}
    response = tools.detect(client, data=times)
    assert response.status_code == 200, response.text
    document = response.json()
    Detections.model_validate(document)
    assert document["site"] == "demo"
    assert document["captured_at"] == "2026-11-22T01:02:03.040Z"
    assert document["degraded"] is False
    assert document["cameras"]["east"] == {
        "status": "ok", "captured_at": "2026-11-22T01:02:03.043100Z", "skew_ms": 3.1, "detections": 1,
    }  # fmt: skip
    (box,) = document["boxes"]
    assert box["class"] == "car"
    assert box["track_id"] is None
    assert box["velocity"] is None
    assert box["center"] == [10.0, 5.0, 0.75]
    assert box["size"] == [4.2, 1.8, 1.5]
    assert np.shape(box["covariance"]) == (7, 7)
    assert box["cameras"] == ["north", "east"]
    assert set(document["timing_ms"]) == {"decode", "detect", "orient", "depth", "lift", "fuse", "track", "total"}
    assert "per_camera" not in document


def test_fewer_cameras_degrade_the_answer(client: httpx.Client, tools: Any) -> None:
    document = tools.detect(client, {"east": tools.png()}).json()
    assert document["degraded"] is True
    assert document["cameras"]["north"] == {"status": "missing"}
    assert document["boxes"][0]["cameras"] == ["east"]


def test_a_frame_that_breaks_in_decoding_leaves_the_others(client: httpx.Client, tools: Any) -> None:
    torn = tools.jpeg()[: len(tools.jpeg()) // 2] + b"\xff\xd9"
    document = tools.detect(client, {"north": torn, "east": tools.jpeg()}).json()
    assert document["cameras"]["north"]["status"] == "bad"
    assert "damaged" in document["cameras"]["north"]["message"]
    assert document["cameras"]["east"]["status"] == "ok"
    assert document["degraded"] is True
    error = tools.error(tools.detect(client, {"north": torn}), 422)
    assert error["field"] == "north"


def test_per_camera_boxes_on_request(client: httpx.Client, tools: Any) -> None:
    document = tools.detect(client, per_camera="true").json()
    Detections.model_validate(document)
    assert {camera: [b["cameras"] for b in boxes] for camera, boxes in document["per_camera"].items()} == {
        "north": [["north"]],
        "east": [["east"]],
    }


def test_sequences_count_up(client: httpx.Client, tools: Any) -> None:
    assert [tools.detect(client).json()["sequence"] for _ in range(3)] == [1, 2, 3]


def test_empty_scenes_and_unfinite_boxes(client: httpx.Client, pipeline: Any, tools: Any) -> None:
    bad = tools.one_box(math.nan)
    pipeline.boxes = Boxes.concatenate([bad, tools.one_box(3.0)])
    document = tools.detect(client, per_camera="true").json()
    assert [b["center"][0] for b in document["boxes"]] == [3.0]
    assert 'quadlift_dropped_total{reason="not_finite"} 1.0' in client.get("/metrics").text
    pipeline.boxes = Boxes.empty()
    document = tools.detect(client, per_camera="true").json()
    assert document["boxes"] == []
    assert document["per_camera"] == {"north": [], "east": []}


def _huge_header(data: bytes) -> bytes:
    at = next(i for i in range(len(data)) if data[i] == 0xFF and data[i + 1] == 0xC0)
    return data[: at + 5] + struct.pack(">HH", 10000, 10000) + data[at + 9 :]


@pytest.mark.parametrize(
    ("make", "status", "says"),
    [
        (lambda jpeg: b"this is no picture", 422, "74 68 69 73"),
        (lambda jpeg: jpeg()[:-20], 422, "truncated"),
        (lambda jpeg: jpeg()[:30], 422, "header"),
        (lambda jpeg: jpeg(64, 64), 422, "64x64"),
        (lambda jpeg: b"", 422, "0 bytes"),
        (lambda jpeg: _huge_header(jpeg()), 413, "10000x10000"),
    ],
    ids=["not-a-jpeg", "truncated", "cut-header", "wrong-size", "empty-part", "100-megapixel"],
)
def test_bad_frames_refuse_the_whole_set(
    client: httpx.Client, pipeline: Any, tools: Any, make: Callable[[Callable[..., bytes]], bytes], status: int, says: str
) -> None:
    error = tools.error(tools.detect(client, {"north": tools.jpeg(), "east": make(tools.jpeg)}), status)
    assert error["field"] == "east"
    assert says in error["message"]
    assert error["remedy"]
    assert pipeline.runs == 0
    assert tools.detect(client).status_code == 200


@pytest.mark.parametrize(
    ("query", "frames", "times", "status", "field"),
    [
        ({}, ["north", "west"], {}, 404, "west"),
        ({"site": "nowhere"}, ["north"], {}, 404, "site"),
        ({"site": ""}, ["north"], {}, 404, "site"),
        ({"per_camera": "perhaps"}, ["north"], {}, 422, "per_camera"),
        ({}, ["north"], {"captured_at": "yesterday"}, 422, "captured_at"),
        ({}, ["north"], {"captured_at": "2026-11-22T01:02:03"}, 422, "captured_at"),
        ({}, ["north"], {"captured_at.north": "2026-13-22T01:02:03Z"}, 422, "captured_at.north"),
        ({}, ["north"], {"captured_at.east": "2026-11-22T01:02:03Z"}, 422, "captured_at.east"),
        ({}, ["north"], {"captured_at.west": "2026-11-22T01:02:03Z"}, 404, "west"),
    ],
)
def test_bad_parts_are_named(
    client: httpx.Client, tools: Any, query: dict[str, str], frames: list[str], times: dict[str, str], status: int, field: str
) -> None:
    error = tools.error(tools.detect(client, dict.fromkeys(frames, tools.jpeg()), times, **query), status)
    assert error["field"] == field
    assert error["remedy"]
    assert tools.detect(client).status_code == 200


def test_a_missing_query_parameter(client: httpx.Client, tools: Any) -> None:
    assert tools.error(client.post("/detect"), 422)["field"] == "site"


@pytest.mark.parametrize(
    ("content", "headers", "says"),
    [
        (b"", {}, "type 'none'"),
        (b"{}", {"content-type": "application/json"}, "application/json"),
        (b"", FORM, "ends before"),
        (b"--b--\r\n", FORM, "no frame"),
        (b"garbage", FORM, "multipart"),
        (b'--b\r\nContent-Disposition: form-data; name="north"; filename="n"\r\n\r\nabc', FORM, "ends before"),
        (b'--b\r\nContent-Disposition: form-data; filename="n"\r\n\r\nabc\r\n--b--\r\n', FORM, "no name"),
        (
            b'--b\r\nContent-Disposition: form-data; name="captured_at"\r\n\r\n2026-11-22T01:02:03Z\r\n--b--\r\n',
            FORM,
            "no frame",
        ),
    ],
)
def test_bodies_that_are_no_form(client: httpx.Client, tools: Any, content: bytes, headers: dict[str, str], says: str) -> None:
    error = tools.error(client.post("/detect?site=demo", content=content, headers=headers), 422)
    assert says in error["message"]
    assert tools.detect(client).status_code == 200


def test_two_parts_of_one_camera(client: httpx.Client, tools: Any) -> None:
    files = [("north", ("a.jpg", tools.jpeg())), ("north", ("b.jpg", tools.jpeg()))]
    error = tools.error(client.post("/detect?site=demo", files=files), 422)
    assert error["field"] == "north"
    assert "two parts" in error["message"]
    many = [("north", ("a.jpg", b""))] * 50
    assert tools.error(client.post("/detect?site=demo", files=many), 413)["field"] == "body"
    assert tools.detect(client).status_code == 200


def test_a_body_over_the_limit_is_refused_while_it_arrives(start: Callable[..., httpx.Client], tools: Any) -> None:
    client = start(max_body_bytes=20_000)
    sent = 0

    def chunks() -> Iterator[bytes]:
        nonlocal sent
        for _ in range(100):
            sent += 1
            yield bytes(1000)

    error = tools.error(client.post("/detect?site=demo", content=chunks(), headers=FORM), 413)
    assert "20000" in error["message"]
    error = tools.error(client.post("/detect?site=demo", content=bytes(20_001), headers=FORM), 413)
    assert "20001 bytes announced" in error["message"]
    assert tools.detect(client).status_code == 200


def test_frame_byte_limit(start: Callable[..., httpx.Client], tools: Any) -> None:
    client = start(max_frame_bytes=1024)
    assert tools.error(tools.detect(client, {"north": bytes(2000)}), 413)["field"] == "north"


def test_overload_says_when_to_come_back(start: Callable[..., httpx.Client], pipeline: Any, tools: Any) -> None:
    client = start(queue_size=1, deadline_ms=60_000)
    gate = pipeline.gates.setdefault(1_000_000_000, threading.Event())
    old = {"captured_at": "1970-01-01T00:00:01Z"}
    answers: list[int] = []
    senders = [threading.Thread(target=lambda: answers.append(tools.detect(client, data=old).status_code)) for _ in range(3)]
    for sender in senders:
        sender.start()
    tools.wait_until(lambda: pipeline.runs == 2 and "quadlift_queued_frame_sets 1.0" in client.get("/metrics").text)
    response = tools.detect(client)
    assert tools.error(response, 503)["code"] == "overloaded"
    assert int(response.headers["retry-after"]) >= 1
    gate.set()
    for sender in senders:
        sender.join(10)
    assert answers == [200, 200, 200]
    assert tools.detect(client).status_code == 200


def test_a_failing_network_is_a_generic_500(
    client: httpx.Client, pipeline: Any, tools: Any, caplog: pytest.LogCaptureFixture
) -> None:
    pipeline.failure = RuntimeError("secret path /models")
    error = tools.error(tools.detect(client), 500)
    assert "secret" not in str(error)
    assert "secret path" in caplog.text
    pipeline.failure = None
    assert tools.detect(client).status_code == 200


def test_not_ready_is_503(start: Callable[..., httpx.Client], pipeline: Any, tools: Any) -> None:
    pipeline.warm.clear()
    client = start(ready=False)
    response = tools.detect(client)
    tools.error(response, 503)
    assert response.headers["retry-after"]


def test_a_body_that_does_not_come_is_answered_in_time(start: Callable[..., Any]) -> None:
    host, port = start(body_receive_s=0.2).address.split(":")
    with socket.create_connection((host, int(port)), timeout=5) as raw:
        raw.sendall(b"POST /detect?site=demo HTTP/1.1\r\nHost: x\r\nContent-Length: 5000\r\n\r\nslow")
        answer = raw.recv(4096)
    assert answer.startswith(b"HTTP/1.1 408 ")
    assert b"too_slow" in answer
