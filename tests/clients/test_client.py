from __future__ import annotations

import asyncio
import inspect
import threading
from datetime import UTC, datetime, timedelta, timezone
from typing import Any

import httpx
import pytest

from clients.client import AsyncClient, Client, ServiceError, Timeouts
from service.schemas import Detections

MOMENT = datetime(2026, 11, 22, 1, 2, 3, 40_000, UTC)


@pytest.fixture
def client(service_url: str, site_document: dict[str, Any]) -> Any:
    with Client(service_url) as client:
        client.put_site(site_document)
        yield client


def canned(status: int, body: bytes, headers: dict[str, str] | None = None) -> Client:
    """A client of a service that always gives this answer."""
    return Client("http://test", transport=httpx.MockTransport(lambda _: httpx.Response(status, content=body, headers=headers)))


def test_detect_gives_a_typed_message(client: Client, frames: dict[str, bytes]) -> None:
    message = client.detect("demo", frames, MOMENT)
    assert isinstance(message, Detections)
    assert message.captured_at == "2026-11-22T01:02:03.040Z"
    assert message.boxes[0].center == [10.0, 5.0, 0.75]
    assert message.boxes[0].cameras == ["north", "east"]
    assert message.per_camera is None
    assert not message.degraded


def test_detect_with_fewer_cameras_and_own_boxes(client: Client, frames: dict[str, bytes]) -> None:
    message = client.detect("demo", {"north": frames["north"]}, per_camera=True)
    assert message.degraded
    assert message.cameras["east"].status == "missing"
    assert message.per_camera is not None
    assert set(message.per_camera) == {"north"}


def test_each_camera_may_have_its_own_time(client: Client, frames: dict[str, bytes]) -> None:
    later = (MOMENT + timedelta(milliseconds=3)).astimezone(timezone(timedelta(hours=2)))
    message = client.detect("demo", frames, {"north": MOMENT, "east": later})
    assert message.captured_at == "2026-11-22T01:02:03.040Z"
    assert message.cameras["east"].skew_ms == pytest.approx(3.0)


def test_a_time_without_a_zone_is_refused_before_anything_is_sent(frames: dict[str, bytes]) -> None:
    with pytest.raises(ValueError, match="time zone"):
        Client("http://test").detect("demo", frames, datetime(2026, 1, 1))


def test_sites_come_and_go(client: Client, site_document: dict[str, Any]) -> None:
    kept = client.get_site("demo")
    assert [camera["id"] for camera in kept["cameras"]] == ["north", "east"]
    assert client.put_site({**site_document, "id": "other"})["id"] == "other"
    client.delete_site("other")
    with pytest.raises(ServiceError) as caught:
        client.get_site("other")
    assert (caught.value.status, caught.value.code) == (404, "not_found")


def test_an_error_carries_field_message_and_remedy(client: Client, frames: dict[str, bytes]) -> None:
    with pytest.raises(ServiceError) as caught:
        client.detect("demo", {"north": b"no image", "east": frames["east"]})
    error = caught.value
    assert (error.status, error.code, error.field) == (422, "invalid_frame", "north")
    assert error.message
    assert error.remedy
    assert error.message in str(error)
    assert error.remedy in str(error)


def test_a_busy_service_says_when_to_come_back() -> None:
    body = b'{"error": {"code": "overloaded", "message": "busy.", "field": null, "remedy": null}}'
    with pytest.raises(ServiceError) as caught, canned(503, body, {"Retry-After": "2"}) as client:
        client.get_site("demo")
    assert (caught.value.status, caught.value.code, caught.value.retry_after_s) == (503, "overloaded", 2)


@pytest.mark.parametrize("body", [b"<html>Bad gateway</html>", b"", b'{"detail": "no"}', b"\xff"])
def test_an_answer_from_something_else_is_still_a_service_error(body: bytes) -> None:
    with pytest.raises(ServiceError) as caught, canned(502, body) as client:
        client.get_site("demo")
    assert (caught.value.status, caught.value.code) == (502, "unknown")


def test_nobody_listening_is_a_service_error() -> None:
    with Client("http://127.0.0.1:9", Timeouts(connect_s=1)) as client:
        with pytest.raises(ServiceError, match="Is the service running") as caught:
            client.get_site("demo")
        with pytest.raises(ServiceError) as caught_in_stream:
            next(client.stream("demo"))
    assert (caught.value.code, caught.value.status) == ("unreachable", None)
    assert caught_in_stream.value.code == "unreachable"


def test_an_answer_that_takes_too_long_is_a_service_error() -> None:
    def never(request: httpx.Request) -> httpx.Response:
        raise httpx.ReadTimeout("timed out", request=request)

    with Client("http://test", transport=httpx.MockTransport(never)) as client, pytest.raises(ServiceError, match="timed out"):
        client.get_site("demo")


def test_the_stream_gives_what_is_posted_with_tracks(client: Client, service_url: str, frames: dict[str, bytes]) -> None:
    posting = threading.Event()

    def post() -> None:
        with Client(service_url) as other:
            number = 0
            while not posting.wait(0.02):
                number += 1
                other.detect("demo", frames, MOMENT + timedelta(seconds=number / 10))

    thread = threading.Thread(target=post)
    thread.start()
    try:
        stream = client.stream("demo")
        messages = [next(stream) for _ in range(3)]
        stream.close()  # type: ignore[attr-defined]
    finally:
        posting.set()
        thread.join(10)
    assert [m.sequence for m in messages] == sorted({m.sequence for m in messages})
    assert messages[-1].boxes[0].track_id is not None
    assert messages[-1].boxes[0].velocity is not None


def test_the_stream_of_an_unknown_site_is_refused_with_the_services_words(service_url: str) -> None:
    with Client(service_url) as client, pytest.raises(ServiceError) as caught:
        next(client.stream("nowhere"))
    assert (caught.value.status, caught.value.code) == (404, "not_found")


def test_the_stream_ends_when_the_site_goes(client: Client, service_url: str, frames: dict[str, bytes]) -> None:
    seen: list[Detections] = []

    def post_and_delete() -> None:
        with Client(service_url) as other:
            for number in range(50):
                other.detect("demo", frames, MOMENT + timedelta(seconds=number / 10))
                if seen:
                    break
                threading.Event().wait(0.02)
            other.delete_site("demo")

    thread = threading.Thread(target=post_and_delete)
    thread.start()
    for message in client.stream("demo"):
        seen.append(message)
    thread.join(10)
    assert seen


def test_the_async_client_does_the_same(service_url: str, site_document: dict[str, Any], frames: dict[str, bytes]) -> None:
    async def use() -> tuple[Detections, Detections, ServiceError]:
        async with AsyncClient(service_url) as client:
            await client.put_site(site_document)
            assert (await client.get_site("demo"))["id"] == "demo"
            posted = await client.detect("demo", frames, MOMENT)
            stream = client.stream("demo")
            waiting = asyncio.ensure_future(anext(stream))
            number = 0
            while not waiting.done():
                number += 1
                await client.detect("demo", frames, MOMENT + timedelta(seconds=number / 10))
            streamed = waiting.result()
            await stream.aclose()  # type: ignore[attr-defined]
            await client.delete_site("demo")
            with pytest.raises(ServiceError) as caught:
                await client.detect("demo", frames)
            return posted, streamed, caught.value

    posted, streamed, error = asyncio.run(use())
    assert posted.boxes[0].center == streamed.boxes[0].center
    assert error.code == "not_found"


def test_both_clients_have_the_same_methods() -> None:
    def methods(kind: type) -> dict[str, list[str]]:
        found = inspect.getmembers(kind, inspect.isfunction)
        return {name: list(inspect.signature(f).parameters) for name, f in found if not name.startswith("_")}

    sync, asynchronous = methods(Client), methods(AsyncClient)
    assert sync.pop("close") == asynchronous.pop("aclose")
    assert sync == asynchronous
