"""What goes on at each site right now: its readers, its tracker, and the order of its frame sets."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np

from service.api.messages import Encoded
from service.errors import OverloadError
from service.telemetry import Drop, Telemetry

if TYPE_CHECKING:
    from service.fusion import FusedBoxes
    from service.pipeline import SetResult
    from service.tracking import TrackedBoxes

Format = Literal["json", "msgpack"]
_LEAVE_POLL_S = 0.02


class SiteTracker(Protocol):
    """What a site needs of a tracker."""

    def update(self, fused: FusedBoxes, captured_at_ns: int) -> TrackedBoxes:
        """Identities and velocities of the boxes, in their order; called with rising times."""
        ...


TrackerFactory = Callable[[], SiteTracker]


class Reader:
    """One stream subscriber: a queue of depth one, in which the newest message wins."""

    def __init__(self, format: Format, telemetry: Telemetry) -> None:
        self.format: Format = format
        self._telemetry = telemetry
        self._message: Encoded | None = None
        self.end_reason: str | None = None
        """Why the stream ended; None while it runs."""
        self._changed = asyncio.Event()

    def offer(self, message: Encoded) -> None:
        """Hand over a message without waiting; one that was not taken yet is dropped and counted."""
        if self._message is not None:
            self._telemetry.dropped(Drop.SLOW_READER)
        self._message = message
        self._changed.set()

    def close(self, reason: str) -> None:
        """End the stream: after a message that waits, :meth:`take` gives None from now on."""
        self.end_reason = reason
        self._changed.set()

    async def take(self) -> Encoded | None:
        """The newest message, as soon as there is one; None when the stream has ended."""
        await self._changed.wait()
        message, self._message = self._message, None
        if self.end_reason is None:
            self._changed.clear()
        return message


class Passage:
    """A frame set's way from its arrival to its publication."""

    def __init__(self, captured_at_ns: int) -> None:
        self.captured_at_ns = captured_at_ns
        self.over = asyncio.Event()


class LiveSite:
    """A site's running stream. For use on the event loop only; the tracker runs in a thread, one call at a time."""

    def __init__(
        self, site_id: str, telemetry: Telemetry, tracker_factory: TrackerFactory, *, reset_s: float, max_readers: int
    ):
        self.site_id = site_id
        self._telemetry = telemetry
        self._tracker_factory = tracker_factory
        self._reset_ns = round(reset_s * 1e9)
        self._max_readers = max_readers
        self._readers: set[Reader] = set()
        self._passages: list[Passage] = []
        self._sequence = 0
        self._tracker: SiteTracker | None = None
        self._tracked_at_ns = -1
        self._tracking = asyncio.Lock()
        self._closed = False

    @property
    def is_running(self) -> bool:
        """Whether anybody reads the stream; only then are boxes tracked and messages published."""
        return bool(self._readers)

    def formats(self) -> set[Format]:
        """The formats that the present readers want."""
        return {reader.format for reader in self._readers}

    def next_sequence(self) -> int:
        """The number of the next frame set, from 1."""
        self._sequence += 1
        return self._sequence

    def join(self, format: Format) -> Reader:
        """Subscribe. Raises OverloadError when the site has as many readers as it may have."""
        if len(self._readers) >= self._max_readers:
            raise OverloadError(
                f"site '{self.site_id}' has {len(self._readers)} readers already.",
                remedy="Close some, or raise QUADLIFT_MAX_READERS.",
            )
        reader = Reader(format, self._telemetry)
        self._readers.add(reader)
        self._telemetry.readers(self.site_id, len(self._readers))
        return reader

    def leave(self, reader: Reader) -> None:
        """Unsubscribe; with the last reader the tracks end."""
        self._readers.discard(reader)
        if not self._readers:
            self._tracker = None
        if not self._closed:
            self._telemetry.readers(self.site_id, len(self._readers))

    def close(self, reason: str) -> None:
        """End the stream for every reader."""
        self._closed = True
        for reader in self._readers:
            reader.close(reason)

    async def settle(self) -> None:
        """Wait until no frame set is under way."""
        while self._passages:
            await self._passages[0].over.wait()

    async def emptied(self) -> None:
        """Wait until every reader has left."""
        while self._readers:
            await asyncio.sleep(_LEAVE_POLL_S)

    @contextmanager
    def passage(self, captured_at_ns: int) -> Iterator[Passage]:
        """Mark a frame set as under way, so that later captured ones wait for it before they are tracked."""
        passage = Passage(captured_at_ns)
        self._passages.append(passage)
        try:
            yield passage
        finally:
            self._passages.remove(passage)
            passage.over.set()

    async def track(self, passage: Passage, result: SetResult) -> tuple[TrackedBoxes | None, float]:
        """Identities of a result's boxes, and the milliseconds it took.

        None when no stream runs, or when a set captured later was tracked already. Sets under way that were captured
        earlier go first: several workers may finish them out of order.
        """
        if not self.is_running:
            return None, 0.0
        while earlier := [p for p in self._passages if p.captured_at_ns < passage.captured_at_ns]:
            await earlier[0].over.wait()
        async with self._tracking:
            if not self.is_running:
                return None, 0.0
            fell_back_ns = self._tracked_at_ns - passage.captured_at_ns
            if self._tracker is None or fell_back_ns > self._reset_ns:
                self._tracker = self._tracker_factory()
            elif fell_back_ns >= 0:
                self._telemetry.dropped(Drop.LATE)
                return None, 0.0
            self._tracked_at_ns = passage.captured_at_ns
            began = time.perf_counter()
            tracked = await asyncio.to_thread(_update, self._tracker, result, passage.captured_at_ns)
            return tracked, (time.perf_counter() - began) * 1e3

    def publish(self, message: Encoded) -> None:
        """Offer a message to every reader."""
        for reader in self._readers:
            reader.offer(message)


class LiveSites:
    """The running state of all sites, by id."""

    def __init__(self, telemetry: Telemetry, tracker_factory: TrackerFactory, *, reset_s: float, max_readers: int) -> None:
        self._make: Callable[[str], LiveSite] = lambda site_id: LiveSite(
            site_id, telemetry, tracker_factory, reset_s=reset_s, max_readers=max_readers
        )
        self._sites: dict[str, LiveSite] = {}

    def site(self, site_id: str) -> LiveSite:
        """The state of a site; ask only for ids that the store knows."""
        if site_id not in self._sites:
            self._sites[site_id] = self._make(site_id)
        return self._sites[site_id]

    def forget_site(self, site_id: str) -> None:
        """End a site's stream and drop its state."""
        live = self._sites.pop(site_id, None)
        if live is not None:
            live.close("the site was deleted")

    async def stop(self) -> None:
        """Wait for the frame sets under way, then end every stream and wait until its readers have left."""
        sites = list(self._sites.values())
        for live in sites:
            await live.settle()
        for live in sites:
            live.close("the service is stopping")
        for live in sites:
            await live.emptied()


def default_tracker() -> SiteTracker:
    """The service's own tracker."""
    from service.tracking import Tracker

    return Tracker()


def _update(tracker: SiteTracker, result: SetResult, captured_at_ns: int) -> TrackedBoxes:
    from service.fusion import FusedBoxes

    fused = FusedBoxes(result.boxes, result.members, np.arange(len(result.boxes), dtype=np.int64), result.parts)
    return tracker.update(fused, captured_at_ns)
