from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
import webbrowser
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from clients import demo, local_service
from clients.client import Client, ServiceError
from clients.clip import SHIPPED, open_clip
from clients.demo import DemoError, Progress, replay
from clients.local_service import LocalServiceError
from service.schemas import Detections, Timing


class ScriptedClient(Client):
    """Answers with no boxes, after a while, or refuses."""

    def __init__(self, delay_s: float = 0.0, error: ServiceError | None = None) -> None:
        super().__init__("http://test")
        self.delay_s, self.error = delay_s, error
        self.times: list[datetime] = []

    def detect(self, site: str, frames: Mapping[str, bytes], captured_at: Any = None, per_camera: bool = False) -> Detections:
        assert site == "demo"
        assert set(frames) == {"north", "east"}
        self.times.append(captured_at)
        time.sleep(self.delay_s)
        if self.error is not None:
            raise self.error
        timing = Timing(**dict.fromkeys(Timing.model_fields, 1.0))
        return Detections(site=site, sequence=1, captured_at="", boxes=[], cameras={}, degraded=False, timing_ms=timing)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def start_demo(port: int, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", "from clients.demo import app; app()", "--port", str(port), "--no-browser", *arguments]
    environment = os.environ | {"PYTHONUNBUFFERED": "1", "COLUMNS": "200"}
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)


def is_listening(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def test_the_clip_is_sent_in_real_time(clip_folder: Path) -> None:
    progress = Progress()
    with ScriptedClient() as client:
        began = time.monotonic()
        replay(client, open_clip(clip_folder), 50.0, 0.4, progress, "http://test")
        took = time.monotonic() - began
    assert progress.answered + progress.skipped == 20
    assert took > 0.37
    assert client.times == sorted(set(client.times))
    sent_for = (client.times[-1] - client.times[0]).total_seconds()
    assert sent_for == pytest.approx(19 / 50, abs=0.05)


def test_a_slow_service_misses_steps_instead_of_falling_behind(clip_folder: Path) -> None:
    progress = Progress()
    with ScriptedClient(delay_s=0.1) as client:
        replay(client, open_clip(clip_folder), 50.0, 0.6, progress, "http://test")
    assert progress.answered <= 7
    assert progress.skipped >= 20
    assert progress.latency_ms >= 100


def test_refusals_are_counted_and_too_many_end_the_demo(clip_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "FAILURES_IN_A_ROW", 3)
    progress = Progress()
    with ScriptedClient(error=ServiceError("overloaded", "busy.")) as client, pytest.raises(DemoError, match="busy"):
        replay(client, open_clip(clip_folder), 50.0, None, progress, "http://test")
    assert (progress.answered, progress.failed) == (0, 3)
    assert "busy" in demo.summary(progress)


def test_a_taken_port_gives_way_to_a_free_one() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert local_service.free_port(port) not in (0, port)


def test_a_service_that_does_not_start_says_why(tmp_path: Path) -> None:
    broken = tmp_path / "site.json"
    broken.write_text('{"id": "no good"}')
    with (
        pytest.raises(LocalServiceError, match=r"(?s)did not start.*site\.json"),
        local_service.running_service(broken, free_port()),
    ):
        pytest.fail("a service came up on a broken site")


def test_without_a_display_the_address_is_printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda url: bool(opened.append(url)) or True)
    monkeypatch.setattr(demo, "has_display", lambda: False)
    demo.announce("http://127.0.0.1:1", browser=True)
    assert opened == []
    assert "http://127.0.0.1:1" in capsys.readouterr().out
    monkeypatch.setattr(demo, "has_display", lambda: True)
    demo.announce("http://127.0.0.1:1", browser=False)
    assert opened == []
    demo.announce("http://127.0.0.1:1", browser=True)
    assert opened == ["http://127.0.0.1:1"]


def test_a_missing_clip_is_an_error_not_a_traceback(tmp_path: Path) -> None:
    process = start_demo(0, "--clip", str(tmp_path))
    output, _ = process.communicate(timeout=30)
    assert process.returncode == 1
    assert "site.json" in output
    assert "Traceback" not in output


def test_the_demo_shows_boxes_and_ends_by_itself() -> None:
    process = start_demo(free_port(), "--seconds", "2")
    output, _ = process.communicate(timeout=90)
    assert process.returncode == 0, output
    found = re.search(r"(\d+) frame sets answered, (\d+) refused, (\d+) skipped", output)
    assert found is not None, output
    answered, refused, skipped = (int(number) for number in found.groups())
    assert answered + skipped == 20
    assert answered >= 5
    assert refused == 0


@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_demo_and_its_service(how: signal.Signals) -> None:
    port = free_port()
    process = start_demo(port)
    assert process.stdout is not None
    try:
        for line in process.stdout:
            if "Live page" in line:
                break
        assert is_listening(port)
        time.sleep(0.5)
        process.send_signal(how)
        output = process.stdout.read()
        assert process.wait(30) == 0, output
    finally:
        process.kill()
        process.stdout.close()
        process.wait()
    assert "frame sets answered" in output
    assert not is_listening(port)


def test_the_shipped_site_is_what_the_demo_asks_for() -> None:
    assert open_clip(SHIPPED).site["id"] == "demo"
