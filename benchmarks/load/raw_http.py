"""Broken HTTP on plain sockets: request lines, headers, bodies, multipart forms, chunks, and bodies that never end."""

from __future__ import annotations

import asyncio
import contextlib
import re
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

from benchmarks.load.mutation import ByteMutator
from benchmarks.load.parsers import BOUNDARY, multipart_form, small_pictures

ANSWER_S = 1.0
"""A connection without an answer for this long is given up: half of the broken requests deserve none."""
CONNECT_S = 5.0
_STATUS = re.compile(rb"HTTP/1\.[01] (\d{3})")
_PIECE = b"x" * 65536
_WORDS = (
    b"\r\n", b"\n", b"\r\n\r\n", b"\x00", b"0\r\n\r\n", b"ffffffffffffffff\r\n", b"-1\r\n", b'5;ext="x"\r\n',
    b"Content-Length: 0\r\n", b"Content-Length: -1\r\n", b"Content-Length: 99999999999999\r\n",
    b"Transfer-Encoding: chunked\r\n", b"Transfer-Encoding: gzip, chunked\r\n", b"Expect: 100-continue\r\n",
    b"Connection: close\r\n", b"Upgrade: websocket\r\n", b"--" + BOUNDARY, b"X: " + b"a" * 9000 + b"\r\n", b"Host: \r\n",
    b"%00", b"%ed%a0%80", b"/../", b"?site=demo&per_camera=2", b"HTTP/0.9", b"HTTP/2.0",
)  # fmt: skip


@dataclass
class RawResult:
    """What came back."""

    cases: int = 0
    connections_refused: int = 0
    statuses: Counter[int] = field(default_factory=Counter)

    def document(self) -> dict[str, Any]:
        """JSON-ready."""
        failed = sum(count for status, count in self.statuses.items() if status >= 500 and status != 503)
        statuses = {str(status): count for status, count in sorted(self.statuses.items())}
        return {"cases": self.cases, "refused_connections": self.connections_refused, "statuses": statuses, "5xx": failed}


def seeds(host: str) -> tuple[bytes, ...]:
    """Whole requests, of which broken ones are made."""
    form = multipart_form({"north": small_pictures()[0]}, {"captured_at": b"2026-11-22T01:02:03Z"})
    kind = b"Content-Type: multipart/form-data; boundary=" + BOUNDARY + b"\r\n"
    head = b"Host: " + host.encode() + b"\r\n"
    chunks = b"".join(b"%x\r\n%s\r\n" % (len(piece), piece) for piece in (form[:50], form[50:51], form[51:])) + b"0\r\n\r\n"
    length = b"Content-Length: %d\r\n\r\n"
    detect = b"POST /detect?site=demo HTTP/1.1\r\n" + head
    site = b'{"id":"raw","cameras":[]}'
    upgrade = b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
    upgrade += b"Sec-WebSocket-Version: 13\r\n\r\n"
    return (
        detect + kind + length % len(form) + form,
        detect + kind + b"Transfer-Encoding: chunked\r\n\r\n" + chunks,
        detect + kind + b"Transfer-Encoding: chunked\r\nContent-Length: 5\r\n\r\n" + chunks,
        b"PUT /sites/raw HTTP/1.1\r\n" + head + length % len(site) + site,
        b"DELETE /sites/raw HTTP/1.1\r\n" + head + b"\r\n",
        b"GET /sites HTTP/1.1\r\n" + head + b"\r\nGET /metrics HTTP/1.1\r\n" + head + b"\r\n",
        b"GET /stream/demo HTTP/1.1\r\n" + head + upgrade + b"\x81\x85\x00\x00\x00\x00hello\x88\x80\x00\x00\x00\x00",
        b"GET /ingest/demo HTTP/1.1\r\n" + head + upgrade + b"\x82\x88\x00\x00\x00\x00\x00\x00\x00\x02{}\xff\xd8",
    )


async def fuzz_raw(url: str, seconds: float, seed: int, connections: int = 8) -> RawResult:
    """Broken requests over ``connections`` sockets at once, for a time."""
    parts = urlsplit(url)
    host, port = parts.hostname or "", parts.port or 80
    result, until = RawResult(), time.monotonic() + seconds

    async def one(number: int) -> None:
        maker = ByteMutator(seeds(f"{host}:{port}"), _WORDS, seed + number)
        while time.monotonic() < until:
            await _exchange(host, port, maker.make(), result)

    await asyncio.gather(*(one(number) for number in range(connections)))
    return result


async def endless_bodies(url: str, seconds: float, connections: int = 8) -> RawResult:
    """Forms that go on, chunk after chunk, until the service ends them; again and again for a time."""
    parts = urlsplit(url)
    host, port = parts.hostname or "", parts.port or 80
    result, until = RawResult(), time.monotonic() + seconds

    async def one() -> None:
        head = seeds(f"{host}:{port}")[1].partition(b"\r\n\r\n")[0] + b"\r\n\r\n"
        while time.monotonic() < until:
            await _endless(host, port, head, result, until)

    await asyncio.gather(*(one() for _ in range(connections)))
    return result


async def _endless(host: str, port: int, head: bytes, result: RawResult, until: float) -> None:
    connection = await _connected(host, port, result)
    if connection is None:
        return
    reader, writer = connection
    answer = asyncio.create_task(reader.read(65536))
    try:
        writer.write(head)
        while not answer.done() and time.monotonic() < until:
            writer.write(b"%x\r\n%s\r\n" % (len(_PIECE), _PIECE))
            async with asyncio.timeout(CONNECT_S):
                await writer.drain()
            # Without a pause the sender's own work would starve the service of the machine.
            await asyncio.sleep(0.002)
        if answer.done():
            result.statuses.update(int(status) for status in _STATUS.findall(await answer))
    except (OSError, TimeoutError):
        # Being cut off is what it deserves.
        pass
    finally:
        await _close(writer, answer)


async def _connected(host: str, port: int, result: RawResult) -> tuple[asyncio.StreamReader, asyncio.StreamWriter] | None:
    """A new case's connection; None, and counted, when there was none to be had."""
    result.cases += 1
    try:
        async with asyncio.timeout(CONNECT_S):
            return await asyncio.open_connection(host, port)
    except (OSError, TimeoutError):
        result.connections_refused += 1
        return None


async def _exchange(host: str, port: int, data: bytes, result: RawResult) -> None:
    connection = await _connected(host, port, result)
    if connection is None:
        return
    reader, writer = connection
    answer = bytearray()
    try:
        async with asyncio.timeout(ANSWER_S):
            writer.write(data)
            await writer.drain()
            if len(data) % 2:
                writer.write_eof()
            while piece := await reader.read(65536):
                answer += piece
                if not len(data) % 2:
                    break
    except (OSError, TimeoutError):
        # No answer, or a broken connection: what came before still counts.
        pass
    finally:
        result.statuses.update(int(status) for status in _STATUS.findall(bytes(answer)))
        await _close(writer, None)


async def _close(writer: asyncio.StreamWriter, reading: asyncio.Task[bytes] | None) -> None:
    if reading is not None:
        reading.cancel()
        await asyncio.gather(reading, return_exceptions=True)
    writer.transport.abort()
    with contextlib.suppress(OSError, TimeoutError):
        async with asyncio.timeout(ANSWER_S):
            await writer.wait_closed()
