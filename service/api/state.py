"""What the endpoints share: one :class:`Service` per app, found through the request."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass, field
from typing import Annotated, Literal

from fastapi import Depends
from starlette.requests import HTTPConnection

from service.api.feeds import Feeds
from service.api.live import LiveSites
from service.api.recent import RecentFrames
from service.errors import OverloadError
from service.scheduler import FrameSetRunner, Scheduler
from service.settings import Settings
from service.sites_store import SitesStore
from service.telemetry import Telemetry

logger = logging.getLogger(__name__)

Phase = Literal["starting", "ready", "failed", "stopping"]
_WHY: dict[Phase, str] = {
    "starting": "the service is warming up.",
    "failed": "the service could not warm up its networks.",
    "stopping": "the service is stopping.",
}


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
    phase: Phase = field(default="starting", init=False)

    def require_ready(self) -> None:
        """Raise OverloadError unless frame sets can be answered now."""
        if self.phase != "ready":
            raise OverloadError(_WHY[self.phase], retry_after_s=2, remedy="Wait until GET /health/ready answers 200.")

    async def warm_up(self, runner: FrameSetRunner) -> None:
        """Warm the networks up, off the event loop; then be ready."""
        try:
            await asyncio.to_thread(runner.warm_up)
        except Exception:
            logger.exception("Warm-up failed; the service stays not ready")
            self.phase = "failed"
            return
        if self.phase == "starting":
            self.phase = "ready"
            self.telemetry.ready(True)

    def stop(self) -> None:
        """Refuse new frame sets and finish the accepted ones; blocks."""
        self.phase = "stopping"
        self.telemetry.ready(False)
        self.scheduler.stop()


def current_service(connection: HTTPConnection) -> Service:
    """The service of the app that a request or WebSocket came to."""
    service: Service = connection.app.state.service
    return service


ServiceDep = Annotated[Service, Depends(current_service)]
