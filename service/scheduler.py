"""Runs frame sets on a few worker threads, behind a bounded queue with a deadline.

The networks release the interpreter lock, so each worker keeps one core busy. What cannot be run in time is refused at
once (OverloadError, counted by reason); what a worker has begun is finished.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections import deque
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from service.errors import OverloadError, QuadliftError
from service.frames import FrameSet
from service.telemetry import Drop, Telemetry

if TYPE_CHECKING:
    from service.pipeline import SetResult

logger = logging.getLogger(__name__)


class FrameSetRunner(Protocol):
    """What the scheduler needs of a pipeline: ``run`` may be called by several threads at once."""

    def run(self, frame_set: FrameSet) -> SetResult:
        """The boxes of one frame set. Raises FrameError when no frame can be decoded."""
        ...

    def warm_up(self) -> None:
        """Run everything once, so that the first real frame set is as quick as the next."""
        ...


@dataclass(eq=False)
class _Job:
    frame_set: FrameSet
    queued_at: float
    future: Future[SetResult] = field(default_factory=Future)


class Scheduler:
    """A pool of workers around one pipeline. Thread-safe.

    A frame set on which the pipeline raises fails alone; the worker goes on.
    """

    def __init__(
        self,
        runner: FrameSetRunner,
        *,
        workers: int,
        queue_size: int = 16,
        deadline_s: float = 1.0,
        telemetry: Telemetry | None = None,
    ) -> None:
        """Start the workers.

        queue_size: frame sets that may wait beside those being run. deadline_s: seconds that one may wait.
        """
        self._runner = runner
        self._queue_size = queue_size
        self._deadline_s = deadline_s
        self._telemetry = telemetry or Telemetry()
        self._jobs: deque[_Job] = deque()
        self._changed = threading.Condition()
        self._stopping = False
        self._idle = 0
        self._threads = [threading.Thread(target=self._work, name=f"quadlift-worker-{i}", daemon=True) for i in range(workers)]
        for thread in self._threads:
            thread.start()

    def enqueue(self, frame_set: FrameSet) -> Future[SetResult]:
        """Queue a frame set. Raises OverloadError when the queue is full or the scheduler is stopping.

        The future gives the SetResult, or raises FrameError (no frame could be decoded), OverloadError (deadline), or
        QuadliftError (the networks failed). Cancel it to give up a frame set that has not begun.
        """
        job = _Job(frame_set, time.monotonic())
        with self._changed:
            if self._stopping:
                self._telemetry.dropped(Drop.STOPPING)
                raise OverloadError("the service is stopping.", remedy="Try again when it has started anew.")
            # A job that an idle worker is about to take does not wait, so it takes no place.
            room = self._queue_size + self._idle
            if len(self._jobs) >= room:
                self._clear_dead()
            if len(self._jobs) >= room:
                self._telemetry.dropped(Drop.QUEUE_FULL)
                raise OverloadError(
                    f"{len(self._jobs)} frame sets are waiting already.", remedy="Send fewer sets a second, or add workers."
                )
            self._jobs.append(job)
            self._telemetry.queue(len(self._jobs))
            self._changed.notify()
        return job.future

    async def submit(self, frame_set: FrameSet) -> SetResult:
        """The result of a frame set, awaited; raises as :meth:`enqueue` and its future do."""
        return await asyncio.wrap_future(self.enqueue(frame_set))

    def run(self, frame_set: FrameSet) -> SetResult:
        """The result of a frame set, for callers without an event loop; raises as :meth:`enqueue` and its future do."""
        return self.enqueue(frame_set).result()

    def stop(self) -> None:
        """Accept nothing more, finish what was accepted, and wait for the workers."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()

    def _work(self) -> None:
        while (job := self._next()) is not None:
            if not self._is_dead(job):
                self._telemetry.waited(time.monotonic() - job.queued_at)
                self._run(job)

    def _next(self) -> _Job | None:
        with self._changed:
            while not self._jobs:
                if self._stopping:
                    return None
                self._idle += 1
                self._changed.wait()
                self._idle -= 1
            job = self._jobs.popleft()
            self._telemetry.queue(len(self._jobs))
            return job

    def _run(self, job: _Job) -> None:
        if not job.future.set_running_or_notify_cancel():
            self._telemetry.dropped(Drop.CANCELLED)
            return
        try:
            result = self._runner.run(job.frame_set)
        except QuadliftError as error:
            job.future.set_exception(error)
        except Exception:
            # Whatever a network does must not end the worker, nor tell the caller about our insides.
            logger.exception("A frame set of site '%s' failed", job.frame_set.site.id)
            self._telemetry.dropped(Drop.FAILED)
            job.future.set_exception(QuadliftError("the networks failed on this frame set.", remedy="See the service's log."))
        else:
            job.future.set_result(result)

    def _is_dead(self, job: _Job) -> bool:
        """Whether nobody waits for a job any more, or it has waited too long; if so, it is answered and counted."""
        waited = time.monotonic() - job.queued_at
        if not job.future.cancelled() and waited < self._deadline_s:
            return False
        if job.future.set_running_or_notify_cancel():
            self._telemetry.dropped(Drop.DEADLINE)
            job.future.set_exception(
                OverloadError(f"the frame set waited {waited * 1e3:.0f} ms for a worker.", remedy="Send fewer sets a second.")
            )
        else:
            self._telemetry.dropped(Drop.CANCELLED)
        return True

    def _clear_dead(self) -> None:
        self._jobs = deque(job for job in self._jobs if not self._is_dead(job))
