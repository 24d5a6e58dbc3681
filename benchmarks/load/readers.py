"""A hundred readers of one stream, then one of them stalls: what the others notice, and when it is cut."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import os
import re
import socket
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any
from urllib.parse import urlsplit

import httpx
import numpy as np
import websockets.asyncio.client
from websockets.exceptions import WebSocketException

from benchmarks.load.target_service import Target, read_counters, serving
from clients.client import MAX_MESSAGE_BYTES, socket_url
from clients.clip import Clip, open_clip
from clients.ingest import IngestClient
from service.schemas import ns_from_rfc3339

ROUNDS = 4
"""Times that all read and that one stalls, in turns, so that a drifting machine treats both alike."""
SETTLE_S = 1.0
"""After a change, before latencies count."""
MAX_GROWTH = 1.05
"""Of the others' p99."""
CUT_WITHIN_S = 5.0
_RECEIVE_BUFFER = 4096
_POLL_S = 0.25
_CAPTURED_AT = re.compile(rb'"captured_at":"([^"]+)"')


class Readers:
    """Stream readers that note how old each message is, from its capture, which is when it was sent, to its arrival."""

    def __init__(self, url: str, site: str) -> None:
        self.latencies_ms: list[float] = []
        self._address = socket_url(url, "stream", site)
        self._tasks: list[asyncio.Task[None]] = []
        self.joined = 0
        self.lost = 0
        """Readers whose connection ended."""

    async def join(self, count: int) -> None:
        """Open so many readers. Raises TimeoutError when they do not get in."""
        self._tasks += [asyncio.create_task(self._read()) for _ in range(count)]
        async with asyncio.timeout(30):
            while self.joined + self.lost < count:
                await asyncio.sleep(0.05)

    async def close(self) -> None:
        """End them all."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _read(self) -> None:
        try:
            async with websockets.asyncio.client.connect(
                self._address, max_size=MAX_MESSAGE_BYTES, compression=None, open_timeout=20, close_timeout=2
            ) as connection:
                self.joined += 1
                async for message in connection:
                    self._note(message if isinstance(message, bytes) else message.encode())
            self.lost += 1
        except (OSError, WebSocketException):
            # Counted: a reader that is thrown out is a finding of the measurement.
            self.lost += 1

    def _note(self, message: bytes) -> None:
        found = _CAPTURED_AT.search(message)
        if found:
            self.latencies_ms.append((time.time_ns() - ns_from_rfc3339(found[1].decode())) / 1e6)


class StallingReader:
    """A reader on a plain socket with a small buffer: what it does not take stays with the service."""

    def __init__(self, url: str, site: str) -> None:
        parts = urlsplit(url)
        self._host, self._port, self._site = parts.hostname or "", parts.port or 80, site
        self._socket: socket.socket | None = None
        self._task: asyncio.Task[None] | None = None

    async def join(self) -> None:
        """Connect and read. Raises OSError, TimeoutError."""
        self._socket = socket.socket()
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        self._socket.setblocking(False)
        loop = asyncio.get_running_loop()
        key = base64.b64encode(os.urandom(16)).decode()
        request = (
            f"GET /stream/{self._site} HTTP/1.1\r\nHost: {self._host}:{self._port}\r\nUpgrade: websocket\r\n"
            f"Connection: Upgrade\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n"
        )
        async with asyncio.timeout(20):
            await loop.sock_connect(self._socket, (self._host, self._port))
            await loop.sock_sendall(self._socket, request.encode())
            answer = await loop.sock_recv(self._socket, _RECEIVE_BUFFER)
        if b" 101 " not in answer[:32]:
            raise OSError(f"the stream did not open: {answer[:80]!r}")
        self._task = asyncio.create_task(self._drain())

    async def stall(self) -> None:
        """Take nothing from now on."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def leave(self) -> None:
        """Break the connection."""
        await self.stall()
        if self._socket is not None:
            self._socket.close()

    async def _drain(self) -> None:
        assert self._socket is not None
        loop = asyncio.get_running_loop()
        while await loop.sock_recv(self._socket, 65536):
            pass


async def measure_readers(readers: int, rate_hz: float, seconds: float) -> dict[str, Any]:
    """The figures. Raises LocalServiceError, ServiceError, OSError, TimeoutError."""
    clip = open_clip()
    site = clip.site["id"]
    phase_s = max(3.0, seconds / (2 * ROUNDS))
    together: list[float] = []
    beside_stalled: list[float] = []
    cuts: list[float | None] = []
    async with serving(clip.site, variables={"QUADLIFT_MAX_READERS": str(2 * readers)}) as target:
        others = Readers(target.url, site)
        async with _feeding(target, clip, rate_hz) as feeding:
            try:
                await others.join(readers - 1)
                for _ in range(ROUNDS):
                    stalling = StallingReader(target.url, site)
                    await stalling.join()
                    try:
                        await asyncio.sleep(SETTLE_S)
                        # The counters are asked in both phases: that costs the service time, too.
                        watching = asyncio.create_task(_cut_after(target, site, 0, phase_s))
                        together += await _phase(others, phase_s)
                        await watching
                        await stalling.stall()
                        cut = asyncio.create_task(_cut_after(target, site, readers - others.lost, phase_s))
                        beside_stalled += await _phase(others, phase_s)
                        cuts.append(await cut)
                    finally:
                        await stalling.leave()
                if feeding.done():
                    await feeding
            finally:
                await others.close()
    return _figures(readers, rate_hz, together, beside_stalled, cuts, others.lost)


async def _phase(others: Readers, seconds: float) -> list[float]:
    others.latencies_ms = []
    await asyncio.sleep(seconds)
    return others.latencies_ms


async def _cut_after(target: Target, site: str, present: int, limit_s: float) -> float | None:
    """Seconds until the service counts one reader less; None when that does not happen in time."""
    began = time.monotonic()
    while time.monotonic() - began < limit_s:
        counters = await asyncio.to_thread(read_counters, target.url)
        if counters.total("stream_readers", site=site) < present:
            return time.monotonic() - began
        await asyncio.sleep(_POLL_S)
    return None


@asynccontextmanager
async def _feeding(target: Target, clip: Clip, rate_hz: float) -> AsyncIterator[asyncio.Task[None]]:
    """The clip over a camera stream, each frame stamped when it is sent."""

    async def feed() -> None:
        async with IngestClient(target.url, clip.site["id"]) as client:
            began = time.monotonic()
            for moment in clip.play(0):
                frames, now_ns = clip.frames(moment.step), time.time_ns()
                for camera, data in frames.items():
                    await client.send(camera, data, now_ns)
                behind = time.monotonic() - began
                began = began + 1 / rate_hz if behind < 1 / rate_hz else time.monotonic()
                await asyncio.sleep(max(0.0, began - time.monotonic()))

    task = asyncio.create_task(feed())
    try:
        yield task
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.gather(task, return_exceptions=True)


def _figures(
    readers: int, rate_hz: float, together: list[float], beside: list[float], cuts: list[float | None], lost: int
) -> dict[str, Any]:
    p99, p99_beside = (float(np.percentile(values, 99)) if values else float("nan") for values in (together, beside))
    growth = p99_beside / p99
    slowest = None if None in cuts or not cuts else max(cut for cut in cuts if cut is not None)
    return {
        "readers": readers,
        "rate_hz": rate_hz,
        "messages": len(together) + len(beside),
        "p99_ms": round(p99, 1),
        "p99_beside_stalled_ms": round(p99_beside, 1),
        "p50_ms": round(float(np.median(together)), 1) if together else None,
        "p50_beside_stalled_ms": round(float(np.median(beside)), 1) if beside else None,
        "growth": round(growth, 3),
        "max_growth": MAX_GROWTH,
        "cut_after_s": [None if cut is None else round(cut, 2) for cut in cuts],
        "cut_within_s": CUT_WITHIN_S,
        "others_lost": lost,
        "passed": growth <= MAX_GROWTH and slowest is not None and slowest <= CUT_WITHIN_S and not lost,
    }


UNREACHABLE = (OSError, TimeoutError, httpx.HTTPError)
"""What a measurement ends with when the service goes away."""
