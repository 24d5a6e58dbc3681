"""The service as a process of its own, for measurements through its public API."""

from __future__ import annotations

import itertools
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self
from urllib.error import URLError
from urllib.request import urlopen

from benchmarks.measured import Measured
from clients.client import Client, ServiceError
from service.errors import QuadliftError
from service.frames import FrameSet
from service.site import Site, save_site

START_S = 60.0
"""Time that the service gets to load and warm up."""
STOP_S = 15.0


class Served:
    """A ``quadlift serve`` on loopback with one site, while the context lasts."""

    def __init__(self, pack: str, site: Site, workers: int) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="quadlift-bench-")
        site_file = Path(self._folder.name) / "site.json"
        save_site(site, site_file)
        self.port = _free_port()
        options = ["--port", str(self.port), "--site", str(site_file), "--pack", pack, "--workers", str(workers)]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "service.cli", "serve", *options],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )

    @property
    def url(self) -> str:
        """The service's root."""
        return f"http://127.0.0.1:{self.port}"

    def client(self) -> Client:
        """A client of the service, to be used as a context."""
        return Client(self.url)

    def __enter__(self) -> Self:
        deadline = time.monotonic() + START_S
        while time.monotonic() < deadline:
            if self.process.poll() is not None:
                raise QuadliftError(f"the service ended at its start: {self.process.communicate()[1][-2000:]}")
            try:
                with urlopen(f"{self.url}/health/ready", timeout=2):
                    return self
            except (URLError, OSError):
                # Not listening, or not warm yet.
                time.sleep(0.1)
        self._stop()
        raise QuadliftError(f"the service was not ready within {START_S:.0f} s.")

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self._stop()

    def _stop(self) -> None:
        self.process.terminate()
        try:
            self.process.communicate(timeout=STOP_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.communicate()
        self._folder.cleanup()


def run_http(served: Served, sets: Sequence[FrameSet], seconds: float, clients: int, into: Measured) -> None:
    """``clients`` connections, each posting one set after the other. Raises QuadliftError when the service refuses one."""
    lock, counter = threading.Lock(), itertools.count()
    failures: list[ServiceError] = []
    started = time.perf_counter()

    def client() -> None:
        with served.client() as connection:
            while time.perf_counter() - started < seconds:
                frame_set = sets[next(counter) % len(sets)]
                begun = time.perf_counter()
                try:
                    message = connection.detect(frame_set.site.id, {f.camera_id: f.data for f in frame_set.frames})
                except ServiceError as error:
                    with lock:
                        if error.status == 503:
                            into.dropped += 1
                        else:
                            failures.append(error)
                    if failures:
                        return
                    continue
                with lock:
                    into.note(1e3 * (time.perf_counter() - begun), message.timing_ms.model_dump())

    threads = [threading.Thread(target=client) for _ in range(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failures:
        raise QuadliftError(f"the service refused a frame set: {failures[0]}")
    into.seconds += time.perf_counter() - started


def _free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])
