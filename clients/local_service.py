"""The service as a child process on loopback: for the demo, for measurements, for trying things."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import httpx

HOST = "127.0.0.1"
READY_TIMEOUT_S = 60.0
"""Loading and warming the networks takes a few seconds; a slow disk may take longer."""
STOP_TIMEOUT_S = 15.0
"""More than the service takes to finish its work."""
_POLL_S = 0.1
SERVE = "from service.cli import main; main()"
"""What the child process runs."""


class LocalServiceError(Exception):
    """The service could not be started; the message holds its last words."""


@contextmanager
def running_service(
    site_file: Path, port: int, options: Sequence[str] = (), *, program: str = SERVE, variables: Mapping[str, str] | None = None
) -> Iterator[subprocess.Popen[bytes]]:
    """The service with one site as a child process, for as long as the block runs.

    options: further arguments of ``quadlift serve``. program: what takes them instead. variables: added to its environment.
    Raises LocalServiceError with its log when it does not start.
    """
    environment = child_environment() | dict(variables or {})
    command = [sys.executable, "-P", "-c", program, "serve"]
    command += ["--host", HOST, "--port", str(port), "--site", str(site_file), *options]
    with tempfile.TemporaryFile() as log:
        # In a session of its own, Ctrl-C reaches the parent alone, which then stops its child in order.
        child = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, start_new_session=True, env=environment)
        try:
            _wait_until_ready(child, f"http://{HOST}:{port}")
            yield child
        except LocalServiceError as error:
            if child.poll() is None:
                raise
            raise LocalServiceError(f"{error} The service's last words:\n{_tail(log)}") from error
        finally:
            _stop(child)


def child_environment() -> dict[str, str]:
    """The environment in which a child process finds the packages beside this one.

    Start it with ``-P``, or in another folder: otherwise it takes those of the working directory.
    """
    beside = str(Path(__file__).resolve().parents[1])
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [beside, os.environ.get("PYTHONPATH")]))}


def free_port(wanted: int) -> int:
    """``wanted`` if it can be listened on, else a free port."""
    for port in (wanted, 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, port))
            except OSError:
                continue
            chosen: int = probe.getsockname()[1]
            return chosen
    raise LocalServiceError(f"no TCP port can be opened on {HOST}.")


def _wait_until_ready(child: subprocess.Popen[bytes], url: str) -> None:
    deadline = time.monotonic() + READY_TIMEOUT_S
    while child.poll() is None:
        try:
            if httpx.get(f"{url}/health/ready", timeout=2.0).is_success:
                return
        except httpx.TransportError:
            # Not listening yet; the deadline decides.
            pass
        if time.monotonic() > deadline:
            raise LocalServiceError(f"the service was not ready after {READY_TIMEOUT_S:.0f} s.")
        time.sleep(_POLL_S)
    raise LocalServiceError("the service did not start.")


def _stop(child: subprocess.Popen[bytes]) -> None:
    child.terminate()
    try:
        child.wait(STOP_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()


def _tail(log: IO[bytes], lines: int = 15) -> str:
    log.seek(0)
    return "\n".join(log.read().decode("utf-8", "replace").splitlines()[-lines:]) or "(it printed nothing)"
