"""How long a frame set may run before its worker counts as hung."""

from __future__ import annotations

import statistics
import threading
from collections import deque

LIMIT_FRAMES = 4
"""Frames of a set for which a limit stands; a larger set may run longer in proportion."""
SLOWER = 8.0
"""A set that takes so many times longer than sets do lately hangs, rather than being slow as the others are."""
RUNS = 16
"""How many runs back "lately" goes. Their median counts, so that a few that did hang and came back change nothing."""


class RunLimit:
    """A limit for every set, from a fixed floor and, if it adapts, from how long sets took lately. Thread-safe.

    A machine that has become slow (too hot, other processes) must not have all its workers declared hung.
    """

    def __init__(self, floor_s: float, *, adapts: bool = False) -> None:
        """floor_s: seconds that a set of up to four frames may run in any case."""
        self._floor_s = floor_s
        self._adapts = adapts
        self._usual_s = 0.0
        self._runs_s: deque[float] = deque(maxlen=RUNS)
        self._lock = threading.Lock()

    def note(self, took_s: float, frames: int) -> None:
        """A set of so many frames came to its end, also one that had been given up before."""
        with self._lock:
            self._runs_s.append(took_s / _share(frames))
            self._usual_s = statistics.median(self._runs_s)

    def seconds(self, frames: int) -> float:
        """What a set of so many frames may take."""
        usual_s = self._usual_s if self._adapts else 0.0
        return max(self._floor_s, SLOWER * usual_s) * _share(frames)


def _share(frames: int) -> float:
    return max(1.0, frames / LIMIT_FRAMES)
