"""Faults, one kind after the other, each many times under load on several sites: what survives, what is lost."""

from __future__ import annotations

import asyncio
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx

from benchmarks.load.fault_load import ANSWER_S, Account, Load, LoadSite, load_site
from benchmarks.load.faulty_service import FOLDER_VARIABLE, PROGRAM
from benchmarks.load.injections import KINDS, RECOVER_S, Inject, Scene, until
from benchmarks.load.target_service import Counters, Target, put_sites, read_counters, serving
from clients.client import ServiceError
from clients.clip import Clip, open_clip
from clients.local_service import LocalServiceError

GIVE_UP_AFTER = 3
"""Faults in a row that the service does not survive; it is beyond help then."""
EXIT_S = 12.0
"""Ten seconds to drain, and some for the process to end."""
_ON_ITS_WAY_S = 0.1
"""A request sent this long before SIGTERM has arrived."""
_BURST = 12
"""Requests at once before SIGTERM; fewer than may queue."""
_SET_DROPS = (
    "queue_full", "deadline", "stopping", "cancelled", "failed", "hung", "unfinished", "superseded", "undecodable", "late",
    "slow_reader",
)  # fmt: skip
_FRAME_DROPS = ("frame_duplicate", "frame_late", "frame_clock", "frame_backlog", "frame_camera_left")


@dataclass
class FaultResult:
    """One kind of fault."""

    kind: str
    asked: int
    injected: int = 0
    noticed: int = 0
    """Faults whose expected trace was seen: an error for a broken frame, a camera called missing, a process that ended."""
    survived: int = 0
    slowest_recovery_s: float = 0.0
    account: Account = field(default_factory=Account)
    counted: int = 0
    """Sets without an answer that the service's counters explain, at most."""
    in_flight: int = 0
    """Requests that had arrived and had no answer yet when the process was told to end; all kinds but SIGTERM: 0."""
    remarks: list[str] = field(default_factory=list)

    @property
    def lost_uncounted(self) -> int:
        """Accepted, and neither answered nor counted."""
        return max(0, self.account.unanswered + self.account.moments - self.account.seen - self.counted)

    @property
    def passed(self) -> bool:
        """Whether every fault was injected and survived, with nothing lost and nothing given to the wrong owner."""
        whole = self.asked == self.injected == self.survived == self.noticed
        return whole and not self.account.wrong_owner and not self.lost_uncounted

    def document(self) -> dict[str, Any]:
        """JSON-ready."""
        account = self.account
        return {
            "kind": self.kind, "asked": self.asked, "injected": self.injected, "noticed": self.noticed,
            "survived": self.survived, "slowest_recovery_s": round(self.slowest_recovery_s, 2),
            "wrong_owner": account.wrong_owner,
            "requests": account.sent,
            "statuses": {str(status): count for status, count in sorted(account.statuses.items())},
            "in_flight": self.in_flight,
            "unanswered": account.unanswered, "stream_sets": account.moments, "stream_sets_seen": account.seen,
            "counted": self.counted, "lost_uncounted": self.lost_uncounted, "passed": self.passed,
            "remarks": sorted(set(self.remarks)),
        }  # fmt: skip


SIGTERM = "sigterm"


async def run_faults(
    kinds: list[str], times: int, seconds: float, say: Callable[[FaultResult], None] = lambda _: None
) -> list[FaultResult]:
    """Every kind on a service of its own, ``seconds`` for each at most. A kind that fails altogether says so and ends alone.

    say: told of each kind when it is done.
    """
    results = []
    for kind in kinds:
        result = FaultResult(kind, times)
        try:
            async with asyncio.timeout(seconds + EXIT_S + ANSWER_S):
                run = _run_sigterm(result, seconds) if kind == SIGTERM else _run_kind(result, KINDS[kind], seconds)
                await run
        except (TimeoutError, LocalServiceError, ServiceError, httpx.HTTPError, OSError) as error:
            result.remarks.append(f"{type(error).__name__}: {str(error)[:300]}")
        results.append(result)
        say(result)
    return results


def _sites(clip: Clip) -> tuple[list[LoadSite], LoadSite, LoadSite]:
    return [load_site(clip, "alpha", 4), load_site(clip, "beta", 2)], load_site(clip, "target", 3), load_site(clip, "stream", 4)


async def _run_kind(result: FaultResult, inject: Inject, seconds: float) -> None:
    clip = open_clip()
    steady, target, streamed = _sites(clip)
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="quadlift-faults-") as name:
        variables = {FOLDER_VARIABLE: name}
        async with serving(target.document, program=PROGRAM, variables=variables) as service:
            await put_sites(service.url, {site.id: site.document for site in (*steady, streamed)})
            before = await asyncio.to_thread(read_counters, service.url)
            async with Load(service.url, clip, steady, target, streamed) as load:
                if await load.recovers(RECOVER_S) is None:
                    result.remarks.append("the load did not come up")
                    return
                await _inject_all(result, inject, Scene(load, service, Path(name)), began + seconds)
            result.account = load.account()
            after = await asyncio.to_thread(read_counters, service.url)
            result.counted = counted(before, after, result.account, len(streamed.cameras))


async def _inject_all(result: FaultResult, inject: Inject, scene: Scene, until: float) -> None:
    failed_in_a_row = 0
    while result.injected < result.asked and failed_in_a_row < GIVE_UP_AFTER:
        if time.monotonic() > until:
            result.remarks.append("the time was over")
            return
        result.noticed += await inject(scene, result.injected)
        result.injected += 1
        took_s = await scene.load.recovers(RECOVER_S)
        failed_in_a_row = failed_in_a_row + 1 if took_s is None else 0
        if took_s is not None:
            result.survived += 1
            result.slowest_recovery_s = max(result.slowest_recovery_s, took_s)
    if failed_in_a_row:
        result.remarks.append(f"given up after {failed_in_a_row} faults in a row that were not survived")


def counted(before: Counters, after: Counters, account: Account, cameras: int) -> int:
    """Drops that may explain sets without an answer. Answers 500, 503 and 504 are answers, and their drops explain no other."""
    then, now = before.by_label("dropped", "reason"), after.by_label("dropped", "reason")
    sets = sum(now.get(reason, 0) - then.get(reason, 0) for reason in _SET_DROPS)
    frames = sum(now.get(reason, 0) - then.get(reason, 0) for reason in _FRAME_DROPS)
    told = sum(count for status, count in account.statuses.items() if status >= 500)
    return max(0, sets - told) + frames // cameras


async def _run_sigterm(result: FaultResult, seconds: float) -> None:
    clip = open_clip()
    steady, target, streamed = _sites(clip)
    began = time.monotonic()
    while result.injected < result.asked:
        if time.monotonic() - began > seconds:
            result.remarks.append("the time was over")
            return
        async with serving(target.document) as service:
            await put_sites(service.url, {site.id: site.document for site in (*steady, streamed)})
            async with Load(service.url, clip, steady, target, streamed) as load:
                if await load.recovers(RECOVER_S) is None:
                    result.remarks.append("the load did not come up")
                    continue
                # More than the workers can do at once, so that some wait and some run when the signal comes.
                burst = [asyncio.create_task(load.target.post()) for _ in range(_BURST)]
                load.background += burst
                await asyncio.sleep(_ON_ITS_WAY_S + 0.02)
                result.in_flight += sum(not task.done() for task in burst)
                ended = await _terminate(service)
                await asyncio.gather(*burst)
                _account_of_sigterm(result, load, *ended)


async def _terminate(service: Target) -> tuple[float, float | None, int | None]:
    """When SIGTERM was sent, seconds until the process ended, and its exit code."""
    at = time.monotonic()
    service.process.terminate()
    ended = await until(lambda: service.process.poll() is not None, EXIT_S)
    return at, time.monotonic() - at if ended else None, service.process.returncode


def _account_of_sigterm(result: FaultResult, load: Load, at: float, took_s: float | None, code: int | None) -> None:
    result.injected += 1
    if took_s is None:
        result.remarks.append(f"still running {EXIT_S:.0f} s after SIGTERM")
    else:
        result.noticed += 1
        result.slowest_recovery_s = max(result.slowest_recovery_s, took_s)
    # A process that ends by its signal, after its work, has drained; another code is a failure of its own.
    if took_s is not None and code in (0, -15):
        result.survived += 1
    elif took_s is not None:
        result.remarks.append(f"exit code {code}")
    account = load.account()
    flights = [flight for poster in (*load.posters, load.target) for flight in poster.flights]
    accepted_only = [status for sent_at, status in flights if sent_at < at - _ON_ITS_WAY_S]
    # Counters are gone with the process, so that only requests can be accounted for; those that came with or after the
    # signal may be turned away without an answer.
    account.unanswered = sum(status is None for status in accepted_only)
    account.moments = account.seen = 0
    result.account.add(account)
