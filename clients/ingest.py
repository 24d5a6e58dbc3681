"""Pushing camera frames to ``WS /ingest/{site}``.

async with IngestClient("http://127.0.0.1:8000", "demo") as ingest:
    await ingest.send("north", jpeg, datetime.now(UTC))
"""

from __future__ import annotations

import asyncio
import struct
from collections import Counter, deque
from datetime import datetime
from types import TracebackType
from typing import Self

import websockets.asyncio.client
from pydantic import ValidationError
from websockets.exceptions import ConnectionClosed

from clients.client import DEFAULT_URL, MAX_MESSAGE_BYTES, Timeouts, bearer, reaching, socket_url
from service.schemas import ErrorDetail, ErrorMessage, IngestHeader, rfc3339_from_ns

_LENGTH = struct.Struct(">I")
_KEPT_ERRORS = 100
_TIMEOUTS = Timeouts()
_NS = 1_000_000_000


def ingest_message(camera: str, data: bytes, captured_at_ns: int, sequence: int) -> bytes:
    """One message of the wire contract; captured_at_ns: nanoseconds since 1970 (UTC)."""
    header = IngestHeader(camera=camera, captured_at=rfc3339_from_ns(captured_at_ns), sequence=sequence)
    encoded = header.model_dump_json().encode()
    return b"".join((_LENGTH.pack(len(encoded)), encoded, data))


class IngestClient:
    """One connection that brings frames of one or more of a site's cameras. For use by one task at a time."""

    def __init__(
        self, url: str = DEFAULT_URL, site: str = "demo", timeouts: Timeouts = _TIMEOUTS, token: str | None = None
    ) -> None:
        """url: the service's root. token: where the service wants one."""
        self._headers = bearer(token)
        self._url, self._site, self._timeouts = url, site, timeouts
        self._socket: websockets.asyncio.client.ClientConnection | None = None
        self._listening: asyncio.Task[None] | None = None
        self._sequences: Counter[str] = Counter()
        self.errors: deque[ErrorDetail] = deque(maxlen=_KEPT_ERRORS)
        """The newest refusals; the service says nothing about frames that it takes."""
        self.refused = 0
        """How many refusals came."""

    async def open(self) -> None:
        """Connect. Raises ServiceError."""
        with reaching(self._url):
            self._socket = await websockets.asyncio.client.connect(
                socket_url(self._url, "ingest", self._site),
                open_timeout=self._timeouts.connect_s,
                close_timeout=self._timeouts.connect_s,
                max_size=MAX_MESSAGE_BYTES,
                compression=None,
                additional_headers=self._headers,
            )
        self._listening = asyncio.create_task(self._listen(self._socket))

    async def send(self, camera: str, data: bytes, captured_at: datetime | int) -> None:
        """Push one frame; captured_at: a time with a zone, or nanoseconds since 1970 (UTC).

        Waits while the service takes frames slower than they are sent. Raises ServiceError when the connection is gone,
        ValueError for a time without a zone.
        """
        if self._socket is None:
            raise RuntimeError("not connected: use `async with`, or call open() first")
        time_ns = captured_at if isinstance(captured_at, int) else _ns(captured_at)
        message = ingest_message(camera, data, time_ns, self._sequences[camera])
        self._sequences[camera] += 1
        with reaching(self._url):
            await self._socket.send(message)

    async def aclose(self) -> None:
        """Close the connection, when the service has taken what was sent."""
        if self._socket is not None and self._listening is not None:
            await self._socket.close()
            await self._listening
        self._socket = self._listening = None

    async def __aenter__(self) -> Self:
        await self.open()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.aclose()

    async def _listen(self, socket: websockets.asyncio.client.ClientConnection) -> None:
        try:
            async for text in socket:
                self.refused += 1
                self.errors.append(_detail(text))
        except ConnectionClosed:
            # The next send says so to the caller.
            return


def _detail(text: str | bytes) -> ErrorDetail:
    try:
        return ErrorMessage.model_validate_json(text).error
    except ValidationError:
        return ErrorDetail(code="unknown", message=f"the service said {text[:200]!r}.")


def _ns(moment: datetime) -> int:
    if moment.tzinfo is None:
        raise ValueError(f"the capture time {moment} has no time zone; for example use datetime.now(UTC)")
    seconds = int(moment.timestamp() // 1)
    return seconds * _NS + moment.microsecond * 1000
