"""More than the service can do: what it still does, how late, and what it says to those that it turns away."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import Any

import numpy as np

from benchmarks.load.open_loop import PostJob, PostOutcome, post_load
from benchmarks.load.steady import drops
from benchmarks.load.stream_generator import stream_generator
from benchmarks.load.target_service import Target, read_counters, serving
from clients.clip import open_clip
from service.settings import Settings

ROUNDS = 4
"""Peak and overloads take turns, so that a drifting machine treats all alike."""
FACTORS = (2, 5)
MIN_GOODPUT = 0.90
"""Of the peak."""
MAX_DEADLINES = 2.0
"""p99 of what is accepted, in deadlines."""
PEAK_CONNECTIONS = 4
"""Enough that no worker waits for a request."""
_OVERLOAD_CONNECTIONS = 128


async def measure_overload(seconds: float) -> dict[str, Any]:
    """Goodput and latency of what is accepted at twice and five times the peak, by POST and over camera streams.

    Raises LocalServiceError, LoadError, GeneratorError.
    """
    clip = open_clip()
    cameras = {camera: camera for camera in clip.camera_ids}
    turn_s = seconds / (ROUNDS * (len(FACTORS) + 2))
    phases = {factor: PostOutcome() for factor in (1, *FACTORS)}
    streamed: list[dict[str, Any]] = []
    async with serving(clip.site) as target:

        async def post(rate_hz: float, connections: int) -> PostOutcome:
            path = f"/detect?site={clip.site['id']}"
            return (await post_load([PostJob(target.url, path, cameras, rate_hz, connections)], turn_s))[0]

        await post(0.0, PEAK_CONNECTIONS)
        for _ in range(ROUNDS):
            phases[1].add(await post(0.0, PEAK_CONNECTIONS))
            for factor in FACTORS:
                # Against the newest peak: a machine drifts.
                phases[factor].add(await post(factor * phases[1].goodput_hz, _OVERLOAD_CONNECTIONS))
            streamed.append(await _streamed(target, turn_s, FACTORS[0] * phases[1].goodput_hz))
    return _figures(phases, streamed)


async def _streamed(target: Target, seconds: float, rate_hz: float) -> dict[str, Any]:
    before = await asyncio.to_thread(read_counters, target.url)
    async with stream_generator(target.url, seconds, rate_hz=rate_hz) as generator:
        said = await generator.run()
    after = await asyncio.to_thread(read_counters, target.url)
    return {"seconds": seconds, "dropped": drops(before, after), **said}


def _figures(phases: dict[int, PostOutcome], streamed: list[dict[str, Any]]) -> dict[str, Any]:
    deadline_ms = Settings.model_fields["deadline_ms"].default
    peak_hz = phases[1].goodput_hz
    overloads = {}
    for factor in FACTORS:
        figures = _document(phases[factor])
        kept = phases[factor].goodput_hz / peak_hz
        overloads[f"{factor}x"] = figures | {
            "goodput_ratio": round(kept, 3),
            "passed": kept >= MIN_GOODPUT
            and figures["latency_ms"]["p99"] <= MAX_DEADLINES * deadline_ms
            and not figures["busy_without_retry_after"]
            and phases[factor].statuses.keys() <= {200, 503},
        }
    dropped = sum((Counter(part["dropped"]) for part in streamed), Counter[str]())
    answered, sent = sum(part["answered"] for part in streamed), sum(part["sent"] for part in streamed)
    stream_hz = answered / sum(part["seconds"] for part in streamed)
    return {
        "deadline_ms": deadline_ms,
        "min_goodput_ratio": MIN_GOODPUT,
        "max_p99_ms": MAX_DEADLINES * deadline_ms,
        "peak": _document(phases[1]),
        "overload": overloads,
        "streams_2x": {
            "sent": sent,
            "answered": answered,
            "goodput_hz": round(stream_hz, 2),
            # Not of the streams' own peak: that is measured by `throughput`.
            "goodput_ratio_to_post_peak": round(stream_hz / peak_hz, 3),
            "p99_ms": [part["latency_ms"]["p99"] for part in streamed],
            "dropped": dict(dropped),
            # What was sent is answered, or counted by its reason; sets may be merged where capture times are near.
            "unexplained": max(0, sent - answered - sum(dropped.values())),
        },
        "passed": all(figures["passed"] for figures in overloads.values()),
    }


def _document(phase: PostOutcome) -> dict[str, Any]:
    """All turns of one load, JSON-ready."""
    p50, p99 = np.percentile(phase.latencies_ms or [float("nan")], [50, 99])
    return {
        "offered_hz": round(phase.offered / phase.seconds, 2),
        "goodput_hz": round(phase.goodput_hz, 2),
        "latency_ms": {"p50": round(float(p50), 1), "p99": round(float(p99), 1)},
        "statuses": {str(status): count for status, count in sorted(phase.statuses.items())},
        "busy_without_retry_after": phase.busy_without_retry_after,
        "generator_cores": round(phase.cpu_s / phase.seconds, 3),
    }
