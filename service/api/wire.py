"""The WebSocket connections of the service: uvicorn's own, and what ASGI has no message for.

A peer that reads nothing keeps a closing connection open for ever, since what is left to send never goes out: such a
connection has to be broken off. And a service that stops says so with code 1001.
"""

from __future__ import annotations

import asyncio
import socket
import struct
from contextlib import suppress
from typing import cast

from starlette.websockets import WebSocket
from uvicorn._types import ASGIReceiveEvent, ASGISendEvent
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.http11 import Request

_EXTENSION = "quadlift.wire"
_GOING_AWAY = 1001
_RESET = struct.pack("ii", 1, 0)
_SOCKET_BUFFER = 32 * 1024
_WRITE_BUFFER = 16 * 1024
_FAREWELL_S = 5.0
"""A connection whose app has ended is broken off after this time: its peer may never take the rest."""
_MAX_AFTER_CLOSE = 16
"""Messages that are still taken from a peer that was told to go: an honest one has no more on their way."""
_SLICE = 16 * 1024
"""Bytes that are taken apart at once: what comes from the socket in one piece may hold thousands of small messages, which would
keep the loop from everybody else for tens of milliseconds."""
_STOP_FAREWELL_S = 1.0
"""The same when the server stops."""


class Wire(WebSocketsSansIOProtocol):
    """One connection; give the class to uvicorn as ``ws``."""

    _after_close = 0
    _unread = b""
    """What has come and is not taken apart yet: the app has a message to deal with first."""

    def data_received(self, data: bytes) -> None:
        """Bytes came: take them apart until the app has a message."""
        self._unread += data
        self._go_on_reading()

    async def receive(self) -> ASGIReceiveEvent:
        """The next message, for the app."""
        message = await super().receive()
        self._go_on_reading()
        return message

    async def send(self, message: ASGISendEvent) -> None:
        """Send one of the app's messages."""
        await super().send(message)
        if self.close_sent:
            # The peer's own close may have come already.
            self._go_on_reading()

    def _go_on_reading(self) -> None:
        # With a message for the app, the socket is paused too, until ``receive`` has emptied the queue.
        while self._unread and not self.read_paused and not self.transport.is_closing():
            part, self._unread = self._unread[:_SLICE], self._unread[_SLICE:]
            super().data_received(part)

    def handle_connect(self, event: Request) -> None:
        """Let the app find this connection."""
        super().handle_connect(event)
        if hasattr(self, "scope"):
            # The app's task was only created, not run yet.
            extensions = cast("dict[str, object]", self.scope["extensions"])
            extensions[_EXTENSION] = self

    def abort(self) -> None:
        """Break the connection off at once; what is still to be sent is lost."""
        own_socket: socket.socket | None = self.transport.get_extra_info("socket")
        if own_socket is not None:
            # Without this the system would go on trying to send what it holds, to a peer that does not read. Where the
            # socket is closed already there is nothing left to do.
            with suppress(OSError):
                own_socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        self.transport.abort()

    def limit_buffers(self) -> None:
        """Keep little on the way to a peer, so that what it gets is new, and one that stops reading is soon known."""
        self.transport.set_write_buffer_limits(_WRITE_BUFFER)
        own_socket: socket.socket | None = self.transport.get_extra_info("socket")
        if own_socket is not None:
            own_socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SOCKET_BUFFER)

    def send_receive_event_to_app(self) -> None:
        """A message is whole. One that was told to go and sends on is no longer read: it would take the loop's time."""
        super().send_receive_event_to_app()
        if self.close_sent:
            self._after_close += 1
            if self._after_close >= _MAX_AFTER_CLOSE and not self.transport.is_closing():
                self._unread = b""
                self.transport.pause_reading()

    def keepalive_timeout(self) -> None:
        """The peer did not answer a ping: it will not take a farewell either."""
        super().keepalive_timeout()
        self.abort()

    def on_task_complete(self, task: asyncio.Task[None]) -> None:
        """The app is done with this connection."""
        super().on_task_complete(task)
        self.loop.call_later(_FAREWELL_S, self._break_off)

    def shutdown(self) -> None:
        """The server stops: say so, unless the app has."""
        if self.handshake_complete and not self.close_sent and not self.transport.is_closing():
            self.conn.send_close(_GOING_AWAY, "the service is stopping")
            self.transport.write(b"".join(self.conn.data_to_send()))
            self.close_sent = True
            self.queue.put_nowait({"type": "websocket.disconnect", "code": _GOING_AWAY})
        super().shutdown()
        self.loop.call_later(_STOP_FAREWELL_S, self._break_off)

    def _break_off(self) -> None:
        if not self.disconnected:
            self.abort()


def wire_of(websocket: WebSocket) -> Wire | None:
    """The connection of a WebSocket; None under a server that does not use :class:`Wire`."""
    wire = websocket.scope.get("extensions", {}).get(_EXTENSION)
    return wire if isinstance(wire, Wire) else None
