"""The HTTP server: uvicorn, which lets the service finish its work before connections are closed."""

from __future__ import annotations

import signal
import socket
import time
from collections.abc import Awaitable, Callable
from types import FrameType
from typing import Any

import uvicorn

from service.api.wire import Wire
from service.settings import Settings


def server_config(settings: Settings, app: Any) -> uvicorn.Config:
    """Uvicorn's configuration with the limits of the settings."""
    return uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        # The logs of the whole process have one form: see `service.logs`.
        log_config=None,
        access_log=False,
        timeout_keep_alive=settings.timeout_keep_alive_s,
        limit_concurrency=settings.limit_concurrency,
        ws=Wire,
        ws_ping_interval=settings.ping_s,
        ws_ping_timeout=settings.ping_s,
        # Only camera streams send large messages: one frame and its header.
        ws_max_size=min(settings.ws_max_size, settings.max_frame_bytes + settings.ingest_max_header_bytes + 4),
        ssl_certfile=settings.tls_cert,
        ssl_keyfile=settings.tls_key,
        # Boxes compress well, but it costs more time than a local network does.
        ws_per_message_deflate=False,
    )


class Server(uvicorn.Server):
    """Stops in this order: no new connections, the service's own work, the last answers; all of it within ``drain_s``."""

    def __init__(self, config: uvicorn.Config, drain: Callable[[], Awaitable[None]], drain_s: float) -> None:
        """drain: finishes what was accepted. drain_s: seconds for that and for the last answers."""
        super().__init__(config)
        self._drain = drain
        self._drain_s = drain_s

    def run_until_signal(self) -> None:
        """Serve until SIGTERM or SIGINT, which also count before the server listens; returns when all is done."""
        before = {number: signal.signal(number, self._end) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            # Uvicorn raises the signal again when it has stopped; our handler is there to take it, so the process ends well.
            self.run()
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop accepting, drain, and close what is left."""
        for server in self.servers:
            server.close()
        began = time.monotonic()
        if not self.force_exit:
            await self._drain()
        left_s = self._drain_s - (time.monotonic() - began)
        self.config.timeout_graceful_shutdown = max(1, int(left_s))
        await super().shutdown(sockets)

    def _end(self, number: int, frame: FrameType | None) -> None:
        self.should_exit = True
