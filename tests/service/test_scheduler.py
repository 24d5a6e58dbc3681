"""The scheduler: bounded queue, deadline, isolation of failures, graceful stop; each drop counted with its reason."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any

import pytest

from service.errors import FrameError, OverloadError, QuadliftError, RunTimeoutError
from service.frames import EncodedFrame, FrameSet
from service.run_limit import RunLimit
from service.scheduler import Scheduler
from service.site import Site
from service.telemetry import Telemetry


def frame_set(sequence: int, site: str = "demo", frames: int = 0) -> FrameSet:
    return FrameSet(Site(site), (EncodedFrame("north", b"", 0),) * frames, 0, sequence)


class Clock:
    """Stands still until it is told otherwise."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


class Runner:
    """Answers a frame set with its sequence number; holds each until ``gate`` opens; fails where told to."""

    def __init__(self) -> None:
        self.gate = threading.Event()
        self.gate.set()
        self.begun = threading.Semaphore(0)
        self.failures: dict[int, BaseException] = {}
        self.gates: dict[int, threading.Event] = {}
        """Sets that wait for a gate of their own."""
        self.done: list[int] = []

    def run(self, frame_set: FrameSet) -> Any:
        self.begun.release()
        assert self.gates.get(frame_set.sequence, self.gate).wait(10)
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
    for gate in runner.gates.values():
        gate.set()
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
    with pytest.raises(OverloadError, match="2 frame sets"):
        scheduler.require_room("demo")
    scheduler.require_room("other")
    runner.gate.set()
    assert [f.result(5) for f in (held, *waiting)] == [0, 1, 2]
    assert telemetry.drops()["queue_full"] == 2
    scheduler.require_room("demo")


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


def test_sites_take_turns(start: Callable[..., Scheduler], runner: Runner) -> None:
    scheduler = start(deadline_s=30)
    held = _hold_worker(scheduler, runner)
    futures = [scheduler.enqueue(frame_set(i, site)) for i, site in ((1, "a"), (2, "a"), (3, "a"), (4, "b"), (5, "c"))]
    runner.gate.set()
    for future in (held, *futures):
        future.result(5)
    assert runner.done == [0, 1, 4, 5, 2, 3]


def test_a_site_that_floods_makes_room_for_one_that_does_not(
    start: Callable[..., Scheduler], runner: Runner, telemetry: Telemetry
) -> None:
    scheduler = start(deadline_s=30, queue_size=3)
    held = _hold_worker(scheduler, runner)
    flood = [scheduler.enqueue(frame_set(i, "loud")) for i in (1, 2, 3)]
    with pytest.raises(OverloadError):
        scheduler.enqueue(frame_set(4, "loud"))
    modest = scheduler.enqueue(frame_set(5, "modest"))
    with pytest.raises(OverloadError, match="other sites"):
        flood[-1].result(5)
    runner.gate.set()
    assert [f.result(5) for f in (held, *flood[:2], modest)] == [0, 1, 2, 5]
    assert telemetry.drops()["queue_full"] == 2


def test_however_many_sites_there_are_each_may_have_one_waiting(start: Callable[..., Scheduler], runner: Runner) -> None:
    scheduler = start(deadline_s=30, queue_size=2)
    held = _hold_worker(scheduler, runner)
    futures = [scheduler.enqueue(frame_set(i, f"site{i}")) for i in range(1, 9)]
    with pytest.raises(OverloadError):
        scheduler.enqueue(frame_set(9, "site1"))
    runner.gate.set()
    assert [f.result(5) for f in (held, *futures)] == list(range(9))


def test_of_a_stream_the_newest_waits_beside_the_queue(
    start: Callable[..., Scheduler], runner: Runner, telemetry: Telemetry
) -> None:
    scheduler = start(deadline_s=30, queue_size=1)
    held = _hold_worker(scheduler, runner)
    posted = scheduler.enqueue(frame_set(1))
    streamed = [scheduler.enqueue(frame_set(i), newest_wins=True) for i in (2, 3, 4)]
    other = scheduler.enqueue(frame_set(5, "other"), newest_wins=True)
    for future in streamed[:2]:
        with pytest.raises(OverloadError, match="newer"):
            future.result(0)
    runner.gate.set()
    assert [f.result(5) for f in (held, posted, streamed[2], other)] == [0, 1, 4, 5]
    assert telemetry.drops()["superseded"] == 2


def test_sets_that_waited_too_long_are_answered_though_no_worker_is_free(
    start: Callable[..., Scheduler], runner: Runner, telemetry: Telemetry
) -> None:
    clock = Clock()
    scheduler = start(deadline_s=1.0, clock=clock)
    _hold_worker(scheduler, runner)
    late = scheduler.enqueue(frame_set(1))
    clock.now = 1.0
    scheduler.check()
    with pytest.raises(OverloadError, match="waited 1000 ms"):
        late.result(5)
    assert telemetry.drops()["deadline"] == 1


def metric(telemetry: Telemetry, name: str, **labels: str) -> float | None:
    value = telemetry.registry.get_sample_value(name, labels)
    return None if value is None else float(value)


def test_a_worker_that_hangs_is_replaced_and_its_late_result_thrown_away(
    start: Callable[..., Scheduler], runner: Runner, telemetry: Telemetry, caplog: pytest.LogCaptureFixture
) -> None:
    clock = Clock()
    runner.gates[1] = threading.Event()
    scheduler = start(run_limit=RunLimit(1.5), clock=clock)
    hung = scheduler.enqueue(frame_set(1))
    assert runner.begun.acquire(timeout=5)
    clock.now = 1.5
    scheduler.check()
    assert not hung.done()
    clock.now = 1.6
    scheduler.check()
    with pytest.raises(RunTimeoutError, match=r"1\.6 s") as caught:
        hung.result(5)
    assert (caught.value.status, caught.value.remedy is None) == (504, False)
    assert scheduler.run(frame_set(2)) == 2
    assert scheduler.trouble() is None
    assert metric(telemetry, "quadlift_abandoned_workers") == 1
    assert "set 1" in caplog.text
    runner.gates[1].set()
    _wait_until(lambda: metric(telemetry, "quadlift_abandoned_workers") == 0)
    assert runner.done == [2, 1]
    assert isinstance(hung.exception(0), RunTimeoutError)
    assert (metric(telemetry, "quadlift_workers"), telemetry.drops()["hung"]) == (1, 1)
    assert metric(telemetry, "quadlift_worker_restarts_total", reason="hung") == 1
    assert scheduler.run(frame_set(3)) == 3


def test_many_cameras_may_take_longer(start: Callable[..., Scheduler], runner: Runner) -> None:
    clock = Clock()
    runner.gates[1] = threading.Event()
    scheduler = start(run_limit=RunLimit(1.5), clock=clock)
    slow = scheduler.enqueue(frame_set(1, frames=16))
    assert runner.begun.acquire(timeout=5)
    clock.now = 5.9
    scheduler.check()
    runner.gates[1].set()
    assert slow.result(5) == 1


def test_too_many_hung_threads_are_told_and_one_that_comes_back_mends_it(
    start: Callable[..., Scheduler], runner: Runner, telemetry: Telemetry, caplog: pytest.LogCaptureFixture
) -> None:
    clock = Clock()
    scheduler = start(workers=1, run_limit=RunLimit(1.0), max_abandoned=1, clock=clock, deadline_s=60)
    hung = []
    for number in (1, 2):
        runner.gates[number] = threading.Event()
        hung.append(scheduler.enqueue(frame_set(number)))
        assert runner.begun.acquire(timeout=5)
        clock.now += 2
        scheduler.check()
    assert all(isinstance(future.exception(5), RunTimeoutError) for future in hung)
    assert scheduler.trouble() == "1 of 1 workers hang in the networks."
    assert scheduler.working == 0
    assert metric(telemetry, "quadlift_abandoned_workers") == 2
    assert [record.levelname for record in caplog.records].count("CRITICAL") == 1
    waiting = scheduler.enqueue(frame_set(3))
    runner.gates[2].set()
    assert waiting.result(5) == 3
    assert scheduler.trouble() is None


@pytest.mark.parametrize("end", [SystemExit(), KeyboardInterrupt(), MemoryError()])
def test_a_worker_that_dies_is_replaced(
    start: Callable[..., Scheduler], runner: Runner, telemetry: Telemetry, end: BaseException
) -> None:
    runner.failures[1] = end
    scheduler = start()
    with pytest.raises(QuadliftError):
        scheduler.enqueue(frame_set(1)).result(5)
    assert scheduler.enqueue(frame_set(2)).result(5) == 2
    assert telemetry.drops()["failed"] == 1
    died = 0 if isinstance(end, Exception) else 1
    assert metric(telemetry, "quadlift_worker_restarts_total", reason="died") == died
    _wait_until(lambda: scheduler.working == 1)


def test_stopping_is_limited_in_time_and_what_is_left_is_counted(
    start: Callable[..., Scheduler], runner: Runner, telemetry: Telemetry
) -> None:
    scheduler = start(deadline_s=30)
    held = _hold_worker(scheduler, runner)
    waiting = scheduler.enqueue(frame_set(1))
    assert scheduler.stop(0.0) == 2
    for future in (held, waiting):
        with pytest.raises(OverloadError, match="ended"):
            future.result(0)
    assert telemetry.drops()["unfinished"] == 2
    assert scheduler.stop(0.0) == 0


def test_a_worker_that_hangs_while_stopping_keeps_nothing_from_being_finished(
    start: Callable[..., Scheduler], runner: Runner
) -> None:
    clock = Clock()
    runner.gates[1] = threading.Event()
    scheduler = start(run_limit=RunLimit(1.0), clock=clock, deadline_s=30)
    hung, waiting = scheduler.enqueue(frame_set(1)), scheduler.enqueue(frame_set(2))
    assert runner.begun.acquire(timeout=5)
    stopping = threading.Thread(target=scheduler.stop)
    stopping.start()
    clock.now = 2.0
    stopping.join(5)
    assert not stopping.is_alive()
    assert isinstance(hung.exception(0), RunTimeoutError)
    assert waiting.result(0) == 2


def _wait_until(condition: Callable[[], bool]) -> None:
    for _ in range(1000):
        if condition():
            return
        threading.Event().wait(0.01)
    raise AssertionError("waited too long")
