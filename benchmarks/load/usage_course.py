"""What a process tree uses over time, and whether it grows once it is warm."""

from __future__ import annotations

import asyncio
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from benchmarks.load.process_tree import TreeUsage, tree_usage

MAX_GROWTH_BYTES = 16 * 2**20
"""Of the memory, after warm-up."""
WINDOWS = 8
"""Parts of the time after warm-up; of each the median counts, so that a passing peak is no growth."""
_WARM_UP_SHARE = 0.2
_WARM_UP_S = 60.0
_SAMPLES = 240
_MIN_PERIOD_S = 0.25


@dataclass(frozen=True)
class UsageCourse:
    """Samples of one tree."""

    root: int
    """Process id."""
    samples: list[tuple[float, TreeUsage]] = field(default_factory=list)
    """Seconds since the first one, and what was used then."""

    async def watch(self, seconds: float) -> None:
        """Take samples until cancelled; seconds: about how long that will be."""
        period_s = max(_MIN_PERIOD_S, seconds / _SAMPLES)
        began = time.monotonic()
        while True:
            self.samples.append((time.monotonic() - began, await asyncio.to_thread(tree_usage, self.root)))
            await asyncio.sleep(period_s)


def course_figures(samples: Sequence[tuple[float, TreeUsage]], seconds: float) -> dict[str, Any]:
    """The figures of a course of so many seconds: growth is that of the largest window's median over the first window's."""
    warm_s = min(_WARM_UP_S, _WARM_UP_SHARE * seconds)
    warm = [sample for sample in samples if warm_s <= sample[0] <= seconds]
    windows = _windows(warm, warm_s, seconds)
    memory = _medians(windows, lambda usage: usage.pss_bytes)
    threads = _medians(windows, lambda usage: usage.threads)
    fds = _medians(windows, lambda usage: usage.fds)
    growths = {name: max(series) - series[0] for name, series in (("memory", memory), ("threads", threads), ("fds", fds))}
    took = warm[-1][0] - warm[0][0]
    return {
        "processes": max(usage.processes for _, usage in warm),
        "warm_up_s": round(warm_s, 1),
        "cpu_cores": round((warm[-1][1].cpu_s - warm[0][1].cpu_s) / took, 3) if took else None,
        "memory_is": "Pss of all processes together",
        "memory_mib": [_mib(value) for value in memory],
        "memory_growth_mib": _mib(growths["memory"]),
        "max_memory_growth_mib": _mib(MAX_GROWTH_BYTES),
        "rss_mib": _mib(warm[-1][1].rss_bytes),
        "threads": [round(value) for value in threads],
        "threads_peak": max(usage.threads for _, usage in warm),
        "fds": [round(value) for value in fds],
        "fds_peak": max(usage.fds for _, usage in warm),
        "passed": growths["memory"] <= MAX_GROWTH_BYTES and growths["threads"] <= 0 and growths["fds"] <= 0,
    }


def _windows(warm: Sequence[tuple[float, TreeUsage]], warm_s: float, seconds: float) -> list[list[TreeUsage]]:
    windows: list[list[TreeUsage]] = [[] for _ in range(WINDOWS)]
    for at_s, usage in warm:
        windows[min(WINDOWS - 1, int(WINDOWS * (at_s - warm_s) / (seconds - warm_s)))].append(usage)
    return [window for window in windows if window]


def _medians(windows: Sequence[Sequence[TreeUsage]], value: Callable[[TreeUsage], int]) -> list[float]:
    return [statistics.median(value(usage) for usage in window) for window in windows]


def _mib(size: float) -> float:
    return round(size / 2**20, 1)
