"""The log: JSON lines that a machine can read, context of requests, and a stream that cannot be written."""

from __future__ import annotations

import contextvars
import errno
import io
import json
import logging
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from service.logs import LogHandler, configure_logging, on_behalf_of


@pytest.fixture(autouse=True)
def untouched_root() -> Iterator[None]:
    """The root logger as it was, afterwards."""
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    uvicorn = logging.getLogger("uvicorn.error")
    filters = list(uvicorn.filters)
    yield
    root.handlers[:] = handlers
    root.setLevel(level)
    uvicorn.filters[:] = filters


def written(stream: io.StringIO) -> list[dict[str, Any]]:
    return [json.loads(line) for line in stream.getvalue().rstrip("\n").split("\n")]


def test_a_line_is_one_json_object_whatever_it_says() -> None:
    stream = io.StringIO()
    configure_logging("json", stream=stream)
    logger = logging.getLogger("service.test")
    with on_behalf_of("abc-1"):
        logger.warning('two\nlines and "quotes": %s', "ä\u2028", extra={"site": "demo", "camera": "north"})
    try:
        raise RuntimeError("a network raised")
    except RuntimeError:
        logger.exception("failed")
    first, second = written(stream)
    assert first.pop("time").endswith("+00:00")
    assert first == {
        "level": "warning", "logger": "service.test", "message": 'two\nlines and "quotes": ä\u2028',
        "request_id": "abc-1", "site": "demo", "camera": "north",
    }  # fmt: skip
    assert "request_id" not in second
    assert second["exception"].splitlines()[-1] == "RuntimeError: a network raised"


def test_a_line_of_text_cannot_be_forged() -> None:
    stream = io.StringIO()
    configure_logging("text", stream=stream)
    logging.getLogger("service.test").warning("from outside: %s", "x\nERROR service: forged", extra={"site": "demo"})
    assert stream.getvalue() == "WARNING service.test: from outside: x\\nERROR service: forged [site=demo]\n"


@pytest.mark.parametrize(("level", "count"), [("debug", 3), ("info", 2), ("error", 1)])
def test_levels(level: str, count: int) -> None:
    stream = io.StringIO()
    configure_logging("json", level, stream)
    logger = logging.getLogger("service.test")
    for write in (logger.debug, logger.info, logger.error):
        write("line")
    assert len(written(stream)) == count


def test_an_id_goes_along_with_its_context_and_nowhere_else() -> None:
    stream = io.StringIO()
    configure_logging("json", stream=stream)
    logger = logging.getLogger("service.test")
    with on_behalf_of("mine"):
        context = contextvars.copy_context()
    for work in (lambda: context.run(logger.info, "with"), lambda: logger.info("without")):
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert [line.get("request_id") for line in written(stream)] == ["mine", None]


class FullDisk(io.StringIO):
    def write(self, text: str) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")


def test_a_log_that_cannot_be_written_loses_lines_and_nothing_else(capsys: pytest.CaptureFixture[str]) -> None:
    configure_logging("json", stream=FullDisk())
    for _ in range(3):
        logging.getLogger("service.test").error("line")
    handler = next(one for one in logging.getLogger().handlers if isinstance(one, LogHandler))
    assert handler.lost == 3
    assert capsys.readouterr().err == ""


def test_handshakes_are_not_logged_with_their_queries() -> None:
    stream = io.StringIO()
    configure_logging("json", stream=stream)
    uvicorn = logging.getLogger("uvicorn.error")
    uvicorn.info('%s - "WebSocket %s" [accepted]', "peer", "/stream/demo?secret=1")
    uvicorn.info("connection open")
    uvicorn.info("Shutting down")
    assert [line["message"] for line in written(stream)] == ["Shutting down"]
