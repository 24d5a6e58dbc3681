"""Frame sets through the camera streams of a served process: frames in over WS /ingest, messages out over WS /stream."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Mapping, Sequence

import orjson

from benchmarks.measured import Measured
from benchmarks.stream_link import StreamLink
from clients.client import ServiceError
from service.errors import QuadliftError
from service.frames import FrameSet
from service.schemas import ns_from_rfc3339

MIN_SPACING_NS = 25_000_000
"""Between two sets' capture times: above the service's tolerance, and below the time that a set takes on two cores."""
ANSWER_S = 5.0
"""A set whose message has not come after this time is lost."""


def run_ws(url: str, sets: Sequence[FrameSet], seconds: float, in_flight: int, into: Measured) -> None:
    """Keep ``in_flight`` sets on their way for a time. Raises QuadliftError when the service refuses frames."""
    frames = [{frame.camera_id: frame.data for frame in frame_set.frames} for frame_set in sets]

    async def run() -> None:
        async with StreamLink(url, sets[0].site.id) as link:
            await link.join(itertools.cycle(frames))
            await ClosedLoop(link, frames, in_flight, into).run(seconds)

    try:
        asyncio.run(run())
    except ServiceError as error:
        raise QuadliftError(f"the service refused a camera stream: {error}") from error


class ClosedLoop:
    """Keeps a number of sets on their way: as soon as one is answered, the next one is sent."""

    def __init__(self, link: StreamLink, sets: Sequence[Mapping[str, bytes]], in_flight: int, into: Measured) -> None:
        """link: one whose cameras have joined. sets: JPEG files by camera."""
        self._link, self._sets, self._in_flight, self._into = link, itertools.cycle(sets), in_flight, into
        self._flying: dict[int, float] = {}
        """When each set that is on its way was sent, by capture time (ns)."""
        self._changed = asyncio.Event()
        self._captured_at_ns = 0

    async def run(self, seconds: float) -> None:
        """Measure. Raises ServiceError, QuadliftError."""
        collecting = asyncio.create_task(self._collect())
        started = time.perf_counter()
        try:
            while time.perf_counter() - started < seconds:
                await self._send()
                await self._until(self._in_flight - 1)
            await self._until(0)
            self._into.seconds += time.perf_counter() - started
        finally:
            collecting.cancel()
            await asyncio.gather(collecting, return_exceptions=True)
        if self._link.refusals:
            raise QuadliftError(f"the service refused a frame: {self._link.refusals[-1]}")

    async def _send(self) -> None:
        self._captured_at_ns = max(time.time_ns(), self._captured_at_ns + MIN_SPACING_NS)
        self._flying[self._captured_at_ns] = time.perf_counter()
        await self._link.send(next(self._sets), self._captured_at_ns)

    async def _collect(self) -> None:
        while True:
            message = orjson.loads(await self._link.receive())
            captured_at_ns = ns_from_rfc3339(message["captured_at"])
            sent_at = self._flying.pop(captured_at_ns, None)
            if sent_at is not None:
                self._into.note(1e3 * (time.perf_counter() - sent_at), message["timing_ms"])
            # Messages come in order, so that earlier sets will bring none any more.
            for earlier_ns in [ns for ns in self._flying if ns < captured_at_ns]:
                del self._flying[earlier_ns]
                self._into.dropped += 1
            self._changed.set()

    async def _until(self, flying: int) -> None:
        """Wait until no more than so many sets are on their way; sets that take too long are given up."""
        while len(self._flying) > flying:
            self._changed.clear()
            try:
                async with asyncio.timeout(ANSWER_S):
                    await self._changed.wait()
            except TimeoutError:
                self._into.dropped += len(self._flying)
                self._flying.clear()
