"""The service as a process of its own, for measurements through its public API."""

from __future__ import annotations

import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import Self
from urllib.error import URLError
from urllib.request import urlopen

from clients.client import Client
from service.errors import QuadliftError
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
        self._process = subprocess.Popen(
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
            if self._process.poll() is not None:
                raise QuadliftError(f"the service ended at its start: {self._process.communicate()[1][-2000:]}")
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
        self._process.terminate()
        try:
            self._process.communicate(timeout=STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()
        self._folder.cleanup()


def _free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])
