"""Stopping: accepted work is finished and told, in time, and the process ends well."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

BEGIN = 1_800_000_000
AT = {"captured_at": "2027-01-15T08:00:00Z"}
"""The same moment."""


def closing(connection: ClientConnection) -> tuple[int, str]:
    """Code and reason with which a connection ends; what comes before is skipped."""
    with pytest.raises(ConnectionClosed) as closed:
        _ = [connection.recv(timeout=10) for _ in range(100)]
    assert closed.value.rcvd is not None, closed
    return closed.value.rcvd.code, closed.value.rcvd.reason


def test_what_was_accepted_is_answered_and_published_before_the_end(client: Any, pipeline: Any, tools: Any) -> None:
    gate = pipeline.gates.setdefault(BEGIN * 10**9, threading.Event())
    service = client.app.state.service
    with (
        ThreadPoolExecutor(2) as pool,
        client.stream() as stream,
        httpx.Client(base_url=client.base_url, timeout=20) as keep_alive,
        connect(f"ws://{client.address}/ingest/demo", compression=None) as ingest,
    ):
        assert keep_alive.get("/health/ready").status_code == 200
        posted = pool.submit(tools.detect, client, data=AT)
        tools.wait_until(lambda: pipeline.runs == 1)
        client.ask_to_stop()
        tools.wait_until(lambda: service.phase == "stopping")
        refused = keep_alive.get("/health/ready")
        assert "stopping" in tools.error(refused, 503)["message"]
        assert refused.headers["connection"] == "close"
        assert closing(ingest)[0] == 1001
        with pytest.raises(httpx.ConnectError):
            httpx.get(f"http://{client.address}/health/live")
        gate.set()
        answer = posted.result(10)
        assert answer.status_code == 200
        assert answer.text == stream.recv(timeout=10)
        assert closing(stream) == (1001, "the service is stopping")
    assert service.telemetry.drops() == dict.fromkeys(service.telemetry.drops(), 0)


def test_what_is_not_done_in_time_is_answered_and_counted(
    start: Callable[..., Any], pipeline: Any, tools: Any, caplog: pytest.LogCaptureFixture
) -> None:
    client = start(drain_s=0.5)
    pipeline.gates[BEGIN * 10**9] = threading.Event()
    with ThreadPoolExecutor(1) as pool, client.stream() as stream:
        posted = pool.submit(tools.detect, client, data=AT)
        tools.wait_until(lambda: pipeline.runs == 1)
        client.ask_to_stop()
        assert "ended before" in tools.error(posted.result(10), 503)["message"]
        assert closing(stream)[0] == 1001
    client.join()
    assert client.app.state.service.telemetry.drops()["unfinished"] == 1
    assert "1 frame sets were not finished" in caplog.text


def test_a_reader_that_takes_nothing_keeps_nobody_from_stopping(client: Any, pipeline: Any, tools: Any) -> None:
    """Its connection can never be closed in order, since what is left to send does not go out."""
    with tools.open_and_never_read(client.address):
        pipeline.boxes = type(pipeline.boxes).concatenate([tools.one_box(float(i)) for i in range(400)])
        telemetry = client.app.state.service.telemetry
        for number in range(100):
            tools.detect(client, data={"captured_at": f"2027-01-15T08:00:{number % 60:02d}.{number:03d}Z"})
            if telemetry.drops()["slow_reader"]:
                break
        assert telemetry.drops()["slow_reader"]
        client.ask_to_stop()
        client.join()


def test_a_peer_without_a_sign_of_life_is_cut(start: Callable[..., Any], tools: Any) -> None:
    client = start(ping_s=0.1)
    with client.stream() as alive, tools.open_and_never_read(client.address) as dead:
        assert dead.recv(1 << 16)
        tools.wait_until(lambda: 'quadlift_stream_readers{site="demo"} 1.0' in client.get("/metrics").text)
        with pytest.raises(ConnectionResetError):
            _ = [dead.recv(1 << 16) for _ in range(10)]
        alive.ping().wait(5)
        tools.detect(client, data=AT)
        assert alive.recv(timeout=5)


PROGRAM = """
import threading, time
from types import SimpleNamespace
from service.api.app import create_app
from service.api.server import Server, server_config
from service.logs import configure_logging
from service.settings import Settings

class Runner:
    def warm_up(self): pass
    def run(self, frame_set): raise NotImplementedError

settings = Settings(port=0)
configure_logging("json")
app = create_app(settings, lambda _: Runner())
Server(server_config(settings, app), lambda: app.state.service.drain(), settings.drain_s).run_until_signal()
print("ended", flush=True)
"""


@pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")
def test_sigterm_ends_the_process_with_code_0() -> None:
    child = subprocess.Popen([sys.executable, "-c", PROGRAM], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert child.stderr is not None
    for line in child.stderr:
        if "running on" in line:
            break
    child.send_signal(signal.SIGTERM)
    out, log = child.communicate(timeout=20)
    assert child.returncode == 0, log
    assert out == "ended\n"
    assert "drained" in log


def test_a_warm_up_that_does_not_end_keeps_nobody_from_stopping(start: Callable[..., Any], pipeline: Any) -> None:
    pipeline.warm.clear()
    client = start(ready=False)
    client.ask_to_stop()
    client.join()
    assert not pipeline.warm.is_set()
