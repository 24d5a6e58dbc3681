"""Load by POST from a process of its own: requests at their times, whatever becomes of those before, or one after the other.

Requests are made beforehand and answers hardly looked at: the generator shares the machine with what it measures, and names
the processor time that it takes.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import random
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from typing import Any
from urllib.parse import urlsplit

import msgpack

from benchmarks.load.parsers import BOUNDARY, multipart_form
from clients.clip import open_clip
from clients.local_service import child_environment

PROGRAM = "from benchmarks.load.open_loop import main; main()"
MULTIPART = f"multipart/form-data; boundary={BOUNDARY.decode()}"
MSGPACK = "application/msgpack"
"""A map of the frames by camera, for servers that read no forms."""
ENDED = 0
"""Status of a request that got no answer."""
_SLACK_S = 30.0
"""For the process to start, and to make its requests."""
_START_DELAY_S = 0.05


class LoadError(Exception):
    """The generator ended without figures; the message holds its last words."""


@dataclass(frozen=True)
class PostJob:
    """What one client posts, over connections of its own."""

    url: str
    path: str
    cameras: dict[str, str]
    """The clip's camera by the form's field."""
    rate_hz: float = 0.0
    """Requests a second, at their times; 0: every connection sends the next when it has its answer."""
    connections: int = 4
    """At once, at most; a request that finds none free waits for one, and that counts."""
    timeout_s: float = 10.0
    """A request that has waited and run for this long has no answer."""
    poisson_seed: int | None = None
    """Times are drawn, with the rate as their mean; None: evenly spaced."""
    content_type: str = MULTIPART
    """:data:`MULTIPART` or :data:`MSGPACK`."""


@dataclass
class PostOutcome:
    """What became of one client's requests."""

    offered: int = 0
    statuses: dict[int, int] = field(default_factory=dict)
    """Answers by status; :data:`ENDED` where there was none."""
    latencies_ms: list[float] = field(default_factory=list)
    """Of those answered 200, from the time when each was due."""
    busy_without_retry_after: int = 0
    """503s that do not say when to come back."""
    in_time: int = 0
    """Answered 200 before the schedule ended."""
    seconds: float = 0.0
    """Of the schedule."""
    cpu_s: float = 0.0
    """Processor time of the generator, for all its clients together."""

    @property
    def answered(self) -> int:
        """Requests that were answered 200."""
        return self.statuses.get(200, 0)

    @property
    def goodput_hz(self) -> float:
        """Requests answered 200 within the schedule, a second: what still waited at its end is no throughput."""
        return self.in_time / self.seconds if self.seconds else 0.0

    def add(self, later: PostOutcome) -> None:
        """Count those of another turn with these."""
        self.offered += later.offered
        for status, count in later.statuses.items():
            self.statuses[status] = self.statuses.get(status, 0) + count
        self.latencies_ms += later.latencies_ms
        self.busy_without_retry_after += later.busy_without_retry_after
        self.in_time += later.in_time
        self.seconds += later.seconds
        self.cpu_s += later.cpu_s


async def post_load(jobs: Sequence[PostJob], seconds: float) -> list[PostOutcome]:
    """The outcomes of clients that post side by side for a time. Raises LoadError."""
    pipe = asyncio.subprocess.PIPE
    command = [sys.executable, "-P", "-c", PROGRAM]
    process = await asyncio.create_subprocess_exec(*command, env=child_environment(), stdin=pipe, stdout=pipe, stderr=pipe)
    order = json.dumps({"jobs": [asdict(job) for job in jobs], "seconds": seconds}).encode()
    try:
        async with asyncio.timeout(seconds + max(job.timeout_s for job in jobs) + _SLACK_S):
            said, complained = await process.communicate(order)
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    if process.returncode:
        raise LoadError(complained.decode("utf-8", "replace")[-1500:].strip() or f"it ended with {process.returncode}")
    found = json.loads(said)
    return [PostOutcome(**one | {"statuses": {int(k): v for k, v in one["statuses"].items()}}) for one in found]


def due_times(rate_hz: float, seconds: float, poisson_seed: int | None = None) -> Iterator[float]:
    """Seconds from the start at which requests are due, below ``seconds``."""
    draw, due = random.Random(poisson_seed), 0.0
    for number in itertools.count(1):
        if due >= seconds:
            return
        yield due
        # Even times are not summed up: errors would be.
        due = number / rate_hz if poisson_seed is None else due + draw.expovariate(rate_hz)


@dataclass(frozen=True)
class Answer:
    """The head of a response; its body is thrown away."""

    status: int
    has_retry_after: bool
    is_last: bool
    """The server closes the connection after it."""


async def read_answer(reader: asyncio.StreamReader) -> Answer:
    """One response with a Content-Length. Raises asyncio.IncompleteReadError, and ValueError for one without."""
    head = await reader.readuntil(b"\r\n\r\n")
    status_line, *lines = head[:-4].split(b"\r\n")
    headers = {name.strip().lower(): value.strip() for name, _, value in (line.partition(b":") for line in lines)}
    if b"content-length" not in headers:
        raise ValueError(f"a response without a length: {head[:200]!r}")
    await reader.readexactly(int(headers[b"content-length"]))
    return Answer(int(status_line.split()[1]), b"retry-after" in headers, headers.get(b"connection", b"").lower() == b"close")


class Poster:
    """One client: posts requests in turn."""

    def __init__(self, job: PostJob, requests: Sequence[bytes]) -> None:
        """requests: whole HTTP requests."""
        self.outcome = PostOutcome()
        self._job = job
        self._requests = itertools.cycle(requests)
        self._statuses: Counter[int] = Counter()
        self._due: asyncio.Queue[float | None] = asyncio.Queue()

    async def run(self, began: float, seconds: float) -> PostOutcome:
        """Post from a time on (time.perf_counter) for so many seconds, and wait for the last answers."""
        until = began + seconds
        senders = [asyncio.create_task(self._send_all(began, until)) for _ in range(self._job.connections)]
        if self._job.rate_hz:
            for due in due_times(self._job.rate_hz, seconds, self._job.poisson_seed):
                await asyncio.sleep(max(0.0, began + due - time.perf_counter()))
                self.outcome.offered += 1
                self._due.put_nowait(began + due)
        for _ in senders:
            self._due.put_nowait(None)
        await asyncio.gather(*senders)
        self.outcome.statuses = dict(self._statuses)
        self.outcome.seconds = seconds
        return self.outcome

    async def _next_due(self, began: float, until: float) -> float | None:
        if self._job.rate_hz:
            return await self._due.get()
        await asyncio.sleep(max(0.0, began - time.perf_counter()))
        now = time.perf_counter()
        if now >= until:
            return None
        self.outcome.offered += 1
        return now

    async def _send_all(self, began: float, until: float) -> None:
        link: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        parts = urlsplit(self._job.url)
        while (due := await self._next_due(began, until)) is not None:
            answer = None
            try:
                # Also what has waited too long for a connection has timed out.
                async with asyncio.timeout(due + self._job.timeout_s - time.perf_counter()):
                    if link is None:
                        link = await asyncio.open_connection(parts.hostname, parts.port, limit=2**20)
                    link[1].write(next(self._requests))
                    answer = await read_answer(link[0])
            except (OSError, TimeoutError, asyncio.IncompleteReadError):
                # Counted below: a request that got no answer.
                pass
            now = time.perf_counter()
            self._note(answer, 1e3 * (now - due))
            self.outcome.in_time += answer is not None and answer.status == 200 and now <= until
            if link is not None and (answer is None or answer.is_last):
                await _close(link[1])
                link = None
        if link is not None:
            await _close(link[1])

    def _note(self, answer: Answer | None, latency_ms: float) -> None:
        if answer is None:
            self._statuses[ENDED] += 1
            return
        self._statuses[answer.status] += 1
        if answer.status == 200:
            self.outcome.latencies_ms.append(round(latency_ms, 2))
        elif answer.status == 503:
            self.outcome.busy_without_retry_after += not answer.has_retry_after


async def _close(writer: asyncio.StreamWriter) -> None:
    writer.close()
    with suppress(OSError):
        await writer.wait_closed()


def bodies_of(job: PostJob) -> list[bytes]:
    """Every step of the clip as a body."""
    clip = open_clip()
    sets = [{name: clip.frame(camera, step) for name, camera in job.cameras.items()} for step in range(clip.steps)]
    return [msgpack.packb(frames) if job.content_type == MSGPACK else multipart_form(frames) for frames in sets]


def requests_of(job: PostJob) -> list[bytes]:
    """Every step of the clip as a whole HTTP request."""
    host = urlsplit(job.url).netloc
    head = f"POST {job.path} HTTP/1.1\r\nHost: {host}\r\nContent-Type: {job.content_type}\r\nContent-Length: "
    return [f"{head}{len(body)}\r\n\r\n".encode() + body for body in bodies_of(job)]


async def _generate(jobs: Sequence[PostJob], seconds: float) -> list[PostOutcome]:
    made: dict[str, list[bytes]] = {}
    for job in jobs:
        key = f"{job.url} {job.path} {job.cameras}"
        made[key] = made.get(key) or requests_of(job)
    posters = [Poster(job, made[f"{job.url} {job.path} {job.cameras}"]) for job in jobs]
    cpu_s, began = time.process_time(), time.perf_counter() + _START_DELAY_S
    outcomes = await asyncio.gather(*(poster.run(began, seconds) for poster in posters))
    cpu_s = time.process_time() - cpu_s
    for outcome in outcomes:
        outcome.cpu_s = round(cpu_s, 3)
    return outcomes


def main() -> None:
    """The generator's process: jobs as JSON in, outcomes as JSON out."""
    order: dict[str, Any] = json.load(sys.stdin)
    jobs = [PostJob(**job) for job in order["jobs"]]
    print(json.dumps([asdict(outcome) for outcome in asyncio.run(_generate(jobs, order["seconds"]))]))
