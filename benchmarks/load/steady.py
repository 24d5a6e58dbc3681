"""A steady load for minutes: sets that are lost, how old answers are, and whether memory, threads or files grow."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Any, Literal

from benchmarks.load.open_loop import PostJob, post_load
from benchmarks.load.stream_generator import percentiles, stream_generator
from benchmarks.load.target_service import Counters, Target, read_counters, serving
from benchmarks.load.usage_course import UsageCourse, course_figures
from clients.clip import open_clip

Via = Literal["ws", "http"]

MAX_P99_MS = 66.0
"""From the moment when a set was due to the arrival of its message: two sets' time at 30 Hz."""
_CONNECTIONS = 8
_FIRST_S = 2.0
"""Before the measurement: the road's scale and the caches of a fresh service."""

Begin = Callable[[], Awaitable[None]]


async def measure_steady(via: Via, rate_hz: float, seconds: float) -> dict[str, Any]:
    """The figures of the clip's cameras at a rate. Raises LocalServiceError, GeneratorError, LoadError, httpx.HTTPError."""
    send = {"ws": _streamed, "http": _posted}[via]
    async with serving(open_clip().site) as target:
        await send(target, rate_hz, _FIRST_S, _nothing)
        before: list[Counters] = []
        course = UsageCourse(target.process.pid)
        watching: list[asyncio.Task[None]] = []

        async def begin() -> None:
            before.append(await asyncio.to_thread(read_counters, target.url))
            watching.append(asyncio.create_task(course.watch(seconds)))

        try:
            load = await send(target, rate_hz, seconds, begin)
        finally:
            for task in watching:
                task.cancel()
                with suppress(asyncio.CancelledError):
                    await task
        after = await asyncio.to_thread(read_counters, target.url)
    dropped = drops(before[0], after)
    service = course_figures(course.samples, seconds)
    lost = load["lost"] + sum(dropped.values())
    return {
        "via": via,
        "rate_hz": rate_hz,
        "seconds": seconds,
        "load": load,
        "dropped": dropped,
        "lost": lost,
        "max_lost": 0,
        "max_p99_ms": MAX_P99_MS,
        "service": service,
        # NaN, where nothing was answered, keeps no limit.
        "passed": not lost and load["latency_ms"]["p99"] <= MAX_P99_MS and service["passed"],
    }


async def _nothing() -> None:
    """Begins nothing."""


async def _streamed(target: Target, rate_hz: float, seconds: float, begin: Begin) -> dict[str, Any]:
    async with stream_generator(target.url, seconds, rate_hz=rate_hz) as generator:
        await begin()
        load = await generator.run()
    return load | {"lost": load["missing"] + load["degraded"] + load["refused_frames"]}


async def _posted(target: Target, rate_hz: float, seconds: float, begin: Begin) -> dict[str, Any]:
    clip = open_clip()
    cameras = {camera: camera for camera in clip.camera_ids}
    await begin()
    (done,) = await post_load([PostJob(target.url, f"/detect?site={clip.site['id']}", cameras, rate_hz, _CONNECTIONS)], seconds)
    return {
        "sent": done.offered,
        "answered": done.answered,
        "statuses": {str(status): count for status, count in sorted(done.statuses.items())},
        "lost": done.offered - done.answered,
        "latency_ms": percentiles(done.latencies_ms),
        "cpu_cores": round(done.cpu_s / done.seconds, 3),
    }


def drops(before: Counters, after: Counters) -> dict[str, int]:
    """What the service counted as dropped in between, by reason."""
    earlier = before.by_label("dropped", "reason")
    counts = {reason: count - earlier.get(reason, 0) for reason, count in after.by_label("dropped", "reason").items()}
    return {reason: count for reason, count in counts.items() if count}
