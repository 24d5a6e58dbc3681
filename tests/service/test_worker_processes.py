"""Worker processes: answers, errors and sites find their way; a process that hangs or dies is replaced."""

from __future__ import annotations

import importlib
import itertools
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.division import Division
from service.errors import FrameError, PackError, QuadliftError
from service.frames import EncodedFrame, FrameSet
from service.geometry.camera import Camera
from service.geometry.ground import GroundPlane
from service.run_limit import RunLimit
from service.scheduler import Scheduler, StoppableRunner
from service.site import Site
from service.telemetry import Telemetry
from service.worker_processes import ProcessRunner, WorkerDiedError


@pytest.fixture
def scripted(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module of the runner, where processes find it."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    return importlib.import_module("scripted_worker")


@pytest.fixture
def start(scripted: Any) -> Iterator[Callable[..., ProcessRunner]]:
    runners: list[ProcessRunner] = []

    def build(size: int = 1, kind: str = "Scripted") -> ProcessRunner:
        runners.append(ProcessRunner(getattr(scripted, kind), size))
        return runners[-1]

    yield build
    for runner in runners:
        runner.close()


def site(camera: str = "north") -> Site:
    K = np.array([[800.0, 0, 320], [0, 800, 180], [0, 0, 1]])
    return Site("demo", (Camera(camera, 640, 360, K, np.zeros(0), np.eye(4)),), GroundPlane())


HERE = site()


def asking(words: str, at: Site = HERE) -> FrameSet:
    return FrameSet(at, (EncodedFrame("north", words.encode(), None),), 0, 1)


def until(condition: Callable[[], object], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.01)


def test_frame_sets_are_run_in_other_processes_all_of_them_warm(start: Callable[..., ProcessRunner]) -> None:
    runner = start(2)
    assert isinstance(runner, StoppableRunner)
    runner.warm_up()
    seen: list[Any] = []
    threads = [threading.Thread(target=lambda: seen.append(runner.run(asking("pid")))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(seen) == 8
    assert {warm for _, warm in seen} == {1}
    assert os.getpid() not in {pid for pid, _ in seen}


def test_a_site_is_sent_once_and_again_when_it_changed(start: Callable[..., ProcessRunner]) -> None:
    runner, moved = start(), site("east")
    seen: list[Any] = [runner.run(asking("site", at)) for at in (HERE, HERE, moved, moved, HERE)]
    assert seen == [("north", False), ("north", True), ("east", False), ("east", True), ("north", False)]


def test_errors_come_back_whole_and_the_process_goes_on(start: Callable[..., ProcessRunner]) -> None:
    runner = start()
    with pytest.raises(FrameError) as caught:
        runner.run(asking("frame-error"))
    assert (caught.value.message, caught.value.field, caught.value.remedy) == ("not a JPEG.", "north", "Send one.")
    with pytest.raises(RuntimeError, match="OddError: 1 and 2") as other:
        runner.run(asking("odd-error"))
    assert "raise OddError(1, 2)" in "".join(other.value.__notes__)
    assert runner.run(asking("")) == "done"


def test_what_cannot_be_loaded_is_said_at_the_start(scripted: Any) -> None:
    with pytest.raises(PackError, match="is missing"):
        ProcessRunner(scripted.refuse, 2)


def test_a_process_that_dies_is_replaced_by_a_warm_one(start: Callable[..., ProcessRunner]) -> None:
    runner = start()
    first, _ = runner.run(asking("pid"))  # type: ignore[misc]
    with pytest.raises(WorkerDiedError, match="-9"):
        runner.run(asking("die"))
    second, warm = runner.run(asking("pid"))  # type: ignore[misc]
    assert second != first
    assert warm == 1


def test_an_exit_code_is_not_lost_to_who_starts_another_process(
    start: Callable[..., ProcessRunner], monkeypatch: pytest.MonkeyPatch
) -> None:
    read = forkserver.read_signed

    def read_slowly(fd: int) -> int:
        time.sleep(0.1)
        code: int = read(fd)
        return code

    # Starting one asks of all whether they have ended, and the answer can be read but once.
    monkeypatch.setattr(forkserver, "read_signed", read_slowly)
    with pytest.raises(WorkerDiedError, match="-9"):
        start().run(asking("die"))


def test_what_hangs_is_given_up_and_so_is_what_waits_for_it(start: Callable[..., ProcessRunner]) -> None:
    runner, ends = start(), list[str]()

    def run(frame_set: FrameSet) -> None:
        try:
            runner.run(frame_set)
        except WorkerDiedError as error:
            ends.append(str(error))

    hanging, waiting = asking("hang"), asking("hang")
    threads = [threading.Thread(target=run, args=(each,)) for each in (hanging, waiting)]
    threads[0].start()
    until(lambda: runner._running.get(hanging))
    threads[1].start()
    until(lambda: waiting in runner._running)
    runner.give_up(waiting)
    threads[1].join(5)
    runner.give_up(hanging)
    threads[0].join(5)
    assert len(ends) == 2
    assert "in time" in ends[0]
    # Of a set that is over nothing is left to give up.
    runner.give_up(hanging)
    assert runner.run(asking("")) == "done"


def asking_four(*words: str) -> FrameSet:
    """A frame set of four cameras, which ask for so much in turn; the same for all where one is given."""
    K = np.array([[800.0, 0, 320], [0, 800, 180], [0, 0, 1]])
    cameras = tuple(Camera(name, 640, 360, K, np.zeros(0), np.eye(4)) for name in ("n", "e", "s", "w"))
    each = words if len(words) == 4 else words * 4
    frames = tuple(EncodedFrame(camera.id, word.encode(), None) for camera, word in zip(cameras, each, strict=True))
    return FrameSet(Site("demo", cameras, GroundPlane()), frames, 0, 1)


def test_a_set_is_divided_between_idle_processes(start: Callable[..., ProcessRunner]) -> None:
    runner = start(3, "Divisible")
    pids, took_ms = runner.run(asking_four(""))  # type: ignore[misc]
    assert len(set(pids)) == 3
    # Side by side: they took as long as one of them.
    assert took_ms == 1.0


def test_who_becomes_idle_joins_a_set_that_is_being_run(start: Callable[..., ProcessRunner], tmp_path: Path) -> None:
    runner, begun = start(2, "Divisible"), tmp_path / "begun"
    # A set every 30 s: dividing pays, and its half is waited for.
    runner._division = Division(2, itertools.count(0.0, 30.0).__next__)
    runner._division.took(8.0, divided=False)
    busy = threading.Thread(target=lambda: runner.run(asking(f"wait {begun}")))
    busy.start()
    until(begun.exists)
    (pids, took_ms) = runner.run(asking_four(f"wait {tmp_path / 'second'}"))  # type: ignore[misc]
    assert len(set(pids)) == 2
    assert took_ms == 1.0
    busy.join()


def test_who_is_joined_by_nobody_does_the_rest_itself(start: Callable[..., ProcessRunner], tmp_path: Path) -> None:
    runner, begun = start(2, "Divisible"), tmp_path / "begun"
    busy = threading.Thread(target=lambda: runner.run(asking(f"wait {begun}")))
    busy.start()
    until(begun.exists)
    pids, took_ms = runner.run(asking_four(""))  # type: ignore[misc]
    assert len(pids) == 4
    assert len(set(pids)) == 1
    # One part after the other.
    assert took_ms == 2.0
    busy.join()


@pytest.mark.parametrize(("processes", "asked"), [(1, asking_four("pid")), (2, asking("pid"))])
def test_what_cannot_be_divided_is_run_whole(start: Callable[..., ProcessRunner], processes: int, asked: FrameSet) -> None:
    _, warm = start(processes, "Divisible").run(asked)  # type: ignore[misc]
    assert warm == 0


@pytest.mark.parametrize("where", range(4))
def test_an_error_in_a_part_is_the_sets_and_all_go_on(start: Callable[..., ProcessRunner], where: int) -> None:
    runner = start(2, "Divisible")
    words = [""] * 4
    words[where] = "frame-error"
    with pytest.raises(FrameError, match="not a JPEG"):
        runner.run(asking_four(*words))
    pids, _ = runner.run(asking_four(""))  # type: ignore[misc]
    assert len(set(pids)) == 2


@pytest.mark.parametrize("where", range(4))
def test_a_process_that_dies_of_a_part_is_replaced(start: Callable[..., ProcessRunner], where: int) -> None:
    runner = start(2, "Divisible")
    before, _ = runner.run(asking_four(""))  # type: ignore[misc]
    words = [""] * 4
    words[where] = "die"
    with pytest.raises(WorkerDiedError, match="-9"):
        runner.run(asking_four(*words))
    until(lambda: len(runner._idle) == 2)
    after, _ = runner.run(asking_four(""))  # type: ignore[misc]
    assert len(set(before) & set(after)) == 1
    assert len(set(after)) == 2


@pytest.mark.parametrize("where", [0, 3])
def test_a_divided_set_that_hangs_is_given_up(start: Callable[..., ProcessRunner], where: int) -> None:
    runner = start(2, "Divisible")
    words = [""] * 4
    words[where] = "hang"
    hanging, ends = asking_four(*words), list[WorkerDiedError]()

    def run() -> None:
        with pytest.raises(WorkerDiedError) as caught:
            runner.run(hanging)
        ends.append(caught.value)

    thread = threading.Thread(target=run)
    thread.start()
    until(lambda: len(runner._running.get(hanging, ())) > 0)
    time.sleep(0.2)
    runner.give_up(hanging)
    thread.join(10)
    assert ends
    until(lambda: len(runner._idle) == 2)
    assert runner.run(asking("")) == "done"


def test_a_process_that_ends_at_its_start_is_an_error(scripted: Any) -> None:
    with pytest.raises(QuadliftError, match="ended at its start"):
        ProcessRunner(scripted.end, 1)


def test_processes_end_with_their_owner(scripted: Any, tmp_path: Path) -> None:
    log = tmp_path / "pid"
    runner = ProcessRunner(partial(scripted.noted, log), 1)
    pid = int(log.read_text())
    runner.close()
    until(lambda: not Path(f"/proc/{pid}").exists() if Path("/proc").exists() else True)
    with pytest.raises(WorkerDiedError):
        runner.run(asking(""))


def test_signals_to_the_whole_group_do_not_end_work_under_way(start: Callable[..., ProcessRunner], tmp_path: Path) -> None:
    runner, begun, seen = start(), tmp_path / "begun", list[Any]()
    pid, _ = runner.run(asking("pid"))  # type: ignore[misc]
    thread = threading.Thread(target=lambda: seen.append(runner.run(asking(f"wait {begun}"))))
    thread.start()
    until(begun.exists)
    for number in (signal.SIGTERM, signal.SIGINT):
        os.kill(pid, number)
    thread.join(10)
    assert seen == ["done"]


def test_the_scheduler_answers_for_processes(start: Callable[..., ProcessRunner]) -> None:
    telemetry = Telemetry()
    scheduler = Scheduler(start(), workers=1, run_limit=RunLimit(0.2), telemetry=telemetry, deadline_s=30, max_abandoned=0)
    try:
        hung, died, good = (scheduler.enqueue(asking(words)) for words in ("hang", "die", ""))
        with pytest.raises(Exception, match="had not finished"):
            hung.result(20)
        scheduler.run_limit = RunLimit(30)
        with pytest.raises(Exception, match="the worker died"):
            died.result(20)
        assert good.result(20) == "done"
        assert telemetry.drops()["hung"] == telemetry.drops()["failed"] == 1
        until(lambda: scheduler.trouble() is None)
    finally:
        scheduler.stop()
