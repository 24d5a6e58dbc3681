"""Whether a frame set is worth dividing between worker processes: that answers it sooner and costs more processor time."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

DEAR = 1.08
"""Processor time of a set that is divided in two over that of one that is not: NumPy's calls are as many for half the boxes."""
MOST_LOAD = 0.75
"""Of all processes' time, counted in whole sets. Beyond it sets that are divided, whose processes wait for one another, would
fall behind: measured on two cores (docs: operations)."""
_NEW = 0.1
"""Weight of a new set in the running mean of what sets cost."""
_ARRIVALS = 16
"""Sets whose arrivals say how often they come: a pause is forgotten when so many have come after it."""


class Division:
    """What sets cost lately and how often they come. Thread-safe."""

    def __init__(self, processes: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._processes = processes
        self._clock = clock
        self._lock = threading.Lock()
        self._arrivals: deque[float] = deque(maxlen=_ARRIVALS + 1)
        self._cost_s = 0.0

    @property
    def part_s(self) -> float:
        """What half a set takes."""
        return 0.5 * DEAR * self._cost_s

    def arrived(self) -> None:
        """A set is there to be run."""
        with self._lock:
            self._arrivals.append(self._clock())

    def took(self, seconds: float, *, divided: bool) -> None:
        """A set took so long, in all processes that worked at it together."""
        with self._lock:
            whole = seconds / DEAR if divided else seconds
            self._cost_s += _NEW * (whole - self._cost_s) if self._cost_s else whole

    def pays(self) -> bool:
        """Whether all sets could be divided, as often as they come, and still be run in time."""
        with self._lock:
            if len(self._arrivals) < 2:
                return True
            interval_s = (self._arrivals[-1] - self._arrivals[0]) / (len(self._arrivals) - 1)
            return self._cost_s <= MOST_LOAD * self._processes * interval_s
