"""The outermost layer of the app: counts every answer, and turns unknown exceptions into a generic 500."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.errors import INTERNAL, error_response
from service.telemetry import Telemetry

logger = logging.getLogger(__name__)

_CLIENT_CLOSED_REQUEST = 499
_UNMATCHED = "unmatched"


class Guard:
    """ASGI middleware. An exception that reaches it is logged with its traceback; its caller learns only that it was one."""

    def __init__(self, app: ASGIApp, telemetry: Telemetry, is_stopping: Callable[[], bool]) -> None:
        """is_stopping: asks whether callers should be told to connect anew for their next request."""
        self._app = app
        self._telemetry = telemetry
        self._is_stopping = is_stopping

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        status, began = 0, time.monotonic()

        async def watch(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                if self._is_stopping():
                    message["headers"] = [*message.get("headers", ()), (b"connection", b"close")]
            await send(message)

        try:
            await self._app(scope, receive, watch)
        except ClientDisconnect:
            status = _CLIENT_CLOSED_REQUEST
        except Exception:
            logger.exception("%s %s failed", scope["method"], scope["path"])
            if status:
                # The answer has begun; only breaking the connection can tell the caller.
                raise
            await error_response(INTERNAL)(scope, receive, watch)
        finally:
            self._telemetry.request(getattr(scope.get("route"), "path", _UNMATCHED), status)
            logger.debug("%s %s: %d after %.1f ms", scope["method"], scope["path"], status, 1e3 * (time.monotonic() - began))
