"""A site's streams for load: frames in over WS /ingest, messages out over WS /stream, at little cost to the sender.

Messages stay bytes: a client that validates each of them would take from the machine what the service is measured by.
"""

from __future__ import annotations

import asyncio
import contextlib
import struct
import time
from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import Self

import websockets.asyncio.client
from websockets.exceptions import ConnectionClosed

from clients.client import MAX_MESSAGE_BYTES, reaching, socket_url
from service.errors import QuadliftError
from service.schemas import rfc3339_from_ns

JOIN_SETS = 100
"""Sets sent until one is complete: then the service knows all cameras."""
_JOIN_ANSWER_S = 0.125
_JOIN_PAUSE_S = 0.03
"""Above the service's tolerance between frames of one set."""
_LENGTH = struct.Struct(">I")
_COMPLETE = b'"degraded":false'


class StreamLink:
    """One connection that brings the frames of all of a site's cameras, and one that reads its messages."""

    def __init__(self, url: str, site: str) -> None:
        self._url, self._site = url, site
        self._sequence = 0
        self._open = contextlib.AsyncExitStack()
        self._listening: asyncio.Task[None] | None = None
        self.refusals: list[str] = []
        """What the service said of frames that it did not take."""

    async def __aenter__(self) -> Self:
        """Connect both. Raises ServiceError."""
        async with contextlib.AsyncExitStack() as stack:
            with reaching(self._url):
                self._stream = await stack.enter_async_context(self._connected("stream"))
                self._ingest = await stack.enter_async_context(self._connected("ingest"))
            self._listening = asyncio.create_task(self._listen())
            self._open = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._open.aclose()
        if self._listening is not None:
            await self._listening

    async def send(self, frames: Mapping[str, bytes], captured_at_ns: int) -> None:
        """Push one set, JPEG files by camera, all of one capture time. Raises ServiceError when the connection is gone."""
        captured_at = rfc3339_from_ns(captured_at_ns)
        with reaching(self._url):
            for camera, data in frames.items():
                header = f'{{"camera":"{camera}","captured_at":"{captured_at}","sequence":{self._sequence}}}'.encode()
                await self._ingest.send(b"".join((_LENGTH.pack(len(header)), header, data)))
        self._sequence += 1

    async def receive(self) -> bytes:
        """The next message. Raises ServiceError when the stream is gone."""
        with reaching(self._url):
            message = await self._stream.recv()
        return message if isinstance(message, bytes) else message.encode()

    async def join(self, sets: Iterator[Mapping[str, bytes]]) -> None:
        """Send sets until one is answered with all cameras in it. Raises ServiceError, QuadliftError."""
        for _ in range(JOIN_SETS):
            await self.send(next(sets), time.time_ns())
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_JOIN_ANSWER_S):
                    if _COMPLETE in await self.receive():
                        await asyncio.sleep(_JOIN_PAUSE_S)
                        return
            await asyncio.sleep(_JOIN_PAUSE_S)
        raise QuadliftError("the service never saw all cameras.")

    def _connected(self, room: str) -> websockets.asyncio.client.connect:
        address = socket_url(self._url, room, self._site)
        return websockets.asyncio.client.connect(address, max_size=MAX_MESSAGE_BYTES, compression=None)

    async def _listen(self) -> None:
        # Its end says nothing here: the next frame that is sent does.
        with contextlib.suppress(ConnectionClosed):
            async for text in self._ingest:
                self.refusals.append(str(text))
