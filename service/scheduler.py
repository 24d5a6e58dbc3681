"""Runs frame sets on a few worker threads, behind a bounded queue that is fair between sites, with a deadline.

Workers are threads here; each hands its frame set to a process of its own, or runs the networks itself (settings,
``worker_kind``). What cannot be run in time is refused at
once (OverloadError, counted by reason); what a worker has begun is finished, unless it hangs. Sets are run one by one:
on two cores a network run over the frames of several sites is no faster (docs/operations.md has the figures).
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from service.errors import OverloadError, QuadliftError
from service.fair_queue import FairQueue, Job
from service.frames import FrameSet
from service.logs import on_behalf_of
from service.run_limit import RunLimit
from service.telemetry import Drop, Telemetry
from service.worker_processes import WorkerDiedError
from service.workers import WorkerPool

if TYPE_CHECKING:
    from service.pipeline import SetResult

logger = logging.getLogger(__name__)

MAX_ABANDONED = 4
"""Threads that may hang while other workers take their place."""
_CHECK_S = 0.2
"""Seconds between two looks after the workers and the queue."""


class FrameSetRunner(Protocol):
    """What the scheduler needs of a pipeline: ``run`` may be called by several threads at once."""

    def run(self, frame_set: FrameSet) -> SetResult:
        """The boxes of one frame set. Raises FrameError when no frame can be decoded."""
        ...

    def warm_up(self) -> None:
        """Run everything once, so that the first real frame set is as quick as the next."""
        ...


@runtime_checkable
class StoppableRunner(FrameSetRunner, Protocol):
    """A runner whose work can be broken off."""

    def give_up(self, frame_set: FrameSet) -> None:
        """Break off a frame set that is being run: its ``run`` ends soon, with an error."""
        ...

    def close(self) -> None:
        """End for good."""
        ...


class Scheduler:
    """A pool of workers around one pipeline. Thread-safe.

    Sites take turns. A frame set on which the pipeline raises fails alone; one on which it hangs is answered with an error,
    and another worker takes the place of the one that hangs.
    """

    def __init__(
        self,
        runner: FrameSetRunner,
        *,
        workers: int,
        queue_size: int = 16,
        deadline_s: float = 1.0,
        run_limit: RunLimit | None = None,
        max_abandoned: int = MAX_ABANDONED,
        telemetry: Telemetry | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start the workers.

        queue_size: posted frame sets that may wait beside those being run; of every site one may wait in any case, and one of
        its camera streams.
        deadline_s: seconds that one may wait. max_abandoned: threads that may hang before workers are lost for good.
        """
        self.run_limit = run_limit
        """How long a set may run; beyond that its worker counts as hung. None: for ever."""
        self._runner = runner
        self._queue_size = queue_size
        self._deadline_s = deadline_s
        self._telemetry = telemetry or Telemetry()
        self._clock = clock
        self._queue = FairQueue()
        self._changed = threading.Condition()
        self._stopping = False
        self._idle = 0
        self._pool = WorkerPool(
            self._next,
            self._run,
            runner.give_up if isinstance(runner, StoppableRunner) else None,
            size=workers,
            max_abandoned=max_abandoned,
            telemetry=self._telemetry,
            clock=clock,
        )
        self._ended = threading.Event()
        self._watch = threading.Thread(target=self._watch_over, name="quadlift-watch", daemon=True)
        self._watch.start()

    @property
    def working(self) -> int:
        """Workers that do not hang."""
        return self._pool.working

    def trouble(self) -> str | None:
        """What keeps the scheduler from doing all its work; None when nothing does."""
        working, size = self._pool.working, self._pool.size
        if working >= size or self._stopping:
            return None
        return f"{size - working} of {size} workers hang in the networks."

    def enqueue(self, frame_set: FrameSet, *, newest_wins: bool = False) -> Future[SetResult]:
        """Queue a frame set. Raises OverloadError when the queue is full or the scheduler is stopping.

        newest_wins: it is one of a camera stream, and a newer one of its site may take its place in the queue.

        The future gives the SetResult, or raises FrameError (no frame could be decoded), OverloadError (deadline, another
        set took its place, the service ended), RunTimeoutError (the networks hung) or QuadliftError (the networks failed).
        Cancel it to give up a frame set that has not begun.
        """
        job = Job(frame_set, self._clock(), newest_wins)
        with self._changed:
            if self._stopping:
                self._telemetry.dropped(Drop.STOPPING)
                raise OverloadError("the service is stopping.", remedy="Try again when it has started anew.")
            evicted = None
            if not newest_wins:
                self._require_room(job.site_id)
                evicted = self._queue.evict_for(job.site_id) if self._is_full() else None
            superseded = self._queue.add(job, is_worker_free=self._idle > len(self._queue))
            self._telemetry.queue(len(self._queue))
            self._changed.notify()
        if superseded is not None:
            self._refuse(superseded, Drop.SUPERSEDED, "a newer frame set of the site took its place.")
        if evicted is not None:
            self._refuse(evicted, Drop.QUEUE_FULL, "other sites had fewer frame sets waiting.")
        return job.future

    def require_room(self, site_id: str) -> None:
        """Raise OverloadError, counted, if a posted set of a site would be refused now: before its frames are even read."""
        with self._changed:
            self._require_room(site_id)

    async def submit(self, frame_set: FrameSet, *, newest_wins: bool = False) -> SetResult:
        """The result of a frame set, awaited; takes and raises what :meth:`enqueue` and its future do."""
        return await asyncio.wrap_future(self.enqueue(frame_set, newest_wins=newest_wins))

    def run(self, frame_set: FrameSet) -> SetResult:
        """The result of a frame set, for callers without an event loop; raises as :meth:`enqueue` and its future do."""
        return self.enqueue(frame_set).result()

    def stop(self, timeout_s: float | None = None) -> int:
        """Accept nothing more and finish what was accepted, for ``timeout_s`` seconds at most.

        Gives how many frame sets were not finished by then: each is answered with an error and counted.
        """
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        running = self._pool.join(float("inf") if timeout_s is None else self._clock() + timeout_s)
        self._ended.set()
        self._watch.join()
        with self._changed:
            waiting = self._queue.remove(lambda job: True)
            self._telemetry.queue(0)
        left = sum([self._refuse(job, Drop.UNFINISHED, "the service ended before it was done.") for job in waiting + running])
        if left:
            logger.error("%d frame sets were not finished in time", left)
        return left

    def check(self) -> None:
        """Replace workers that hang or died, and answer sets that have waited too long; done several times a second."""
        self._pool.check(self._limit_s)
        with self._changed:
            overdue = self._queue.remove(self._is_dead)
            self._telemetry.queue(len(self._queue))
        self._bury(overdue)

    def _watch_over(self) -> None:
        while not self._ended.wait(_CHECK_S):
            try:
                self.check()
            except Exception:
                # Most likely no thread could be started; the next look may find better times.
                logger.exception("The workers could not be looked after")

    def _limit_s(self, job: Job) -> float | None:
        return None if self.run_limit is None else self.run_limit.seconds(len(job.frame_set.frames))

    def _is_full(self) -> bool:
        # A job that an idle worker is about to take does not wait, so it takes no place.
        return self._queue.posted >= self._queue_size + self._idle

    def _require_room(self, site_id: str) -> None:
        if self._is_full():
            self._bury(self._queue.remove(self._is_dead))
        # However many sites there are, each may have one set waiting: otherwise loud ones would be luckier.
        if self._is_full() and self._queue.posted_of(site_id) and self._queue.heavier_than(site_id) is None:
            self._telemetry.dropped(Drop.QUEUE_FULL)
            raise OverloadError(
                f"{self._queue.posted} frame sets are waiting already.", remedy="Send fewer sets a second, or add workers."
            )

    def _next(self) -> Job | None:
        """The next job worth running, for a worker; None when it may end."""
        while True:
            with self._changed:
                while (job := self._queue.take()) is None:
                    if self._stopping:
                        return None
                    self._idle += 1
                    try:
                        self._changed.wait()
                    finally:
                        self._idle -= 1
                self._telemetry.queue(len(self._queue))
            if self._is_dead(job):
                self._bury([job])
            elif job.future.set_running_or_notify_cancel():
                self._telemetry.waited(self._clock() - job.queued_at)
                return job
            else:
                self._telemetry.dropped(Drop.CANCELLED)

    def _run(self, job: Job) -> None:
        began, limit = self._clock(), self.run_limit
        with on_behalf_of(job.request_id):
            try:
                result = self._runner.run(job.frame_set)
            except QuadliftError as error:
                job.fail(error)
            except WorkerDiedError:
                # The pool answers for it.
                raise
            except Exception:
                # Whatever a network does must not end the worker, nor tell the caller about our insides.
                logger.exception("A frame set of site '%s' failed", job.site_id, extra={"site": job.site_id})
                if job.fail(QuadliftError("the networks failed on this frame set.", remedy="See the service's log.")):
                    self._telemetry.dropped(Drop.FAILED)
            else:
                job.succeed(result)
        if limit is not None:
            limit.note(self._clock() - began, len(job.frame_set.frames))

    def _is_dead(self, job: Job) -> bool:
        """Whether nobody waits for a job any more, or it has waited too long."""
        return job.future.cancelled() or self._clock() - job.queued_at >= self._deadline_s

    def _bury(self, jobs: list[Job]) -> None:
        for job in jobs:
            waited_ms = 1e3 * (self._clock() - job.queued_at)
            self._refuse(job, Drop.DEADLINE, f"the frame set waited {waited_ms:.0f} ms for a worker.")

    def _refuse(self, job: Job, reason: Drop, message: str) -> bool:
        """Answer a job that will not be run to its end, and count it by what ended it; False when it had an answer before."""
        is_first = job.fail(OverloadError(message, remedy="Send fewer sets a second, or add workers."))
        if is_first or job.future.cancelled():
            self._telemetry.dropped(reason if is_first else Drop.CANCELLED)
        return is_first
