"""Worker processes: a pipeline in each, so that lifting and fusion in one do not wait for the interpreter lock of another.

A process can be killed, as a thread cannot: one that hangs is, and one that died for any other reason is replaced as well.

While there is time for it a frame set is divided between them by camera, which answers it in little more than half the time on
two cores. Where sets come faster each process runs a set of its own: that is what answers most sets a second.
"""

from __future__ import annotations

import atexit
import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from service.division import Division
from service.frames import FrameSet
from service.worker_process import END_S, EndedError, WorkerProcess, as_answered

if TYPE_CHECKING:
    from service.pipeline import SetResult
    from service.scheduler import FrameSetRunner

logger = logging.getLogger(__name__)

_RETRY_S = 1.0
"""Before another try where a process could not be started."""


class WorkerDiedError(Exception):
    """A worker process ended while it ran a frame set."""


class ProcessRunner:
    """As many copies of a pipeline as there are workers, each in a process of its own. Thread-safe: a caller a process."""

    def __init__(self, load: Callable[[], FrameSetRunner], size: int) -> None:
        """Start the processes and wait until each has its pipeline; raises what ``load`` raises.

        load: makes the pipeline, in the process; it must be picklable, so a function of a module or a ``partial`` of one.
        A pipeline that is a :class:`DivisibleRunner` shares sets with idle ones.
        """
        self._load = load
        self._size = size
        self._changed = threading.Condition()
        self._idle: list[WorkerProcess] = []
        self._running: dict[FrameSet, list[WorkerProcess]] = {}
        """The processes that still work at a set; none: it waits for one."""
        self._given_up: set[FrameSet] = set()
        self._closed = False
        self._division = Division(size)
        started = [WorkerProcess(load) for _ in range(size)]
        try:
            for process in started:
                process.await_loaded()
        except BaseException:
            for process in started:
                process.kill()
            raise
        self._idle = started
        # Also where nobody closes it: the interpreter would wait for the processes at its end.
        atexit.register(self.close)

    def warm_up(self) -> None:
        """Run every network once, in every process."""
        with self._changed:
            processes = list(self._idle)
        for process in processes:
            process.warm_up()
        for process in processes:
            process.await_answer()

    def run(self, frame_set: FrameSet) -> SetResult:
        """The result of a frame set; raises what the pipeline raises, and WorkerDiedError when its process ends."""
        self._division.arrived()
        process = self._take(frame_set)
        try:
            if self._is_worth_dividing(frame_set, process):
                return self._run_divided(frame_set, process)
            with self._lent(process, frame_set):
                result = process.run(frame_set)
            self._division.took(process.took_s, divided=False)
            return result
        finally:
            with self._changed:
                self._running.pop(frame_set, None)
                self._given_up.discard(frame_set)

    def _is_worth_dividing(self, frame_set: FrameSet, process: WorkerProcess) -> bool:
        if self._size < 2 or len(frame_set.frames) < 2 or not process.is_divisible:
            return False
        with self._changed:
            others_wait = any(not processes for processes in self._running.values())
        return not others_wait and self._division.pays()

    def _run_divided(self, frame_set: FrameSet, first: WorkerProcess) -> SetResult:
        """With all processes that are idle, or with the next to be; where there is none the first does all by itself.

        Who is done with its part is free for other sets at once; the last makes one of what all saw.
        """
        others = self._joined(frame_set, most=len(frame_set.frames) - 1, wait_s=0.0)
        own, *parts = frame_set.split(1 + max(1, len(others)))
        first.begin(own)
        others = others or self._joined(frame_set, most=1, wait_s=self._division.part_s)
        for process, part in zip(others, parts, strict=bool(others)):
            process.begin(part)
        rest = None if others else parts[0]
        processes, took_s, errors = [first, *others], 0.0, list[Exception]()
        seen = [b""] * len(processes)
        for done, process in enumerate(as_answered(processes), start=1):
            number = processes.index(process)
            try:
                with self._lent(process, frame_set):
                    seen[number] = process.await_answer()
                    took_s += process.took_s
                    if done == len(processes) and not errors:
                        result = process.fuse(frame_set.site, seen[:number], seen[number + 1 :], rest)
                        self._division.took(took_s + process.took_s, divided=True)
                        return result
            except Exception as error:
                # All others have to come to an end, too.
                errors.append(error)
        raise errors[0]

    @contextmanager
    def _lent(self, process: WorkerProcess, frame_set: FrameSet) -> Iterator[None]:
        """A process that works at a set: afterwards it is free again, or is replaced where it has ended (WorkerDiedError)."""
        try:
            yield
        except EndedError:
            self._replace(process, frame_set)
            raise WorkerDiedError(f"process {process.pid} ended with code {process.exit_code()}") from None
        except BaseException:
            self._put_back(process, frame_set)
            raise
        else:
            self._put_back(process, frame_set)

    def give_up(self, frame_set: FrameSet) -> None:
        """Break a running frame set off: its processes are killed, and its caller gets WorkerDiedError."""
        with self._changed:
            processes = self._running.get(frame_set)
            if processes:
                for process in processes:
                    process.kill()
            elif processes is not None:
                self._given_up.add(frame_set)
                self._changed.notify_all()

    def close(self) -> None:
        """End all processes; those that run something are killed."""
        atexit.unregister(self.close)
        with self._changed:
            self._closed = True
            idle, self._idle = self._idle, []
            busy = [process for processes in self._running.values() for process in processes]
            self._changed.notify_all()
        for process in idle:
            process.end()
        for process in busy:
            process.kill()
        until = time.monotonic() + END_S
        for process in idle:
            process.join(until - time.monotonic())

    def _take(self, frame_set: FrameSet) -> WorkerProcess:
        with self._changed:
            self._running[frame_set] = []
            while not self._idle:
                if self._closed or frame_set in self._given_up:
                    self._running.pop(frame_set)
                    self._given_up.discard(frame_set)
                    raise WorkerDiedError("no worker process was there in time")
                self._changed.wait()
            process = self._idle.pop()
            self._running[frame_set].append(process)
            return process

    def _joined(self, frame_set: FrameSet, most: int, wait_s: float) -> list[WorkerProcess]:
        """Idle processes that work at a running set from now on; waits for the first."""
        with self._changed:
            self._changed.wait_for(lambda: self._idle, wait_s)
            joined = [self._idle.pop() for _ in range(min(most, len(self._idle)))]
            self._running[frame_set] += joined
            return joined

    def _put_back(self, process: WorkerProcess, frame_set: FrameSet) -> None:
        with self._changed:
            # At one go, so that a process which is given up with its set does not work at another meanwhile.
            self._running[frame_set].remove(process)
            self._add(process)

    def _add(self, process: WorkerProcess) -> None:
        """Make a process free for work."""
        with self._changed:
            if self._closed:
                process.end()
            else:
                self._idle.append(process)
                self._changed.notify()

    def _replace(self, process: WorkerProcess, frame_set: FrameSet) -> None:
        with self._changed:
            self._running[frame_set].remove(process)
        process.kill()
        if not self._closed:
            threading.Thread(target=self._start_another, name="quadlift-process-start", daemon=True).start()

    def _start_another(self) -> None:
        while not self._closed:
            process = None
            try:
                process = WorkerProcess(self._load)
                process.await_loaded()
                process.warm_up()
                process.await_answer()
            except Exception:
                # Whatever it is, memory most likely: the others go on, and better times may come.
                logger.exception("A worker process could not be started; the next try follows")
                if process is not None:
                    process.kill()
                time.sleep(_RETRY_S)
            else:
                self._add(process)
                return
