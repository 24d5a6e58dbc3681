"""Threads that run frame sets, and their supervision: one that hangs or dies is replaced.

A thread cannot be killed. One that hangs is abandoned: its frame set is answered with an error, another thread takes its
place, and what it brings in the end, if anything, is thrown away. Only so many may hang at a time. One that waits for a
process comes back at once, since that can be killed.
"""

from __future__ import annotations

import itertools
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from service.errors import QuadliftError, RunTimeoutError
from service.fair_queue import Job
from service.frames import FrameSet
from service.telemetry import Drop, Restart, Telemetry

logger = logging.getLogger(__name__)


@dataclass(eq=False)
class _Worker:
    thread: threading.Thread = field(init=False)
    job: Job | None = None
    began_at: float = 0.0
    is_abandoned: bool = False


class WorkerPool:
    """A number of workers that is kept up. Thread-safe."""

    def __init__(
        self,
        take: Callable[[], Job | None],
        run: Callable[[Job], None],
        give_up: Callable[[FrameSet], None] | None = None,
        *,
        size: int,
        max_abandoned: int,
        telemetry: Telemetry,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start the workers.

        take: waits for the next job; None ends the worker. run: answers a job; whatever it raises ends the worker, which is
        replaced. give_up: breaks off what a worker that hangs is doing. max_abandoned: threads that may hang while others do
        their work; beyond that the pool shrinks.
        """
        self._take = take
        self._run = run
        self._give_up = give_up
        self._size = size
        self._wanted = size
        self._max_abandoned = max_abandoned
        self._telemetry = telemetry
        self._clock = clock
        self._lock = threading.RLock()
        self._numbers = itertools.count()
        self._closed = False
        self._is_short = False
        self._workers: list[_Worker] = []
        """Everyone whose thread lives, the abandoned ones too."""
        with self._lock:
            self._fill()

    @property
    def size(self) -> int:
        """How many workers there should be."""
        return self._size

    @property
    def working(self) -> int:
        """How many there are that do not hang."""
        with self._lock:
            return sum(not worker.is_abandoned for worker in self._workers)

    @property
    def abandoned(self) -> int:
        """Threads that hang."""
        with self._lock:
            return sum(worker.is_abandoned for worker in self._workers)

    def check(self, limit_s: Callable[[Job], float | None]) -> None:
        """Replace workers that hang or whose thread has ended.

        limit_s: seconds that a job may run; None for as long as it takes.
        """
        with self._lock:
            now = self._clock()
            for worker in list(self._workers):
                if not worker.thread.is_alive():
                    self._ended(worker, None)
                    continue
                job = worker.job
                limit = None if job is None or worker.is_abandoned or job.future.done() else limit_s(job)
                if job is not None and limit is not None and now - worker.began_at > limit:
                    self._abandon(worker, job, now - worker.began_at)
            self._fill()

    def join(self, until: float) -> list[Job]:
        """Wait, until a time on the clock at most, for the workers to end; gives the jobs that are still being run.

        Hung workers are not waited for. No worker is started any more when it returns.
        """
        while True:
            with self._lock:
                worker = next((worker for worker in self._workers if not worker.is_abandoned), None)
            if worker is None or self._clock() >= until:
                break
            # In short steps: a worker that hangs meanwhile is abandoned by `check`, and another one takes its place.
            worker.thread.join(min(0.05, max(0.0, until - self._clock())))
        with self._lock:
            self._closed = True
            return [worker.job for worker in self._workers if worker.job is not None and not worker.is_abandoned]

    def _fill(self) -> None:
        while not self._closed and self.working < self._wanted and len(self._workers) < self._size + self._max_abandoned:
            worker = _Worker()
            worker.thread = threading.Thread(
                target=self._work, args=(worker,), name=f"quadlift-worker-{next(self._numbers)}", daemon=True
            )
            worker.thread.start()
            self._workers.append(worker)
        is_short = not self._closed and self.working < self._wanted
        if is_short and not self._is_short:
            logger.critical(
                "%d threads hang, as many as may: %d of %d workers are left", self.abandoned, self.working, self._size
            )
        self._is_short = is_short
        self._telemetry.workers(self.working, self.abandoned)

    def _work(self, worker: _Worker) -> None:
        cause: BaseException | None = None
        job: Job | None = None
        try:
            while (job := self._take()) is not None:
                with self._lock:
                    worker.job, worker.began_at = job, self._clock()
                self._run(job)
                with self._lock:
                    worker.job = None
                    if worker.is_abandoned:
                        break
        except BaseException as error:
            # Not only Exception: a worker that ends by SystemExit or the like must be answered for and replaced as well.
            cause = error
            if worker.job is None and job is not None:
                # It ended just before it noted the job, or just after it had answered it.
                worker.job = job
        finally:
            self._ended(worker, cause)

    def _abandon(self, worker: _Worker, job: Job, took_s: float) -> None:
        worker.is_abandoned = True
        logger.error(
            "%s hangs and is abandoned: set %d has been running for %.1f s",
            worker.thread.name, job.frame_set.sequence, took_s, extra={"site": job.site_id, "request_id": job.request_id},
        )  # fmt: skip
        self._telemetry.restarted(Restart.HUNG)
        if job.fail(RunTimeoutError(took_s)):
            self._telemetry.dropped(Drop.HUNG)
        if self._give_up is not None:
            self._give_up(job.frame_set)

    def _ended(self, worker: _Worker, cause: BaseException | None) -> None:
        with self._lock:
            if worker not in self._workers:
                return
            self._workers.remove(worker)
            job, worker.job = worker.job, None
            if worker.is_abandoned:
                logger.warning("%s came back after it was abandoned; what it brings is thrown away", worker.thread.name)
            elif job is not None or cause is not None:
                logger.error("%s died and is replaced", worker.thread.name, exc_info=cause)
                self._telemetry.restarted(Restart.DIED)
                if job is not None and job.fail(
                    QuadliftError("the worker died on this frame set.", remedy="See the service's log.")
                ):
                    self._telemetry.dropped(Drop.FAILED)
            else:
                # It was told to end: nothing is accepted any more and nothing waits.
                self._wanted -= 1
            self._fill()
