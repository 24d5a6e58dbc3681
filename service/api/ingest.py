"""``WS /ingest/{site}``: cameras push frames, one binary message each; the service answers with errors only."""

from __future__ import annotations

import asyncio
import logging

from fastapi import APIRouter, WebSocket
from starlette.websockets import WebSocketDisconnect

from service.api.errors import error_response, error_text
from service.api.feeds import Feed
from service.api.ingest_message import IngestMessage, parse_message
from service.api.state import Service, ServiceDep
from service.api.wire import wire_of
from service.errors import InputError, NotFoundError, OverloadError, QuadliftError
from service.frames import EncodedFrame, RefusedFrame, check_frame
from service.telemetry import Drop

logger = logging.getLogger(__name__)

router = APIRouter()

_POLICY_VIOLATION = 1008
_GOING_AWAY = 1001
_PAUSE_S, _MAX_PAUSE_S = 0.01, 0.05
"""How much longer each refused message of a row, after its first, keeps its connection from being read; and at most. A camera
that sends rubbish as fast as it can would take the loop's time from the others'; one broken frame costs nothing."""
_FAREWELL_S = 2.0
"""Time to tell a sender why its connection ends."""


class _Cut(Exception):
    """The connection ends; ``code`` is the WebSocket's, ``error`` what the sender is told."""

    def __init__(self, code: int, error: QuadliftError) -> None:
        super().__init__(str(error))
        self.code = code
        self.error = error


@router.websocket("/ingest/{site}")
async def ingest(websocket: WebSocket, site: str, service: ServiceDep) -> None:
    """Take frames of one site's cameras, any number of cameras on one connection."""
    try:
        service.store.get(site)
        service.require_ready()
        feed = service.feeds.join(site)
    except QuadliftError as error:
        await websocket.send_denial_response(error_response(error))
        return
    connection = Connection(websocket, site, service, feed)
    service.ingests.add(connection)
    try:
        await websocket.accept()
        logger.info("a camera stream opens", extra={"site": site})
        await connection.serve()
    finally:
        logger.info(
            "a camera stream ends; its cameras: %s", ", ".join(sorted(connection.cameras)) or "none", extra={"site": site}
        )
        service.ingests.discard(connection)
        feed.cameras_leave(connection.cameras)
        service.feeds.leave(site, feed)


class Connection:
    """One camera stream connection."""

    def __init__(self, websocket: WebSocket, site_id: str, service: Service, feed: Feed) -> None:
        self.cameras: set[str] = set()
        """Cameras whose frames came over this connection."""
        self._websocket = websocket
        self._site_id = site_id
        self._service = service
        self._feed = feed
        self._errors = 0
        self._camera_id: str | None = None
        """The camera of the message at hand, as soon as it is known."""
        self._leaving = False
        self._receiving: asyncio.Timeout | None = None

    def go_away(self) -> None:
        """The service stops: take no message more and say so."""
        self._leaving = True
        if self._receiving is not None:
            self._receiving.reschedule(asyncio.get_running_loop().time())

    async def serve(self) -> None:
        """Take messages until the sender goes, is too slow, or sends too much that is wrong, or the service stops."""
        limit_s = self._service.settings.ingest_receive_s
        try:
            while not self._leaving:
                try:
                    async with asyncio.timeout(limit_s) as self._receiving:
                        message = await self._receive()
                except TimeoutError:
                    if self._leaving:
                        break
                    raise _Cut(_POLICY_VIOLATION, _too_slow(limit_s)) from None
                finally:
                    self._receiving = None
                await self._take(message)
            raise _Cut(_GOING_AWAY, OverloadError("the service is stopping.", remedy="Connect again when it has started anew."))
        except WebSocketDisconnect:
            return
        except _Cut as cut:
            await self._close(cut, limit_s)

    async def _receive(self) -> bytes | None:
        """The next message; None for one that is not binary. Raises WebSocketDisconnect."""
        message = await self._websocket.receive()
        if message["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(message.get("code", 1000))
        data: bytes | None = message.get("bytes")
        return data

    async def _take(self, message: bytes | None) -> None:
        try:
            self._accept(message)
        except InputError as error:
            self._service.telemetry.dropped(Drop.FRAME_REFUSED)
            self._errors += 1
            if self._errors == 1:
                # The first of a row: a camera that sends rubbish must not fill the log.
                logger.warning("a frame is refused: %s", error, extra={"site": self._site_id, "camera": self._camera_id})
            if isinstance(error, NotFoundError) and error.field == "site":
                raise _Cut(_GOING_AWAY, error) from None
            if self._errors >= self._service.settings.ingest_max_errors:
                raise _Cut(_POLICY_VIOLATION, error) from None
            await self._answer(error)
            await asyncio.sleep(min((self._errors - 1) * _PAUSE_S, _MAX_PAUSE_S))
        else:
            self._errors = 0

    def _accept(self, message: bytes | None) -> None:
        """Check a message and hand its frame on. Raises InputError and its kinds."""
        self._camera_id = None
        settings = self._service.settings
        if self._feed.is_closed:
            raise NotFoundError("the site was deleted.", field="site", remedy="Connect again if it has come back.")
        if message is None:
            raise InputError("a text message.", field="message", remedy="Send binary messages.")
        parsed = parse_message(
            message, max_header_bytes=settings.ingest_max_header_bytes, max_frame_bytes=settings.max_frame_bytes
        )
        camera = self._service.store.get(self._site_id).camera(parsed.camera_id)
        self._camera_id = camera.id
        if camera.id not in self.cameras:
            self.cameras.add(camera.id)
            self._feed.camera_joins(camera.id)
        try:
            check_frame(parsed.data, camera, settings.frame_limits)
        except InputError as error:
            self._feed.refuse(camera.id, RefusedFrame(parsed.captured_at_ns, error.message))
            raise
        self._feed.push(_frame(parsed))

    async def _answer(self, error: QuadliftError) -> None:
        """Tell the sender, who may not be listening: that must not keep us either."""
        limit_s = self._service.settings.ingest_receive_s
        try:
            await asyncio.wait_for(self._websocket.send_text(error_text(error)), limit_s)
        except TimeoutError:
            raise _Cut(_POLICY_VIOLATION, _too_slow(limit_s)) from None

    async def _close(self, cut: _Cut, limit_s: float) -> None:
        async def say_and_close() -> None:
            await self._websocket.send_text(error_text(cut.error))
            await self._websocket.close(cut.code, cut.error.message[:100])

        try:
            await asyncio.wait_for(say_and_close(), min(limit_s, _FAREWELL_S))
        except (TimeoutError, WebSocketDisconnect, RuntimeError):
            # It is gone or does not listen.
            if (wire := wire_of(self._websocket)) is not None:
                wire.abort()


def _frame(message: IngestMessage) -> EncodedFrame:
    return EncodedFrame(message.camera_id, message.data, message.captured_at_ns)


def _too_slow(limit_s: float) -> InputError:
    return InputError(
        f"no whole message came within {limit_s:g} s.",
        field="message",
        remedy="Send frames more often, or raise QUADLIFT_INGEST_RECEIVE_S.",
    )
