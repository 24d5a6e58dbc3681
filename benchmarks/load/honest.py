"""An honest client beside an attack: its latency before and during, and the memory that the attack costs."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, TypeVar

import numpy as np

from benchmarks.load.target_service import Target
from clients.client import AsyncClient, ServiceError, Timeouts
from clients.clip import Clip

MAX_EXTRA_BYTES = 64 * 2**20
MAX_GROWTH = 1.5
"""Of the honest client's p99."""
PERIOD_S = 0.2
"""Between two of its requests: a light, steady load, so that what is seen is the attack's doing."""
_SAMPLE_S = 0.1
_ANSWER_S = 20.0

_T = TypeVar("_T")


@dataclass
class Watched:
    """What an honest client and the process's memory saw for a time."""

    latencies_ms: list[float] = field(default_factory=list)
    failures: Counter[str] = field(default_factory=Counter)
    """Requests that were not answered well, by status or code."""
    requests: int = 0
    site_restored: int = 0
    """Times that the site was gone and had to be put again: an attacker may delete what it may write."""
    rss_bytes: list[int] = field(default_factory=list)

    @property
    def p99_ms(self) -> float:
        """Of the answered requests."""
        return float(np.percentile(self.latencies_ms, 99)) if self.latencies_ms else float("nan")


class HonestClient:
    """Posts sets of a site at a steady pace."""

    def __init__(self, target: Target, clip: Clip) -> None:
        self._target, self._clip = target, clip

    async def during(self, work: Callable[[], Awaitable[_T]]) -> tuple[_T, Watched]:
        """Watch for as long as some work takes."""
        watched = Watched()
        watching = [asyncio.create_task(self._post_all(watched)), asyncio.create_task(self._sample(watched))]
        try:
            outcome = await work()
        finally:
            for task in watching:
                task.cancel()
            await asyncio.gather(*watching, return_exceptions=True)
        return outcome, watched

    async def _sample(self, watched: Watched) -> None:
        while True:
            watched.rss_bytes.append(self._target.rss_bytes)
            await asyncio.sleep(_SAMPLE_S)

    async def _post_all(self, watched: Watched) -> None:
        async with AsyncClient(self._target.url, Timeouts(answer_s=_ANSWER_S)) as client:
            for moment in self._clip.play(0):
                began = time.perf_counter()
                await self._post(client, self._clip.frames(moment.step), watched)
                await asyncio.sleep(max(0.0, PERIOD_S - (time.perf_counter() - began)))

    async def _post(self, client: AsyncClient, frames: dict[str, bytes], watched: Watched) -> None:
        began = time.perf_counter()
        watched.requests += 1
        try:
            await client.detect(self._clip.site["id"], frames, datetime.now(UTC))
        except ServiceError as error:
            if error.status in (404, 422):
                # The site was deleted or changed by the attack.
                watched.site_restored += 1
                await self._restore(client, watched)
                return
            watched.failures[str(error.status or error.code)] += 1
        else:
            watched.latencies_ms.append(1e3 * (time.perf_counter() - began))

    async def _restore(self, client: AsyncClient, watched: Watched) -> None:
        try:
            await client.put_site(self._clip.site)
        except ServiceError as error:
            watched.failures[str(error.status or error.code)] += 1


def compare(before: Watched, during: Watched) -> dict[str, Any]:
    """The figures of one attack, and whether they keep the limits."""
    extra = max(during.rss_bytes, default=0) - max(before.rss_bytes, default=0)
    growth = during.p99_ms / before.p99_ms
    return {
        "honest_p99_before_ms": round(before.p99_ms, 1),
        "honest_p99_during_ms": round(during.p99_ms, 1),
        "honest_growth": round(growth, 3),
        "max_growth": MAX_GROWTH,
        "honest_requests": during.requests,
        "honest_failures": dict(during.failures),
        "site_restored": during.site_restored,
        "extra_rss_mib": round(extra / 2**20, 1),
        "max_extra_rss_mib": MAX_EXTRA_BYTES // 2**20,
        # NaN, where nobody was answered, keeps no limit.
        "kept_limits": growth <= MAX_GROWTH and extra <= MAX_EXTRA_BYTES and not during.failures,
    }
