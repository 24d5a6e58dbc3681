"""Frame sets through the camera streams of a served process: frames in over WS /ingest, messages out over WS /stream."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import AsyncIterator, Iterator, Sequence

from benchmarks.measured import Measured
from clients.client import AsyncClient, ServiceError
from clients.ingest import IngestClient
from service.errors import QuadliftError
from service.frames import FrameSet
from service.schemas import Detections, ns_from_rfc3339

MIN_SPACING_NS = 25_000_000
"""Between two sets' capture times: above the service's tolerance, and below the time that a set takes on two cores."""
ANSWER_S = 5.0
"""A set whose message has not come after this time is lost."""
JOIN_SETS = 40
"""Sets sent, outside the measurement, until one is complete: then the service knows all cameras."""


def run_ws(url: str, sets: Sequence[FrameSet], seconds: float, in_flight: int, into: Measured) -> None:
    """Keep ``in_flight`` sets on their way for a time. Raises QuadliftError when the service refuses frames."""
    try:
        asyncio.run(_Run(url, sets, in_flight, into).run(seconds))
    except ServiceError as error:
        raise QuadliftError(f"the service refused a camera stream: {error}") from error


class _Run:
    def __init__(self, url: str, sets: Sequence[FrameSet], in_flight: int, into: Measured) -> None:
        self._url, self._sets, self._in_flight, self._into = url, sets, in_flight, into
        self._flying: dict[int, float] = {}
        """When each set that is on its way was sent, by capture time (ns)."""
        self._changed = asyncio.Event()
        self._captured_at_ns = 0

    async def run(self, seconds: float) -> None:
        """Join all cameras, then measure."""
        site = self._sets[0].site.id
        endless = itertools.cycle(self._sets)
        async with AsyncClient(self._url) as reader, IngestClient(self._url, site) as ingest:
            messages = aiter(reader.stream(site))
            listening = asyncio.create_task(anext(messages))
            await self._join(ingest, endless, listening)
            message = await listening
            for _ in range(JOIN_SETS):
                if not message.degraded:
                    break
                await self._send(ingest, next(endless))
                message = await asyncio.wait_for(anext(messages), ANSWER_S)
            else:
                raise QuadliftError("the service never saw all cameras.")
            self._flying.clear()
            collecting = asyncio.create_task(self._collect(messages))
            started = time.perf_counter()
            try:
                while time.perf_counter() - started < seconds:
                    await self._send(ingest, next(endless))
                    await self._until(self._in_flight - 1)
                await self._until(0)
                self._into.seconds += time.perf_counter() - started
            finally:
                collecting.cancel()
                await asyncio.gather(collecting, return_exceptions=True)
            if ingest.errors:
                raise QuadliftError(f"the service refused a frame: {ingest.errors[-1].message}")

    async def _join(self, ingest: IngestClient, sets: Iterator[FrameSet], listening: asyncio.Task[Detections]) -> None:
        """Send sets until a first message comes: before that, nobody may be listening yet."""
        for _ in range(JOIN_SETS):
            await self._send(ingest, next(sets))
            done, _pending = await asyncio.wait([listening], timeout=ANSWER_S / JOIN_SETS)
            if done:
                return
        raise QuadliftError("no message came over the stream.")

    async def _send(self, ingest: IngestClient, frame_set: FrameSet) -> None:
        self._captured_at_ns = max(time.time_ns(), self._captured_at_ns + MIN_SPACING_NS)
        self._flying[self._captured_at_ns] = time.perf_counter()
        for frame in frame_set.frames:
            await ingest.send(frame.camera_id, frame.data, self._captured_at_ns)

    async def _collect(self, messages: AsyncIterator[Detections]) -> None:
        async for message in messages:
            captured_at_ns = ns_from_rfc3339(message.captured_at)
            sent_at = self._flying.pop(captured_at_ns, None)
            if sent_at is not None:
                self._into.note(1e3 * (time.perf_counter() - sent_at), message.timing_ms.model_dump(exclude_unset=True))
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
