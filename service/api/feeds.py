"""The camera streams of every site: frames in, frame sets to the scheduler, the newest first to be kept under overload."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable

from service.errors import FrameError, NotFoundError, OverloadError, QuadliftError
from service.frames import EncodedFrame, FrameSet, RefusedFrame
from service.site import Site
from service.sync import SyncedSet, Synchronizer, SyncSettings
from service.telemetry import Drop, Telemetry

logger = logging.getLogger(__name__)

RunSet = Callable[[FrameSet], Awaitable[object]]
"""Runs a frame set and publishes its message; raises QuadliftError."""


class Feed:
    """One site's connections, the frames that wait for their set, and the sets under way. For the event loop only.

    At most ``in_flight`` sets are under way (the scheduler runs some, holds the newest, and some are on their way out) and one
    waits here; a newer one takes its place.
    """

    def __init__(
        self,
        find_site: Callable[[], Site],
        next_sequence: Callable[[], int],
        run: RunSet,
        telemetry: Telemetry,
        sync: SyncSettings,
        in_flight: int,
    ) -> None:
        self._find_site = find_site
        self._next_sequence = next_sequence
        self._run = run
        self._telemetry = telemetry
        self._sync = Synchronizer(sync, telemetry.dropped)
        self._in_flight = in_flight
        self._refused: dict[str, RefusedFrame] = {}
        self._senders: Counter[str] = Counter()
        self._waiting: FrameSet | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._timer: asyncio.TimerHandle | None = None
        self.connections = 0
        self.is_closed = False
        """Whether the site was deleted; one of the same id has another feed."""

    def camera_joins(self, camera_id: str) -> None:
        """A connection sends frames of a camera for the first time."""
        self._senders[camera_id] += 1

    def cameras_leave(self, camera_ids: Iterable[str]) -> None:
        """A connection that sent frames of these cameras has ended."""
        for camera_id in camera_ids:
            self._senders[camera_id] -= 1
            if self._senders[camera_id] <= 0:
                del self._senders[camera_id]
                self._refused.pop(camera_id, None)
                self._forward(self._sync.leave(camera_id, time.monotonic_ns()))

    def push(self, frame: EncodedFrame) -> None:
        """Take a checked frame with a capture time."""
        self._refused.pop(frame.camera_id, None)
        self._forward(self._sync.push(frame, time.monotonic_ns()))

    def refuse(self, camera_id: str, refused: RefusedFrame) -> None:
        """A camera's frame could not be taken: the sets say so until a better one comes."""
        self._refused[camera_id] = refused

    async def stop(self) -> None:
        """Drop and count the frames that wait for their set; finish the sets that have begun or wait."""
        self.close()
        while self._tasks:
            await asyncio.gather(*self._tasks)

    def close(self) -> None:
        """The site is gone: drop and count what waits for its set."""
        self.is_closed = True
        self._sync.close()
        self._schedule()

    def _forward(self, ready: list[SyncedSet]) -> None:
        for synced in ready:
            frame_set = self._frame_set(synced)
            if frame_set is None:
                continue
            if self._waiting is not None:
                self._telemetry.dropped(Drop.SUPERSEDED)
            self._waiting = frame_set
            self._start()
        self._schedule()

    def _frame_set(self, synced: SyncedSet) -> FrameSet | None:
        """A set as the site is now: cameras may have left since their frames came."""
        try:
            site = self._find_site()
        except NotFoundError:
            self._telemetry.dropped(Drop.FRAME_LEFT, len(synced.frames))
            return None
        known = {camera.id for camera in site.cameras}
        frames = tuple(frame for frame in synced.frames if frame.camera_id in known)
        if len(frames) < len(synced.frames):
            self._telemetry.dropped(Drop.FRAME_LEFT, len(synced.frames) - len(frames))
        if not frames:
            return None
        return FrameSet(site, frames, synced.captured_at_ns, self._next_sequence(), synced.stale, dict(self._refused))

    def _start(self) -> None:
        if self._waiting is None or len(self._tasks) >= self._in_flight:
            return
        frame_set, self._waiting = self._waiting, None
        task = asyncio.create_task(self._run_one(frame_set))
        self._tasks.add(task)
        task.add_done_callback(self._finished)

    def _finished(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        self._start()

    async def _run_one(self, frame_set: FrameSet) -> None:
        try:
            await self._run(frame_set)
        except FrameError:
            self._telemetry.dropped(Drop.UNDECODABLE)
        except QuadliftError as error:
            # The scheduler has counted it with its reason; there is no caller to tell.
            logger.debug("Set %d of site '%s': %s", frame_set.sequence, frame_set.site.id, error)
        except Exception:
            logger.exception("Set %d of site '%s' failed", frame_set.sequence, frame_set.site.id)
            self._telemetry.dropped(Drop.FAILED)

    def _schedule(self) -> None:
        """Come back when the next wait ends."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        deadline_ns = self._sync.deadline_ns
        if deadline_ns is not None:
            delay_s = max(0.0, (deadline_ns - time.monotonic_ns()) / 1e9)
            self._timer = asyncio.get_running_loop().call_later(delay_s, self._tick)

    def _tick(self) -> None:
        self._timer = None
        self._forward(self._sync.poll(time.monotonic_ns()))


class Feeds:
    """The camera streams of all sites, by id. For the event loop only."""

    def __init__(self, make: Callable[[str], Feed], telemetry: Telemetry, *, max_connections: int) -> None:
        """make: gives the feed of a site that has none. max_connections: of one site."""
        self._make = make
        self._telemetry = telemetry
        self._max_connections = max_connections
        self._feeds: dict[str, Feed] = {}

    def join(self, site_id: str) -> Feed:
        """Open a connection to a site that the store knows. Raises OverloadError when it has too many."""
        feed = self._feeds.get(site_id)
        if feed is None:
            feed = self._feeds[site_id] = self._make(site_id)
        if feed.connections >= self._max_connections:
            raise OverloadError(
                f"site '{site_id}' has {feed.connections} camera streams already.",
                remedy="Send several cameras over one connection, or raise QUADLIFT_INGEST_MAX_CONNECTIONS.",
            )
        feed.connections += 1
        self._telemetry.ingests(site_id, feed.connections)
        return feed

    def leave(self, site_id: str, feed: Feed) -> None:
        """Close a connection."""
        feed.connections -= 1
        if self._feeds.get(site_id) is feed:
            self._telemetry.ingests(site_id, feed.connections)

    def forget_site(self, site_id: str) -> None:
        """Drop a site's streams; its connections learn of it with their next message."""
        feed = self._feeds.pop(site_id, None)
        if feed is not None:
            feed.close()

    async def stop(self) -> None:
        """Finish what was begun at every site."""
        for feed in list(self._feeds.values()):
            await feed.stop()
