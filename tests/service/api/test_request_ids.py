"""Request ids: taken when they look like one, made otherwise, in answers, handshakes, refusals and logs."""

from __future__ import annotations

import logging
from typing import Any

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from service.logs import request_id


def test_a_callers_id_comes_back(client: Any) -> None:
    for given in ("job-17", "A", "a.b_c-d", "x" * 64):
        for path in ("/health/live", "/sites/nowhere", "/no/such/address"):
            assert client.get(path, headers={"X-Request-ID": given}).headers.get_list("x-request-id") == [given]


def test_what_is_no_id_is_replaced(client: Any) -> None:
    seen = set()
    for given in ("", "two words", "x" * 65, "-leading", 'quote"', "né"):
        made = client.get("/health/live", headers={"X-Request-ID": given.encode()}).headers["x-request-id"]
        assert len(made) == 32
        assert int(made, 16) >= 0
        seen.add(made)
    assert len(seen) == 6


def test_a_websocket_has_one_id(client: Any) -> None:
    headers = {"X-Request-ID": "reader-1"}
    with connect(f"ws://{client.address}/stream/demo", additional_headers=headers, compression=None) as stream:
        assert stream.response is not None
        assert stream.response.headers["x-request-id"] == "reader-1"
    with pytest.raises(InvalidStatus) as caught:
        connect(f"ws://{client.address}/stream/nowhere", additional_headers=headers)
    assert caught.value.response.headers["x-request-id"] == "reader-1"


def test_the_workers_log_on_the_callers_behalf(client: Any, pipeline: Any, tools: Any, caplog: Any) -> None:
    seen: list[str | None] = []

    class Watch(logging.Filter):
        def filter(self, record: logging.LogRecord) -> bool:
            seen.append(request_id.get())
            return True

    pipeline.failure = RuntimeError("a network raised")
    client.headers["X-Request-ID"] = "mine"
    watch, logger = Watch(), logging.getLogger("service.scheduler")
    logger.addFilter(watch)
    try:
        assert tools.detect(client).status_code == 500
    finally:
        logger.removeFilter(watch)
    assert seen == ["mine"]
