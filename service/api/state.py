"""What the endpoints share: one :class:`Service` per app, found through the request."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Annotated, Literal, Protocol, TypeVar

from fastapi import Depends
from starlette.requests import HTTPConnection, Request

from service.api.body import BodyRoom, read_body
from service.api.feeds import Feeds
from service.api.live import LiveSites
from service.api.recent import RecentFrames
from service.errors import OverloadError
from service.run_limit import RunLimit
from service.scheduler import FrameSetRunner, Scheduler
from service.settings import Settings
from service.sites_store import SitesStore
from service.telemetry import Drop, Telemetry

logger = logging.getLogger(__name__)

T = TypeVar("T")
_MIN_RUN_LIMIT_S = 1.5
"""With the time between two looks, a worker that hangs is replaced within two seconds."""
_RUN_LIMIT_WARM_UPS = 2
"""A warm-up takes about as long as two sets of four frames, plus what only the first run takes."""
_WORK_SHARE = 0.8
"""Of the time to stop: what frame sets may take of it; the rest is for their answers."""

Phase = Literal["starting", "ready", "failed", "stopping"]
_WHY: dict[Phase, str] = {
    "starting": "the service is warming up.",
    "failed": "the service could not warm up its networks.",
    "stopping": "the service is stopping.",
}


class Leaver(Protocol):
    """A connection that can be told to end."""

    def go_away(self) -> None:
        """End soon, with a word to the peer."""
        ...


@dataclass(eq=False)
class Service:
    """Everything that outlives a request."""

    settings: Settings
    telemetry: Telemetry
    store: SitesStore
    scheduler: Scheduler
    live: LiveSites
    feeds: Feeds
    recent: RecentFrames
    ingests: set[Leaver] = field(default_factory=set, init=False)
    """Open camera stream connections."""
    phase: Phase = field(default="starting", init=False)

    def __post_init__(self) -> None:
        self._bodies = BodyRoom(self.settings.max_bodies_bytes)
        self.telemetry.ready(lambda: self.trouble() is None)

    async def read_body(self, request: Request) -> bytes:
        """A request's body within the settings' limits; raises as :func:`service.api.body.read_body`."""
        settings = self.settings
        try:
            return await read_body(request, settings.max_body_bytes, settings.body_receive_s, self._bodies)
        except OverloadError:
            self.telemetry.dropped(Drop.BODIES_FULL)
            raise

    def trouble(self) -> str | None:
        """Why the service is not ready; None when it is."""
        return _WHY[self.phase] if self.phase != "ready" else self.scheduler.trouble()

    def require_ready(self) -> None:
        """Raise OverloadError unless frame sets can be answered now; with one worker left they still can."""
        if self.phase != "ready" or self.scheduler.working == 0:
            raise OverloadError(
                self.trouble() or "the workers are being replaced.",
                retry_after_s=2,
                remedy="Wait until GET /health/ready answers 200.",
            )

    async def warm_up(self, runner: FrameSetRunner) -> None:
        """Warm the networks up, off the event loop; then be ready."""
        began = time.monotonic()
        try:
            await in_daemon_thread(runner.warm_up)
        except Exception:
            logger.exception("Warm-up failed; the service stays not ready")
            self.phase = "failed"
            return
        limit_ms = self.settings.run_limit_ms
        took_s = time.monotonic() - began
        floor_s = max(_MIN_RUN_LIMIT_S, _RUN_LIMIT_WARM_UPS * took_s) if limit_ms is None else limit_ms / 1e3
        self.scheduler.run_limit = RunLimit(floor_s, adapts=limit_ms is None)
        if self.phase == "starting":
            self.phase = "ready"
            logger.info("ready; a frame set may run for %.1f s", floor_s)

    async def drain(self) -> None:
        """Refuse what comes, and finish what was accepted, within the time of the settings; a second call does nothing.

        Camera streams are closed, then the frame sets that wait or run are finished and published, then streams are closed.
        """
        if self.phase == "stopping":
            return
        self.phase = "stopping"
        loop = asyncio.get_running_loop()
        # The last part is for telling the callers.
        until = loop.time() + _WORK_SHARE * self.settings.drain_s
        for connection in list(self.ingests):
            connection.go_away()
        feeds = asyncio.create_task(self.feeds.stop())
        await asyncio.wait({feeds}, timeout=max(0.0, until - loop.time()))
        remaining_s = max(0.0, until - loop.time())
        left = await in_daemon_thread(lambda: self.scheduler.stop(remaining_s))
        live = asyncio.create_task(self.live.stop())
        await asyncio.wait({feeds, live}, timeout=(1 - _WORK_SHARE) / 2 * self.settings.drain_s)
        for task in (feeds, live):
            task.cancel()
        logger.info("drained; %d accepted frame sets were not finished", left)


def current_service(connection: HTTPConnection) -> Service:
    """The service of the app that a request or WebSocket came to."""
    service: Service = connection.app.state.service
    return service


async def in_daemon_thread(work: Callable[[], T]) -> T:
    """Run something that blocks in a thread of its own, which keeps no process alive that wants to end."""
    future: Future[T] = Future()

    def run() -> None:
        try:
            outcome = work()
        except BaseException as error:
            # Handed on to whoever awaits, whatever it is.
            future.set_exception(error)
        else:
            future.set_result(outcome)

    threading.Thread(target=run, daemon=True).start()
    # Shielded: a thread cannot be cancelled, and must find its future open.
    return await asyncio.shield(asyncio.wrap_future(future))


ServiceDep = Annotated[Service, Depends(current_service)]
