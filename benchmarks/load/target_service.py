"""The service under test: a child process with its sites, its counters and its memory."""

from __future__ import annotations

import asyncio
import subprocess
import tempfile
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from prometheus_client.parser import text_string_to_metric_families

from benchmarks.load.process_tree import tree_rss_bytes
from clients.client import AsyncClient
from clients.local_service import HOST, SERVE, free_port, running_service
from service.site import parse_site, save_site

_METRICS_S = 10.0
_PREFIX = "quadlift_"


@dataclass(frozen=True)
class Target:
    """A running service."""

    url: str
    process: subprocess.Popen[bytes]
    data_dir: Path

    @property
    def rss_bytes(self) -> int:
        """Resident memory of the process and of those that it started; 0 when it has ended."""
        return tree_rss_bytes(self.process.pid)


@dataclass(frozen=True)
class Counters:
    """What ``/metrics`` said at one moment."""

    values: Mapping[tuple[str, tuple[tuple[str, str], ...]], float]

    def total(self, name: str, **labels: str) -> int:
        """Sum of a counter's series with these labels; the name without ``quadlift_`` and ``_total``."""
        full = f"{_PREFIX}{name}"
        wanted = labels.items()
        matching = (v for (n, own), v in self.values.items() if n in (full, f"{full}_total") and wanted <= dict(own).items())
        return int(sum(matching))

    def by_label(self, name: str, label: str) -> dict[str, int]:
        """A counter's sums by the value of one label."""
        full, sums = f"{_PREFIX}{name}_total", dict[str, int]()
        for (n, own), value in self.values.items():
            if n == full:
                key = dict(own)[label]
                sums[key] = sums.get(key, 0) + int(value)
        return sums


@contextmanager
def target_service(
    site: Mapping[str, Any], *, program: str = SERVE, variables: Mapping[str, str] | None = None
) -> Iterator[Target]:
    """The service with one site and a data folder of its own. Raises LocalServiceError."""
    with tempfile.TemporaryDirectory(prefix="quadlift-robust-") as folder:
        site_file, data_dir = Path(folder) / "site.json", Path(folder) / "data"
        save_site(parse_site(site), site_file)
        port = free_port(0)
        options = ["--data-dir", str(data_dir)]
        with running_service(site_file, port, options, program=program, variables=variables) as process:
            yield Target(f"http://{HOST}:{port}", process, data_dir)


@asynccontextmanager
async def serving(site: Mapping[str, Any], **options: Any) -> AsyncIterator[Target]:
    """The same for asyncio code, whose tasks go on while it starts and ends."""
    running = target_service(site, **options)
    starting = asyncio.create_task(asyncio.to_thread(running.__enter__))
    try:
        target = await asyncio.shield(starting)
    except asyncio.CancelledError:
        # The thread cannot be cancelled: what it has started is stopped, not left behind.
        await asyncio.wait({starting})
        if starting.exception() is None:
            await asyncio.to_thread(running.__exit__, None, None, None)
        raise
    try:
        yield target
    finally:
        await asyncio.to_thread(running.__exit__, None, None, None)


async def put_sites(url: str, sites: Mapping[str, Mapping[str, Any]]) -> None:
    """Add sites, by id. Raises ServiceError."""
    async with AsyncClient(url) as client:
        for document in sites.values():
            await client.put_site(dict(document))


def read_counters(url: str) -> Counters:
    """The counters now. Raises httpx.HTTPError when the service does not give them."""
    response = httpx.get(f"{url}/metrics", timeout=_METRICS_S)
    response.raise_for_status()
    families = text_string_to_metric_families(response.text)
    return Counters({(s.name, tuple(sorted(s.labels.items()))): s.value for family in families for s in family.samples})
