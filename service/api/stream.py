"""``WS /stream/{site}``: every fused frame set of a site, to everybody who listens."""

from __future__ import annotations

import asyncio
import logging
from typing import Literal, cast

from fastapi import APIRouter, WebSocket
from starlette.websockets import WebSocketDisconnect

from service.api.errors import error_response
from service.api.live import Format, Reader
from service.api.messages import Encoded
from service.api.state import ServiceDep
from service.api.wire import wire_of
from service.errors import InputError, QuadliftError
from service.telemetry import Drop

logger = logging.getLogger(__name__)

router = APIRouter()

_GOING_AWAY: Literal[1001] = 1001
_FORMATS = ("json", "msgpack")


class _Stalled(Exception):
    """The reader's connection has taken nothing for too long."""


@router.websocket("/stream/{site}")
async def stream(websocket: WebSocket, site: str, service: ServiceDep) -> None:
    """Send one message a frame set; a reader that is slow misses messages and delays nobody."""
    try:
        service.store.get(site)
        live = service.live.site(site)
        reader = live.join(_format(websocket.query_params.get("format", "json")))
    except QuadliftError as error:
        await websocket.send_denial_response(error_response(error))
        return
    wire = wire_of(websocket)
    if wire is not None:
        wire.limit_buffers()
    try:
        await websocket.accept()
        logger.info("a reader joins", extra={"site": site})
        await _serve(websocket, reader, service.settings.reader_stall_s)
    except _Stalled:
        service.telemetry.dropped(Drop.STALLED_READER)
        logger.warning("a reader that takes nothing is cut", extra={"site": site})
        if wire is not None:
            wire.abort()
    else:
        logger.info("a reader leaves", extra={"site": site})
    finally:
        live.leave(reader)


async def _serve(websocket: WebSocket, reader: Reader, stall_s: float) -> None:
    """Send until the client goes or the stream ends, whichever is first. Raises _Stalled."""
    tasks = {asyncio.create_task(_send_all(websocket, reader, stall_s)), asyncio.create_task(_until_gone(websocket))}
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        outcomes = await asyncio.gather(*tasks, return_exceptions=True)
    for outcome in outcomes:
        if isinstance(outcome, Exception) and not isinstance(outcome, WebSocketDisconnect):
            raise outcome


async def _send_all(websocket: WebSocket, reader: Reader, stall_s: float) -> None:
    try:
        while (message := await reader.take()) is not None:
            async with asyncio.timeout(stall_s):
                await _send(websocket, reader.format, message)
        async with asyncio.timeout(stall_s):
            await websocket.close(_GOING_AWAY, reader.end_reason)
    except TimeoutError:
        raise _Stalled from None


async def _send(websocket: WebSocket, format: Format, message: Encoded) -> None:
    if format == "json":
        await websocket.send_text(message.json.decode())
    elif message.msgpack is not None:
        await websocket.send_bytes(message.msgpack)


async def _until_gone(websocket: WebSocket) -> None:
    """Read and ignore what the client says, so that its leaving is noticed."""
    while (await websocket.receive())["type"] != "websocket.disconnect":
        pass


def _format(text: str) -> Format:
    if text not in _FORMATS:
        raise InputError(f"'{text[:80]}' is not a format.", field="format", remedy=f"Ask for one of: {', '.join(_FORMATS)}.")
    return cast(Format, text)
