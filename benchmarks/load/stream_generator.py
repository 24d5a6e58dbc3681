"""Load over a site's streams from a process of its own: the clip at a steady rate, or so many sets on their way.

The process says ``joined`` when the service knows all cameras, starts when it is given a line, and ends with its figures.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
import re
import sys
import time
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from typing import Any

import numpy as np

from benchmarks.measured import Measured
from benchmarks.stream_link import StreamLink
from benchmarks.streamed import ANSWER_S, ClosedLoop
from clients.client import ServiceError
from clients.clip import open_clip
from service.errors import QuadliftError
from service.schemas import ns_from_rfc3339

JOINED = "joined"
START_S = 30.0
"""For the process to start and its cameras to join."""
_CAPTURED_AT = re.compile(rb'"captured_at":"([^"]+)"')
_DEGRADED = b'"degraded":true'
_LINE_BYTES = 2**20


class GeneratorError(Exception):
    """The generator's process ended without figures; the message holds its last words."""


class Generator:
    """A generator's process whose cameras have joined, and which waits."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process

    async def run(self) -> dict[str, Any]:
        """Its figures, when it is done. Raises GeneratorError."""
        _, line = await asyncio.gather(self._say(b"\n"), self.hear())
        figures: dict[str, Any] = json.loads(line)
        return figures

    async def hear(self) -> str:
        """Its next line. Raises GeneratorError."""
        assert self._process.stdout is not None
        line = await self._process.stdout.readline()
        if not line:
            assert self._process.stderr is not None
            raise GeneratorError((await self._process.stderr.read()).decode("utf-8", "replace").strip() or "it said nothing")
        return line.decode().strip()

    async def _say(self, data: bytes) -> None:
        assert self._process.stdin is not None
        with suppress(ConnectionError):
            # Where it has ended, hearing from it fails, and says why.
            self._process.stdin.write(data)
            await self._process.stdin.drain()


@asynccontextmanager
async def stream_generator(
    url: str, seconds: float, *, rate_hz: float | None = None, in_flight: int | None = None
) -> AsyncIterator[Generator]:
    """A process that will feed the clip's site at a rate, or with so many sets on their way. Raises GeneratorError."""
    options = ["--rate", str(rate_hz)] if in_flight is None else ["--in-flight", str(in_flight)]
    command = [sys.executable, "-m", "benchmarks.load.stream_generator", url, "--seconds", str(seconds), *options]
    pipe = asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(*command, stdin=pipe, stdout=pipe, stderr=pipe, limit=_LINE_BYTES)
    try:
        generator = Generator(process)
        async with asyncio.timeout(START_S):
            if (said := await generator.hear()) != JOINED:
                raise GeneratorError(f"it said {said!r} instead of {JOINED!r}")
        yield generator
    finally:
        with suppress(ProcessLookupError):
            process.kill()
        await process.wait()


class OpenLoop:
    """Sends sets at their times, whatever becomes of those before; their age counts from the time when each was due."""

    def __init__(self, link: StreamLink, sets: Sequence[Mapping[str, bytes]], rate_hz: float) -> None:
        """link: one whose cameras have joined. sets: JPEG files by camera."""
        self._link, self._sets, self._rate_hz = link, sets, rate_hz
        self._due: dict[int, float] = {}
        """When each set that is on its way was due (time.monotonic), by capture time (ns)."""
        self._latencies_ms: list[float] = []
        self._behind_ms: list[float] = []
        self._degraded = self._unasked = 0

    async def run(self, seconds: float) -> dict[str, Any]:
        """Send, and wait for what is on its way. Raises ServiceError."""
        collecting = asyncio.create_task(self._collect())
        began, began_ns = time.monotonic(), time.time_ns()
        count = round(seconds * self._rate_hz)
        try:
            for number in range(count):
                due = began + number / self._rate_hz
                await asyncio.sleep(max(0.0, due - time.monotonic()))
                captured_at_ns = began_ns + round(1e9 * number / self._rate_hz)
                self._due[captured_at_ns] = due
                self._behind_ms.append(1e3 * (time.monotonic() - due))
                await self._link.send(self._sets[number % len(self._sets)], captured_at_ns)
            until = time.monotonic() + ANSWER_S
            while self._due and time.monotonic() < until and not collecting.done():
                await asyncio.sleep(0.01)
        finally:
            collecting.cancel()
            await asyncio.gather(collecting, return_exceptions=True)
        return self._figures(count)

    def note(self, message: bytes, now: float) -> None:
        """A message that came at ``now`` (time.monotonic)."""
        found = _CAPTURED_AT.search(message)
        due = self._due.pop(ns_from_rfc3339(found[1].decode()), None) if found else None
        if due is None:
            self._unasked += 1
            return
        self._latencies_ms.append(1e3 * (now - due))
        self._degraded += _DEGRADED in message

    async def _collect(self) -> None:
        while True:
            message = await self._link.receive()
            self.note(message, time.monotonic())

    def _figures(self, count: int) -> dict[str, Any]:
        return {
            "sent": count,
            "answered": len(self._latencies_ms),
            "missing": len(self._due),
            "degraded": self._degraded,
            "unasked": self._unasked,
            "refused_frames": len(self._link.refusals),
            "latency_ms": percentiles(self._latencies_ms),
            "behind_schedule_ms": percentiles(self._behind_ms),
        }


def percentiles(values: Sequence[float]) -> dict[str, float]:
    """Median, 99th percentile and largest of some values; NaN where there are none."""
    p50, p99, largest = np.percentile(values if len(values) else [float("nan")], [50, 99, 100])
    return {"p50": round(float(p50), 2), "p99": round(float(p99), 2), "max": round(float(largest), 2)}


async def _generate(url: str, seconds: float, rate_hz: float | None, in_flight: int | None) -> dict[str, Any]:
    clip = open_clip()
    sets = [clip.frames(step) for step in range(clip.steps)]
    async with StreamLink(url, clip.site["id"]) as link:
        await link.join(itertools.cycle(sets))
        print(JOINED, flush=True)
        await asyncio.to_thread(sys.stdin.readline)
        began, began_cpu_s = time.monotonic(), time.process_time()
        if in_flight is None:
            assert rate_hz is not None
            figures = await OpenLoop(link, sets, rate_hz).run(seconds)
        else:
            measured = Measured()
            await ClosedLoop(link, sets, in_flight, measured).run(seconds)
            figures = {"sets": measured.sets, "dropped": measured.dropped, "seconds": measured.seconds}
            figures["latency_ms"] = percentiles(measured.latency_ms)
        cores = (time.process_time() - began_cpu_s) / (time.monotonic() - began)
        return figures | {"cpu_cores": round(cores, 3)}


def main() -> None:
    """The generator's process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("url")
    parser.add_argument("--seconds", type=float, required=True)
    how = parser.add_mutually_exclusive_group(required=True)
    how.add_argument("--rate", type=float, help="Sets a second.")
    how.add_argument("--in-flight", type=int, help="Sets on their way at any time.")
    given = parser.parse_args()
    try:
        figures = asyncio.run(_generate(given.url, given.seconds, given.rate, given.in_flight))
    except (ServiceError, QuadliftError) as error:
        raise SystemExit(str(error)) from None
    print(json.dumps(figures), flush=True)


if __name__ == "__main__":
    main()
