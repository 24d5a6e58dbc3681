"""The scheduler: bounded queue, deadline, isolation of failures, graceful stop; each drop counted with its reason."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any

import pytest

from service.errors import FrameError, OverloadError, QuadliftError
from service.frames import FrameSet
from service.scheduler import Scheduler
from service.site import Site
from service.telemetry import Telemetry


def frame_set(sequence: int) -> FrameSet:
    return FrameSet(Site("demo"), (), 0, sequence)


class Runner:
    """Answers a frame set with its sequence number; holds each until ``gate`` opens; fails where told to."""

    def __init__(self) -> None:
        self.gate = threading.Event()
        self.gate.set()
        self.begun = threading.Semaphore(0)
        self.failures: dict[int, Exception] = {}
        self.done: list[int] = []

    def run(self, frame_set: FrameSet) -> Any:
        self.begun.release()
        assert self.gate.wait(10)
        if frame_set.sequence in self.failures:
            raise self.failures[frame_set.sequence]
        self.done.append(frame_set.sequence)
        return frame_set.sequence

    def warm_up(self) -> None: ...


@pytest.fixture
def runner() -> Runner:
    return Runner()


@pytest.fixture
def telemetry() -> Telemetry:
    return Telemetry()


@pytest.fixture
def start(runner: Runner, telemetry: Telemetry) -> Iterator[Callable[..., Scheduler]]:
    started: list[Scheduler] = []

    def build(**options: Any) -> Scheduler:
        started.append(Scheduler(runner, **{"workers": 1, "telemetry": telemetry, **options}))
        return started[-1]

    yield build
    runner.gate.set()
    for scheduler in started:
        scheduler.stop()


def test_each_caller_gets_its_own_result(start: Callable[..., Scheduler]) -> None:
    scheduler = start(workers=2)

    async def many() -> list[Any]:
        return list(await asyncio.gather(*(scheduler.submit(frame_set(i)) for i in range(10))))

    assert asyncio.run(many()) == list(range(10))
    assert scheduler.run(frame_set(11)) == 11


def test_workers_run_side_by_side(start: Callable[..., Scheduler], runner: Runner) -> None:
    runner.gate.clear()
    scheduler = start(workers=2)
    futures = [scheduler.enqueue(frame_set(i)) for i in range(2)]
    assert all(runner.begun.acquire(timeout=5) for _ in range(2))
    runner.gate.set()
    assert sorted(f.result(5) for f in futures) == [0, 1]


def _hold_worker(scheduler: Scheduler, runner: Runner) -> Future[Any]:
    runner.gate.clear()
    future: Future[Any] = scheduler.enqueue(frame_set(0))
    assert runner.begun.acquire(timeout=5)
    return future


def test_full_queue_is_refused_and_counted(start: Callable[..., Scheduler], runner: Runner, telemetry: Telemetry) -> None:
    scheduler = start(queue_size=2, deadline_s=30)
    held = _hold_worker(scheduler, runner)
    waiting = [scheduler.enqueue(frame_set(i)) for i in (1, 2)]
    with pytest.raises(OverloadError, match="2 frame sets") as caught:
        scheduler.enqueue(frame_set(3))
    assert caught.value.retry_after_s >= 1
    runner.gate.set()
    assert [f.result(5) for f in (held, *waiting)] == [0, 1, 2]
    assert telemetry.drops()["queue_full"] == 1


def test_a_set_that_waited_too_long_is_not_run(start: Callable[..., Scheduler], runner: Runner, telemetry: Telemetry) -> None:
    scheduler = start(deadline_s=0.02)
    held = _hold_worker(scheduler, runner)
    late = scheduler.enqueue(frame_set(1))
    threading.Event().wait(0.05)
    runner.gate.set()
    with pytest.raises(OverloadError, match="waited"):
        late.result(5)
    assert held.result(5) == 0
    assert runner.done == [0]
    assert telemetry.drops()["deadline"] == 1


def test_expired_sets_make_room(start: Callable[..., Scheduler], runner: Runner) -> None:
    scheduler = start(deadline_s=0.05, queue_size=1)
    held = _hold_worker(scheduler, runner)
    expired = scheduler.enqueue(frame_set(1))
    threading.Event().wait(0.08)
    fresh = scheduler.enqueue(frame_set(2))
    with pytest.raises(OverloadError):
        expired.result(0)
    runner.gate.set()
    assert (held.result(5), fresh.result(5)) == (0, 2)


def test_a_failing_set_fails_alone(
    start: Callable[..., Scheduler], runner: Runner, telemetry: Telemetry, caplog: pytest.LogCaptureFixture
) -> None:
    runner.failures = {1: RuntimeError("secret internals"), 2: FrameError("torn", field="north")}
    scheduler = start()
    with caplog.at_level(logging.ERROR), pytest.raises(QuadliftError) as unknown:
        scheduler.run(frame_set(1))
    assert unknown.value.status == 500
    assert "secret" not in str(unknown.value)
    assert "secret internals" in caplog.text
    with pytest.raises(FrameError, match="torn"):
        scheduler.run(frame_set(2))
    assert scheduler.run(frame_set(3)) == 3
    assert telemetry.drops()["failed"] == 1


def test_a_caller_that_went_away_costs_no_run(start: Callable[..., Scheduler], runner: Runner, telemetry: Telemetry) -> None:
    scheduler = start(deadline_s=30)
    held = _hold_worker(scheduler, runner)
    gone, stays = scheduler.enqueue(frame_set(1)), scheduler.enqueue(frame_set(2))
    assert gone.cancel()
    runner.gate.set()
    assert (held.result(5), stays.result(5)) == (0, 2)
    assert runner.done == [0, 2]
    assert telemetry.drops()["cancelled"] == 1


def test_stop_finishes_what_was_accepted(start: Callable[..., Scheduler], runner: Runner, telemetry: Telemetry) -> None:
    scheduler = start(deadline_s=30)
    held = _hold_worker(scheduler, runner)
    waiting = scheduler.enqueue(frame_set(1))
    runner.gate.set()
    scheduler.stop()
    assert (held.result(0), waiting.result(0)) == (0, 1)
    with pytest.raises(OverloadError, match="stopping"):
        scheduler.enqueue(frame_set(2))
    assert telemetry.drops()["stopping"] == 1
