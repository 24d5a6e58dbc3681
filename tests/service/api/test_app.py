"""The app as a whole: start, readiness, error form, docs, metrics, unknown exceptions."""

from __future__ import annotations

import asyncio
import json
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

import httpx
import pytest

from service.api.app import create_app, open_store
from service.errors import CalibrationError, PackError
from service.settings import Settings


def test_live_at_once_ready_only_when_warm(start: Callable[..., httpx.Client], pipeline: Any, tools: Any) -> None:
    pipeline.warm.clear()
    client = start(ready=False)
    assert client.get("/health/live").json()["status"] == "live"
    response = client.get("/health/ready")
    assert "warming up" in tools.error(response, 503)["message"]
    assert int(response.headers["retry-after"]) >= 1
    pipeline.warm.set()
    tools.wait_until(lambda: client.get("/health/ready").status_code == 200)
    assert client.get("/health/ready").json()["status"] == "ready"
    assert "quadlift_ready 1.0" in client.get("/metrics").text


def test_a_failed_warm_up_never_becomes_ready(
    start: Callable[..., httpx.Client],
    pipeline: Any,
    tools: Any,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def fail() -> None:
        raise RuntimeError("secret")

    monkeypatch.setattr(pipeline, "warm_up", fail)
    client = start(ready=False)
    tools.wait_until(lambda: "could not" in client.get("/health/ready").text)
    assert "secret" not in tools.error(client.get("/health/ready"), 503)["message"]
    assert "secret" in caplog.text


def test_readiness_tells_of_threads_that_hang(start: Callable[..., Any], pipeline: Any, tools: Any) -> None:
    """With no thread to spare: the caller is answered, and all is well again when the thread is back."""
    gate = pipeline.gates.setdefault(1_800_000_000 * 10**9, threading.Event())
    client = start(run_limit_ms=50, max_abandoned=0)
    hung = tools.error(tools.detect(client, data={"captured_at": "2027-01-15T08:00:00Z"}), 504)
    assert hung["code"] == "run_timeout"
    assert "QUADLIFT_RUN_LIMIT_MS" in hung["remedy"]
    assert "1 of 2 workers hang" in tools.error(client.get("/health/ready"), 503)["message"]
    assert client.get("/health/live").status_code == 200
    metrics = client.get("/metrics").text
    for line in ("quadlift_ready 0.0", "quadlift_workers 1.0", "quadlift_abandoned_workers 1.0"):
        assert f"\n{line}\n" in metrics
    gate.set()
    tools.wait_until(lambda: client.get("/health/ready").status_code == 200)
    metrics = client.get("/metrics").text
    for line in (
        "quadlift_ready 1.0",
        "quadlift_workers 2.0",
        'quadlift_worker_restarts_total{reason="hung"} 1.0',
        'quadlift_dropped_total{reason="hung"} 1.0',
    ):
        assert f"\n{line}\n" in metrics


def test_a_broken_pack_stops_the_start() -> None:
    def broken(_: Settings) -> Any:
        raise PackError("altered")

    app = create_app(Settings(), broken)

    async def run() -> None:
        async with app.router.lifespan_context(app):
            raise AssertionError("it started")

    with pytest.raises(PackError, match="altered"):
        asyncio.run(run())


def test_unknown_addresses_and_methods_have_the_error_form(client: httpx.Client, tools: Any) -> None:
    assert tools.error(client.get("/nowhere"), 404)["code"] == "not_found"
    response = client.get("/detect")
    assert tools.error(response, 405)["code"] == "method_not_allowed"
    assert response.headers["allow"] == "POST"


def test_unknown_exceptions_are_logged_and_generic(client: httpx.Client, tools: Any, caplog: pytest.LogCaptureFixture) -> None:
    @client.app.get("/explode")  # type: ignore[attr-defined]
    async def explode() -> None:
        raise ZeroDivisionError("secret")

    assert "secret" not in str(tools.error(client.get("/explode"), 500))
    assert "ZeroDivisionError: secret" in caplog.text
    assert client.get("/health/live").status_code == 200


def test_docs_describe_the_contract(client: httpx.Client) -> None:
    assert client.get("/docs").status_code == 200
    document = client.get("/openapi.json").json()
    assert {"/detect", "/sites", "/sites/{site}", "/sites/{site}/cameras/{camera}", "/health/ready"} <= set(document["paths"])
    body = document["paths"]["/detect"]["post"]["requestBody"]["content"]
    assert "multipart/form-data" in body
    assert "Detections" in json.dumps(document["components"]["schemas"])


def test_metrics_count_by_route_and_site(client: httpx.Client, tools: Any) -> None:
    tools.detect(client, {"north": tools.jpeg()})
    client.get("/sites/demo")
    client.get("/nowhere/at/all")
    text = client.get("/metrics").text
    assert 'quadlift_frame_sets_total{site="demo"} 1.0' in text
    assert 'quadlift_frames_total{status="missing"} 1.0' in text
    assert 'quadlift_stage_seconds_count{stage="decode"} 1.0' in text
    assert 'quadlift_http_requests_total{route="/sites/{site}",status="200"} 1.0' in text
    assert 'quadlift_http_requests_total{route="unmatched",status="404"} 1.0' in text


def test_sites_are_loaded_at_start_and_kept(tmp_path: Path, tools: Any) -> None:
    file = tmp_path / "demo.json"
    file.write_text(json.dumps(tools.site_body()))
    settings = Settings(data_dir=tmp_path / "kept", sites=(file,))
    assert [s.id for s in open_store(settings).sites()] == ["demo"]
    assert [s.id for s in open_store(Settings(data_dir=tmp_path / "kept")).sites()] == ["demo"]
    file.write_text("{")
    with pytest.raises(CalibrationError) as caught:
        open_store(settings)
    assert str(file) in str(caught.value)


def test_the_viewer_page_and_all_it_refers_to(client: httpx.Client, tools: Any) -> None:
    page = client.get("/")
    assert page.headers["content-type"].startswith("text/html")
    references = re.findall(r'(?:src|href)="([^":]+\.(?:js|css))"', page.text)
    assert references
    for address in references:
        assert client.get(urljoin("/", address)).status_code == 200
    for address in ("/viewer.py", "/viewer/../app.py", "/viewer%2e%2e/app.py", "/viewer.html"):
        tools.error(client.get(address), 404)


def test_the_viewer_page_can_be_switched_off(start: Callable[..., httpx.Client], tools: Any) -> None:
    client = start(viewer=False)
    for address in ("/", "/viewer.js"):
        tools.error(client.get(address), 404)
