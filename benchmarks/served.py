"""The service as a process of its own, for measurements through its public API."""

from __future__ import annotations

import itertools
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from benchmarks.measured import Measured
from clients.client import Client, ServiceError
from clients.local_service import HOST, LocalServiceError, free_port, running_service
from service.errors import QuadliftError
from service.frames import FrameSet
from service.nets.providers import Provider
from service.site import Site, save_site


@contextmanager
def served(pack: str, provider: Provider, site: Site, workers: int) -> Iterator[str]:
    """The root URL of a ``quadlift serve`` with one site, for as long as the block runs. Raises QuadliftError."""
    with tempfile.TemporaryDirectory(prefix="quadlift-bench-") as folder:
        site_file = Path(folder) / "site.json"
        save_site(site, site_file)
        port = free_port(0)
        try:
            with running_service(site_file, port, ["--pack", pack, "--provider", provider, "--workers", str(workers)]):
                yield f"http://{HOST}:{port}"
        except LocalServiceError as error:
            raise QuadliftError(str(error)) from error


def run_http(url: str, sets: Sequence[FrameSet], seconds: float, clients: int, into: Measured) -> None:
    """``clients`` connections, each posting one set after the other. Raises QuadliftError when the service refuses one."""
    lock, counter = threading.Lock(), itertools.count()
    failures: list[ServiceError] = []
    started = time.perf_counter()

    def client() -> None:
        with Client(url) as connection:
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
                    into.note(1e3 * (time.perf_counter() - begun), message.timing_ms.model_dump(exclude_unset=True))

    threads = [threading.Thread(target=client) for _ in range(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failures:
        raise QuadliftError(f"the service refused a frame set: {failures[0]}")
    into.seconds += time.perf_counter() - started
