"""Frame sets that wait for a worker, served in turns between sites. Plain data: the caller holds the lock."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from service.frames import FrameSet
from service.logs import request_id

if TYPE_CHECKING:
    from service.pipeline import SetResult


@dataclass(eq=False)
class Job:
    """A frame set on its way through the scheduler."""

    frame_set: FrameSet
    queued_at: float
    """Seconds, on the scheduler's clock."""
    newest_wins: bool = False
    """It came over a camera stream: a newer one of its site may take its place while it waits."""
    future: Future[SetResult] = field(default_factory=Future)
    request_id: str | None = field(default_factory=request_id.get)
    """On whose behalf it runs, for the log."""

    @property
    def site_id(self) -> str:
        """The site whose turn it takes."""
        return self.frame_set.site.id

    def succeed(self, result: SetResult) -> bool:
        """Answer with a result; False when it had been answered or cancelled before, which then stands."""
        try:
            self.future.set_result(result)
        except InvalidStateError:
            return False
        return True

    def fail(self, error: Exception) -> bool:
        """Answer with an error; False as for :meth:`succeed`."""
        try:
            self.future.set_exception(error)
        except InvalidStateError:
            return False
        return True


class FairQueue:
    """A lane for every site that has something waiting; the lanes take turns, one frame set each.

    Of camera streams a lane holds the newest set only, beside those for which a worker is free. Posted sets keep their order.
    """

    def __init__(self) -> None:
        self._lanes: OrderedDict[str, deque[Job]] = OrderedDict()
        """By site; the first lane is the next one's turn. No lane is empty."""
        self._posted = 0

    def __len__(self) -> int:
        return sum(map(len, self._lanes.values()))

    @property
    def posted(self) -> int:
        """Waiting sets that no newer one may replace."""
        return self._posted

    def posted_of(self, site_id: str) -> int:
        """The same of one site."""
        return sum(not job.newest_wins for job in self._lanes.get(site_id, ()))

    def add(self, job: Job, *, is_worker_free: bool = False) -> Job | None:
        """Queue a job. Gives the job whose place it took, if any: that one waits no more.

        is_worker_free: a worker is about to take it, so it need not take another's place.
        """
        lane = self._lanes.setdefault(job.site_id, deque())
        if job.newest_wins:
            for place in reversed(range(len(lane))) if not is_worker_free else ():
                if lane[place].newest_wins:
                    older, lane[place] = lane[place], job
                    return older
        else:
            self._posted += 1
        lane.append(job)
        return None

    def take(self) -> Job | None:
        """The job whose turn it is; None when nothing waits."""
        if not self._lanes:
            return None
        site_id, lane = self._lanes.popitem(last=False)
        job = lane.popleft()
        if lane:
            self._lanes[site_id] = lane
        if not job.newest_wins:
            self._posted -= 1
        return job

    def heavier_than(self, site_id: str) -> str | None:
        """The site with most posted sets, if it can lose one and then still has as many as ``site_id`` with one more."""
        posted = {site: self.posted_of(site) for site in self._lanes}
        heaviest = max(posted, key=lambda site: posted[site], default=site_id)
        return heaviest if posted.get(heaviest, 0) >= posted.get(site_id, 0) + 2 else None

    def evict_for(self, site_id: str) -> Job | None:
        """Take out the newest posted job of the site that is :meth:`heavier_than` this one, if there is one."""
        heaviest = self.heavier_than(site_id)
        if heaviest is None:
            return None
        newest = next(job for job in reversed(self._lanes[heaviest]) if not job.newest_wins)
        self.remove(lambda job: job is newest)
        return newest

    def remove(self, is_wanted: Callable[[Job], bool]) -> list[Job]:
        """Take out all jobs for which ``is_wanted`` says so; the others keep their turns."""
        removed: list[Job] = []
        for site_id, lane in list(self._lanes.items()):
            gone = [job for job in lane if is_wanted(job)]
            if not gone:
                continue
            removed += gone
            kept = deque(job for job in lane if job not in gone)
            if kept:
                self._lanes[site_id] = kept
            else:
                del self._lanes[site_id]
        self._posted -= sum(not job.newest_wins for job in removed)
        return removed
