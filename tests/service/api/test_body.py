"""Bodies that are too many or too long, and forms that are none."""

from __future__ import annotations

import asyncio
import logging

import pytest
from starlette.requests import Request
from starlette.types import Message

from service.api.body import BodyRoom, parse_multipart, read_body
from service.errors import InputError, OverloadError, TooLargeError


def test_broken_forms_leave_no_line_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO), pytest.raises(InputError, match="not a multipart form"):
        parse_multipart(b"--b\r\nno header\r\n\r\n", "multipart/form-data; boundary=b", 4)
    assert caplog.records == []


def posted(*chunks: bytes) -> Request:
    """A request whose body comes in chunks."""
    coming = iter(chunks)
    left = len(chunks)

    async def receive() -> Message:
        nonlocal left
        left -= 1
        return {"type": "http.request", "body": next(coming), "more_body": left > 0}

    return Request({"type": "http", "method": "POST", "headers": []}, receive)


async def received(room: BodyRoom, *chunks: bytes) -> bytes:
    return await read_body(posted(*chunks), 100, 1.0, room)


def test_bodies_under_way_share_one_room() -> None:
    room = BodyRoom(150)
    room.take(90)
    with pytest.raises(OverloadError, match="120 bytes"):
        asyncio.run(received(room, b"a" * 30, b"b" * 40))
    assert room.held_bytes == 90
    assert asyncio.run(received(room, b"a" * 30, b"b" * 20)) == b"a" * 30 + b"b" * 20
    room.give(90)
    assert asyncio.run(received(room, b"a" * 60, b"b" * 40)) == b"a" * 60 + b"b" * 40
    assert room.held_bytes == 0


def test_a_body_that_is_too_long_gives_its_room_back() -> None:
    room = BodyRoom(1000)
    with pytest.raises(TooLargeError):
        asyncio.run(received(room, b"a" * 60, b"b" * 60))
    assert room.held_bytes == 0
