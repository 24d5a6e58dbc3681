"""How many workers, with how many threads in the networks each, do most on this machine: measured, not guessed."""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from service.errors import InputError
from service.frames import FrameSet
from service.scheduler import FrameSetRunner, Scheduler, StoppableRunner

if TYPE_CHECKING:
    from service.pipeline import SetResult

ROUNDS = 4
"""The candidates take turns this often, so that a drifting machine treats all alike."""
_MIN_SETS = 2
"""Sets that a turn runs at least, however long they take."""
_DEADLINE_S = 3600.0


@dataclass(frozen=True, order=True)
class Candidate:
    """One way to use the cores."""

    workers: int
    intra_op_threads: int

    def settings(self) -> dict[str, str]:
        """The environment of a service that works so."""
        return {"QUADLIFT_WORKERS": str(self.workers), "QUADLIFT_INTRA_OP_THREADS": str(self.intra_op_threads)}


@dataclass(eq=False)
class Trial:
    """What a candidate did."""

    candidate: Candidate
    sets: int = 0
    seconds: float = 0.0
    latency_ms: list[float] = field(default_factory=list)
    """Of every set, from its arrival to its boxes, with as many sets at a time as there are workers."""

    @property
    def sets_per_second(self) -> float:
        """Throughput over all turns."""
        return self.sets / self.seconds if self.seconds else 0.0

    def latency_percentile_ms(self, percent: float) -> float:
        """A percentile of the latency; infinity when nothing was run."""
        return float(np.percentile(self.latency_ms, percent)) if self.latency_ms else float("inf")


def candidates(cores: int) -> list[Candidate]:
    """Workers and threads in powers of two that fill at most ``cores``, all cores one way or the other, and one worker more."""
    counts = sorted({1 << power for power in range(cores.bit_length()) if 1 << power <= cores} | {cores})
    found = {
        Candidate(workers, threads) for workers, threads in itertools.product(counts, counts) if workers * threads <= cores
    }
    # While one worker's answer is on its way, another one may use its core.
    return sorted(found | {Candidate(cores + 1, 1)})


def measure(
    load: Callable[[Candidate], FrameSetRunner],
    frame_sets: Sequence[FrameSet],
    tried: Sequence[Candidate],
    seconds: float,
    clock: Callable[[], float] = time.perf_counter,
) -> list[Trial]:
    """Run the candidates in turns for about ``seconds`` together, loading aside; gives one trial each, in their order.

    load: what a service would run frame sets with, warm; asked once for each candidate.
    """
    trials = [Trial(candidate) for candidate in tried]
    sets = itertools.cycle(frame_sets)
    with ExitStack() as stack:
        runners = []
        for candidate in tried:
            runners.append(runner := load(candidate))
            if isinstance(runner, StoppableRunner):
                stack.callback(runner.close)
        for _ in range(ROUNDS):
            for trial, runner in zip(trials, runners, strict=True):
                _take_turn(trial, runner, sets, seconds / ROUNDS / len(trials), clock)
    return trials


def best(trials: Sequence[Trial], max_latency_ms: float) -> tuple[Trial, bool]:
    """The trial with the most sets a second among those whose p99 latency keeps the limit, and True.

    When none does: the one with the lowest latency, and False.
    """
    if not trials:
        raise InputError("nothing was tried.", field="candidates", remedy="Name at least one.")
    kept = [trial for trial in trials if trial.latency_percentile_ms(99) <= max_latency_ms]
    if kept:
        return max(kept, key=lambda trial: trial.sets_per_second), True
    return min(trials, key=lambda trial: trial.latency_percentile_ms(99)), False


def with_settings(text: str, settings: dict[str, str]) -> str:
    """An environment file's text with these settings: its lines for them are replaced, all others stay."""
    lines = [line for line in text.splitlines() if line.partition("=")[0].strip() not in settings]
    return "\n".join([*lines, *(f"{name}={value}" for name, value in settings.items())]) + "\n"


def _take_turn(
    trial: Trial,
    runner: FrameSetRunner,
    sets: itertools.cycle[FrameSet],
    seconds: float,
    clock: Callable[[], float],
) -> None:
    workers = trial.candidate.workers
    scheduler = Scheduler(runner, workers=workers, queue_size=workers, deadline_s=_DEADLINE_S)
    flying: deque[tuple[float, Future[SetResult]]] = deque()
    begun = 0
    started = clock()
    try:
        while True:
            while len(flying) < workers and (begun < _MIN_SETS or clock() - started < seconds):
                flying.append((clock(), scheduler.enqueue(next(sets))))
                begun += 1
            if not flying:
                break
            sent_at, future = flying.popleft()
            future.result()
            trial.sets += 1
            trial.latency_ms.append(1e3 * (clock() - sent_at))
    finally:
        trial.seconds += clock() - started
        scheduler.stop()
