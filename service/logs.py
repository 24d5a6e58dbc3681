"""The service's log: lines for people or JSON objects, each with the request, site and camera that it is about.

A log that cannot be written (full disk, closed pipe) loses lines and nothing else.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any, Literal, TextIO

import orjson

LogFormat = Literal["text", "json"]

request_id: ContextVar[str | None] = ContextVar("quadlift_request_id", default=None)
"""Id of the request or connection on whose behalf something is done."""

_FIELDS = ("request_id", "site", "camera")
"""What a record may carry beside its message; ``logger.info(..., extra={"site": ..., "camera": ...})``."""


@contextmanager
def on_behalf_of(identity: str | None) -> Iterator[None]:
    """Let the lines that are written within carry a request's id."""
    token = request_id.set(identity)
    try:
        yield
    finally:
        request_id.reset(token)


def configure_logging(format: LogFormat, level: str = "info", stream: TextIO | None = None) -> None:
    """Send the logs of the whole process to a stream (default: standard error), in place of where they went before.

    level: the least important lines that are written: debug, info, warning or error.
    """
    handler = LogHandler(sys.stderr if stream is None else stream)
    handler.setFormatter(JsonLines() if format == "json" else TextLines())
    root = logging.getLogger()
    for other in list(root.handlers):
        root.removeHandler(other)
    root.addHandler(handler)
    root.setLevel(level.upper())
    # Of connections we have lines of our own, which name the site.
    logging.getLogger("uvicorn.error").addFilter(_is_not_of_a_connection)


class LogHandler(logging.StreamHandler[TextIO]):
    """Writes lines; what cannot be written is counted in ``lost``, and the process goes on."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__(stream)
        self.lost = 0

    def handleError(self, record: logging.LogRecord) -> None:
        """Count a line that was lost. There is nobody left to tell."""
        self.lost += 1


class JsonLines(logging.Formatter):
    """One JSON object a line: time (RFC 3339), level, logger, message; request_id, site, camera and exception where known."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as JSON; never more than one line."""
        document: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **_context(record),
        }
        if record.exc_info:
            document["exception"] = self.formatException(record.exc_info)
        return orjson.dumps(document, default=str).decode()


class TextLines(logging.Formatter):
    """``LEVEL logger: message [site=demo request_id=...]``, then a traceback if there is one."""

    def __init__(self) -> None:
        super().__init__("%(levelname)s %(name)s: %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:
        """The line before any traceback. What comes from outside is kept from looking like a line of its own."""
        line = super().formatMessage(record).replace("\n", "\\n").replace("\r", "\\r")
        context = " ".join(f"{name}={value}" for name, value in _context(record).items())
        return f"{line} [{context}]" if context else line


def _context(record: logging.LogRecord) -> dict[str, Any]:
    own = {name: getattr(record, name, None) for name in _FIELDS}
    own["request_id"] = own["request_id"] or request_id.get()
    return {name: value for name, value in own.items() if value is not None}


def _is_not_of_a_connection(record: logging.LogRecord) -> bool:
    text = str(record.msg)
    return "WebSocket" not in text and not text.startswith("connection ")
