"""Bodies that are too many or too long, and forms that are none."""

from __future__ import annotations

import asyncio
import logging
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st
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


def test_the_longest_body_makes_room_for_others() -> None:
    room = BodyRoom(150)
    with room.receiving() as long:
        room.add(long, b"x" * 90)
        assert asyncio.run(received(room, b"a" * 30, b"b" * 30)) == b"a" * 30 + b"b" * 30
        assert room.held_bytes == 90
        assert asyncio.run(received(room, b"a" * 60, b"b" * 20)) == b"a" * 60 + b"b" * 20
        assert long.is_cut
        assert room.held_bytes == 0
        with pytest.raises(OverloadError, match="150 bytes"):
            room.add(long, b"x")
        # Also when nothing more was to come: what is gone must not pass for an empty body.
        with pytest.raises(OverloadError, match="150 bytes"):
            room.whole(long)
    assert asyncio.run(received(room, b"a" * 60, b"b" * 40)) == b"a" * 60 + b"b" * 40
    assert room.held_bytes == 0


def test_a_body_that_would_be_the_longest_is_the_one_that_goes() -> None:
    room = BodyRoom(150)
    with room.receiving() as first, room.receiving() as second:
        room.add(first, b"x" * 70)
        room.add(second, b"y" * 70)
        with pytest.raises(OverloadError):
            asyncio.run(received(room, b"a" * 90))
        assert (first.is_cut, second.is_cut, room.held_bytes) == (False, False, 140)
        room.add(first, b"x" * 10)
        with pytest.raises(OverloadError):
            room.add(first, b"x" * 10)
        assert (first.is_cut, second.is_cut, room.held_bytes) == (True, False, 70)


def test_a_body_that_is_too_long_gives_its_room_back() -> None:
    room = BodyRoom(1000)
    with pytest.raises(TooLargeError):
        asyncio.run(received(room, b"a" * 60, b"b" * 60))
    assert room.held_bytes == 0


@given(lengths=st.lists(st.sampled_from([1, 7, 65_536, 200_000, 262_144, 300_000]), min_size=1, max_size=12))
def test_a_body_is_what_was_sent_however_it_was_cut(lengths: list[int]) -> None:
    room = BodyRoom(10**7)
    chunks = [bytes([number + 1]) * length for number, length in enumerate(lengths)]
    assert asyncio.run(read_body(posted(*chunks), 10**7, 5.0, room)) == b"".join(chunks)
    assert room.held_bytes == 0


def test_the_smallest_chunks_take_no_more_room_than_large_ones() -> None:
    room = BodyRoom(10**6)
    with room.receiving() as body:
        for _ in range(100_000):
            room.add(body, b"x")
        assert room.held_bytes == 100_000
        assert sum(sys.getsizeof(piece) for piece in body.pieces) < 120_000
