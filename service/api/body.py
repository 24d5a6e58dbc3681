"""Request bodies: limited while they arrive, parsed off the event loop."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.requests import Request

from service.errors import InputError, OverloadError, SlowSenderError, TooLargeError

# It warns of every form that is none; the answer says so already, and no stranger must be able to fill the log.
logging.getLogger("python_multipart").setLevel(logging.ERROR)

_PIECE_BYTES = 2**18
_FORM_REMEDY = "Send multipart/form-data with one file part a camera, for example: curl -F north=@north.jpg."


@dataclass(frozen=True, eq=False)
class Part:
    """One part of a multipart form."""

    name: str
    is_file: bool
    """Whether the part has a file name."""
    data: bytes


@dataclass(eq=False)
class _Body:
    """A body on its way in."""

    pieces: list[bytearray] = field(default_factory=list)
    """Of up to ``_PIECE_BYTES``: one block that grows for as long as bytes come would be moved from place to place, and leave
    holes as large as itself."""
    size: int = 0
    is_cut: bool = False
    """It had to make room: its bytes are gone, and its sender is told with the next ones."""

    def append(self, chunk: bytes) -> None:
        """More bytes; however few, they share a piece."""
        if not self.pieces or len(self.pieces[-1]) + len(chunk) > _PIECE_BYTES:
            self.pieces.append(bytearray())
        self.pieces[-1] += chunk
        self.size += len(chunk)

    def cut(self) -> None:
        """Let the bytes go."""
        self.pieces, self.size, self.is_cut = [], 0, True


class BodyRoom:
    """Memory for the bodies that are being received, of all requests together. Belongs to one event loop.

    When it is full, the longest body makes room for shorter ones: whoever sends without an end cuts off nobody but itself.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._bodies: set[_Body] = set()

    @property
    def held_bytes(self) -> int:
        """What all bodies take now."""
        return sum(body.size for body in self._bodies)

    @contextmanager
    def receiving(self) -> Iterator[_Body]:
        """A place for one body, for as long as the block runs."""
        body = _Body()
        self._bodies.add(body)
        try:
            yield body
        finally:
            self._bodies.remove(body)

    def add(self, body: _Body, chunk: bytes) -> None:
        """More bytes of a body. Raises OverloadError when it is the one that has to make room."""
        while not body.is_cut and self.held_bytes + len(chunk) > self._max_bytes:
            longest = max(self._bodies, key=lambda other: other.size)
            if longest.size <= body.size + len(chunk):
                longest = body
            longest.cut()
        self._require_kept(body)
        body.append(chunk)

    def whole(self, body: _Body) -> bytes:
        """A body that has come to its end. Raises OverloadError when it had to make room meanwhile."""
        self._require_kept(body)
        return b"".join(body.pieces)

    def _require_kept(self, body: _Body) -> None:
        if body.is_cut:
            raise OverloadError(
                f"all bodies under way may take {self._max_bytes} bytes together, and this one was the longest.",
                remedy="Send fewer bodies at a time, or raise QUADLIFT_MAX_BODIES_BYTES.",
            )


async def read_body(request: Request, max_bytes: int, limit_s: float, room: BodyRoom) -> bytes:
    """The request's body.

    Raises TooLargeError as soon as it is, or announces to be, longer than ``max_bytes``; SlowSenderError when it has not come
    after ``limit_s`` seconds; OverloadError when there is no room for it.
    """
    announced = request.headers.get("content-length", "")
    if announced.isdecimal() and int(announced) > max_bytes:
        raise _too_long(f"{announced} bytes announced", max_bytes)
    with room.receiving() as body:
        try:
            async with asyncio.timeout(limit_s):
                async for chunk in request.stream():
                    if body.size + len(chunk) > max_bytes:
                        raise _too_long("more bytes", max_bytes)
                    room.add(body, chunk)
        except TimeoutError:
            raise SlowSenderError(
                f"{body.size} bytes came within {limit_s:g} s, and not the end.",
                field="body",
                remedy="Send faster, compress the frames more, or raise QUADLIFT_BODY_RECEIVE_S.",
            ) from None
        return room.whole(body)


def parse_json(body: bytes) -> Any:
    """A JSON document; NaN and Infinity are read as such, so that validation can name their place. Raises InputError."""
    try:
        return json.loads(body)
    except (ValueError, RecursionError) as error:
        raise InputError(f"not JSON: {str(error)[:200]}.", field="body", remedy="Send a JSON document.") from None


def parse_multipart(body: bytes, content_type: str | None, max_parts: int) -> list[Part]:
    """The parts of a ``multipart/form-data`` body, in order. Raises InputError, TooLargeError."""
    kind, options = parse_options_header(content_type)
    boundary = options.get(b"boundary")
    if kind != b"multipart/form-data" or not boundary:
        raise InputError(f"the body is of type {(content_type or 'none')[:80]!r}.", field="Content-Type", remedy=_FORM_REMEDY)
    collector = _Collector(body, max_parts)
    try:
        parser = MultipartParser(
            boundary,
            {
                "on_part_begin": collector.begin,
                "on_header_field": collector.header_name,
                "on_header_value": collector.header_value,
                "on_header_end": collector.header_end,
                "on_part_data": collector.data,
                "on_part_end": collector.end,
                "on_end": collector.finish,
            },
        )
        parser.write(body)
        parser.finalize()
    except FormParserError as error:
        raise InputError(f"not a multipart form: {error}.", field="body", remedy=_FORM_REMEDY) from None
    if not collector.finished:
        raise InputError(
            f"the multipart form of {len(body)} bytes ends before its closing boundary.", field="body", remedy=_FORM_REMEDY
        )
    return collector.parts


class _Collector:
    """Callbacks of the multipart parser: they give slices of the body, and end up as parts."""

    def __init__(self, body: bytes, max_parts: int) -> None:
        self.parts: list[Part] = []
        self.finished = False
        self._max_parts = max_parts
        self._chunks: list[bytes] = []
        self._header: list[bytes] = [b"", b""]
        self._disposition: bytes = b""

    def begin(self) -> None:
        if len(self.parts) >= self._max_parts:
            raise TooLargeError(f"more than {self._max_parts} parts.", field="body", remedy="Send at most one frame a camera.")
        self._chunks, self._disposition = [], b""

    def header_name(self, data: bytes, start: int, end: int) -> None:
        self._header[0] += data[start:end]

    def header_value(self, data: bytes, start: int, end: int) -> None:
        self._header[1] += data[start:end]

    def header_end(self) -> None:
        if self._header[0].lower() == b"content-disposition":
            self._disposition = self._header[1]
        self._header = [b"", b""]

    def data(self, data: bytes, start: int, end: int) -> None:
        self._chunks.append(data[start:end])

    def end(self) -> None:
        _, options = parse_options_header(self._disposition)
        name = options.get(b"name", b"").decode("utf-8", "replace")
        if not name:
            raise InputError(f"part {len(self.parts) + 1} has no name.", field="body", remedy=_FORM_REMEDY)
        self.parts.append(Part(name, b"filename" in options, b"".join(self._chunks)))

    def finish(self) -> None:
        self.finished = True


def _too_long(what: str, max_bytes: int) -> TooLargeError:
    return TooLargeError(
        f"{what}; a body may have {max_bytes}.",
        field="body",
        remedy="Compress the frames more, or raise QUADLIFT_MAX_BODY_BYTES.",
    )
