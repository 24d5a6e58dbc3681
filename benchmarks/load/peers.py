"""The service against other ways to serve the same networks: throughput, the rate that keeps a latency, latency under load."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks.load.open_loop import MSGPACK, MULTIPART, LoadError, PostJob, PostOutcome, bodies_of, post_load
from benchmarks.load.peer_model import SITE_FILE
from benchmarks.load.process_tree import tree_usage
from benchmarks.load.target_service import target_service
from clients.clip import open_clip
from clients.local_service import HOST, STOP_TIMEOUT_S, child_environment, free_port
from service.settings import usable_cores
from service.site import parse_site, save_site

ROUNDS = 3
"""The contenders take turns this often, so that a drifting machine treats all alike."""
LATENCY_MS = 100.0
"""Limit within which an answer counts, for the highest rate: four times what a set takes on one core."""
IN_TIME = 0.99
"""Of the requests offered: answered within the limit."""
RATE_STEPS = 5
"""Halvings of the range in which the highest rate lies."""
MIN_RATIO, MAX_P99_RATIO = 1.15, 0.70
"""Of the highest rate, and of p99 at 80 % load, to the best peer's."""
LOAD = 0.8
"""Of the best peer's throughput."""
OURS = "quadlift"
_CLOSED_CONNECTIONS = (2, 4, 8)
_OPEN_CONNECTIONS = 64
_READY_S = 60.0
_SEED = 1


@dataclass(frozen=True)
class Contender:
    """One way to serve, running."""

    name: str
    job: PostJob
    """Its address and how it wants its requests; the rate is set for each run."""
    pid: int

    def posting(self, rate_hz: float, connections: int) -> PostJob:
        """The job at a rate (0: closed loop); times are drawn, the same for all."""
        seed = _SEED if rate_hz else None
        return PostJob(
            self.job.url, self.job.path, self.job.cameras, rate_hz, connections, 5.0, seed, content_type=self.job.content_type
        )


@dataclass
class Score:
    """What a contender did in all rounds."""

    closed_hz: dict[int, list[float]] = field(default_factory=lambda: {count: [] for count in _CLOSED_CONNECTIONS})
    """Answers a second by connections."""
    kept_hz: list[float] = field(default_factory=list)
    """Highest rate that keeps the latency, a round."""
    latencies_ms: list[float] = field(default_factory=list)
    """At the load that is the same for all."""
    not_answered: int = 0
    """Of these requests."""
    generator_cores: list[float] = field(default_factory=list)
    pss_bytes: int = 0

    @property
    def peak_hz(self) -> float:
        """Throughput with the number of connections that suits it best."""
        return max(float(np.mean(rates)) for rates in self.closed_hz.values())

    def document(self) -> dict[str, Any]:
        """JSON-ready."""
        p50, p99 = np.percentile(self.latencies_ms or [float("nan")], [50, 99])
        return {
            "sets_per_second": {str(count): round(float(np.mean(rates)), 2) for count, rates in self.closed_hz.items()},
            "rate_within_latency_hz": [round(rate, 2) for rate in self.kept_hz],
            "latency_at_load_ms": {"p50": round(float(p50), 1), "p99": round(float(p99), 1)},
            "not_answered_at_load": self.not_answered,
            "generator_cores": round(float(np.mean(self.generator_cores)), 3),
            "pss_mib": round(self.pss_bytes / 2**20),
        }


async def measure_peers(seconds: float) -> dict[str, Any]:
    """All contenders in turns. Raises LocalServiceError, LoadError."""
    with tempfile.TemporaryDirectory(prefix="quadlift-peers-") as folder:
        site_file = Path(folder) / "site.json"
        save_site(parse_site(open_clip().site), site_file)
        # Starting blocks, and nothing else goes on meanwhile.
        with ExitStack() as stack:
            contenders = [stack.enter_context(start()) for start in _starts(site_file)]
            return await _measure(contenders, seconds)


async def _measure(contenders: Sequence[Contender], seconds: float) -> dict[str, Any]:
    parts = len(_CLOSED_CONNECTIONS) + RATE_STEPS + 2
    turn_s = seconds / (ROUNDS * parts * len(contenders))
    scores = {contender.name: Score() for contender in contenders}
    for contender in contenders:
        await post_load([contender.posting(0.0, 2)], min(2.0, turn_s))
    for _ in range(ROUNDS):
        for contender in contenders:
            score = scores[contender.name]
            for connections in _CLOSED_CONNECTIONS:
                done = await _post(contender, 0.0, connections, turn_s, score)
                score.closed_hz[connections].append(done.goodput_hz)
        best_hz = max(score.peak_hz for name, score in scores.items() if name != OURS)
        for contender in contenders:
            score = scores[contender.name]
            # Twice the time: a 99th percentile wants many requests.
            done = await _post(contender, LOAD * best_hz, _OPEN_CONNECTIONS, 2 * turn_s, score)
            score.latencies_ms += done.latencies_ms
            score.not_answered += done.offered - done.answered
            score.kept_hz.append(await highest_rate(_trial(contender, turn_s, score), 1.1 * score.peak_hz))
            score.pss_bytes = (await asyncio.to_thread(tree_usage, contender.pid)).pss_bytes
    return figures(scores)


async def _post(contender: Contender, rate_hz: float, connections: int, seconds: float, score: Score) -> PostOutcome:
    (done,) = await post_load([contender.posting(rate_hz, connections)], seconds)
    score.generator_cores.append(done.cpu_s / done.seconds)
    return done


def _trial(contender: Contender, seconds: float, score: Score) -> Callable[[float], Awaitable[bool]]:
    async def keeps(rate_hz: float) -> bool:
        done = await _post(contender, rate_hz, _OPEN_CONNECTIONS, seconds, score)
        return sum(latency <= LATENCY_MS for latency in done.latencies_ms) >= IN_TIME * done.offered

    return keeps


async def highest_rate(keeps: Callable[[float], Awaitable[bool]], most_hz: float, steps: int = RATE_STEPS) -> float:
    """The highest rate up to ``most_hz`` that keeps the limit, by halving; 0 when none was found that does."""
    low, high = 0.0, most_hz
    for _ in range(steps):
        middle = 0.5 * (low + high)
        if await keeps(middle):
            low = middle
        else:
            high = middle
    return low


def figures(scores: dict[str, Score]) -> dict[str, Any]:
    """Everybody's figures, ours against the best of the others, and whether the limits were kept."""
    ours = scores[OURS]
    others = {name: score for name, score in scores.items() if name != OURS}
    kept = {name: float(np.mean(score.kept_hz)) for name, score in scores.items()}
    p99 = {name: float(np.percentile(score.latencies_ms or [float("inf")], 99)) for name, score in scores.items()}
    best_rate, best_p99 = max(others, key=lambda name: kept[name]), min(others, key=lambda name: p99[name])
    best_peak = max(score.peak_hz for score in others.values())
    ratio = kept[OURS] / kept[best_rate] if kept[best_rate] else float("inf")
    p99_ratio = p99[OURS] / p99[best_p99]
    return {
        "latency_limit_ms": LATENCY_MS,
        "load_hz": round(LOAD * best_peak, 2),
        "contenders": {name: score.document() for name, score in scores.items()},
        "throughput_ratio": round(ours.peak_hz / best_peak, 3),
        "best_peer_within_latency": best_rate,
        "ratio_to_best": round(ratio, 3),
        "min_ratio": MIN_RATIO,
        "best_peer_p99": best_p99,
        "p99_ratio": round(p99_ratio, 3),
        "max_p99_ratio": MAX_P99_RATIO,
        "passed": ratio >= MIN_RATIO and p99_ratio <= MAX_P99_RATIO and not ours.not_answered,
    }


def _starts(site_file: Path) -> Iterator[Callable[[], Any]]:
    cores = usable_cores()
    yield _ours
    many, one = ["--processes", str(cores), "--threads", "1"], ["--processes", "1", "--threads", str(cores)]
    yield lambda: peer("fastapi", "peer_fastapi", many, site_file)
    yield lambda: peer("fastapi threads", "peer_fastapi", one, site_file)
    yield lambda: peer("litserve", "peer_litserve", ["--processes", str(cores)], site_file)
    yield lambda: peer("mosec", "peer_mosec", ["--processes", str(cores)], site_file)


@contextmanager
def _ours() -> Iterator[Contender]:
    clip = open_clip()
    with target_service(clip.site) as target:
        cameras = {camera: camera for camera in clip.camera_ids}
        yield Contender(OURS, PostJob(target.url, f"/detect?site={clip.site['id']}", cameras), target.process.pid)


@contextmanager
def peer(name: str, module: str, options: Sequence[str], site_file: Path) -> Iterator[Contender]:
    """A peer's module as a process that has answered a frame set, for as long as the block runs. Raises LoadError."""
    clip, port = open_clip(), free_port(0)
    is_mosec = module == "peer_mosec"
    address = ["--address", HOST] if is_mosec else ["--host", HOST]
    command = [sys.executable, "-m", f"benchmarks.load.{module}", *address, "--port", str(port), *options]
    job = PostJob(
        f"http://{HOST}:{port}",
        "/detect",
        {camera: camera for camera in clip.camera_ids},
        content_type=MSGPACK if is_mosec else MULTIPART,
    )
    environment = child_environment() | {SITE_FILE: str(site_file)}
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=log, start_new_session=True)
        try:
            _await_answer(process, job, log)
            yield Contender(name, job, process.pid)
        finally:
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(STOP_TIMEOUT_S)
            # SIGTERM ends LitServe's parent alone: its workers and HTTP servers would stay for good.
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def _await_answer(process: subprocess.Popen[bytes], job: PostJob, log: Any) -> None:
    """Until a first frame set is answered. Raises LoadError with the peer's last words."""
    body, until = bodies_of(job)[0], time.monotonic() + _READY_S
    while time.monotonic() < until and process.poll() is None:
        try:
            response = httpx.post(job.url + job.path, content=body, headers={"Content-Type": job.content_type}, timeout=10)
            if response.status_code == 200 and response.json()["boxes"]:
                return
        except httpx.TransportError:
            # It does not listen yet.
            pass
        time.sleep(0.2)
    log.seek(0)
    raise LoadError(f"{job.url} did not answer: {log.read()[-1500:].decode('utf-8', 'replace')}")
