"""Frame sets a second of the bare loop, in process, and through the service's two ways in, in turns."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from benchmarks.bare import BareLoop
from benchmarks.clip_sets import clip_frame_sets
from benchmarks.fps import in_process
from benchmarks.load.open_loop import PostJob, post_load
from benchmarks.load.stream_generator import stream_generator
from benchmarks.load.target_service import serving
from benchmarks.measured import Measured
from clients.clip import open_clip
from service.nets.pack import load_pack
from service.pipeline import Pipeline
from service.settings import usable_cores

ROUNDS = 4
"""Turns of each way, so that a drifting machine treats all alike."""
MIN_INPROC_RATIO = 0.90
"""Of the bare loop."""
_WARM_UP_S = 1.0


@dataclass
class Turns:
    """What one way did in its turns."""

    sets: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    client_cores: list[float] = field(default_factory=list)
    """Processor time of the sending process over the time, where that is a process of its own."""

    def add(self, sets: int, seconds: float, client_cores: float | None = None) -> None:
        """One turn."""
        self.sets.append(sets)
        self.seconds.append(seconds)
        if client_cores is not None:
            self.client_cores.append(client_cores)

    @property
    def sets_per_second(self) -> float:
        """Of all turns together."""
        return sum(self.sets) / sum(self.seconds)

    def document(self) -> dict[str, Any]:
        """JSON-ready."""
        rounds = [round(sets / seconds, 2) for sets, seconds in zip(self.sets, self.seconds, strict=True)]
        figures: dict[str, Any] = {"sets_per_second": round(self.sets_per_second, 2), "rounds": rounds}
        if self.client_cores:
            figures["client_cpu_cores"] = round(sum(self.client_cores) / len(self.client_cores), 3)
        return figures


async def measure_throughput(seconds: float) -> dict[str, Any]:
    """The figures of so many seconds, all ways together. Raises QuadliftError, LocalServiceError,
    GeneratorError, LoadError."""
    workers, sets = usable_cores(), clip_frame_sets()
    pack = load_pack("edge", concurrent_runs=workers)
    pipeline = Pipeline(pack)
    pipeline.warm_up()
    bare, clip = BareLoop(pipeline, sets), open_clip()
    async with serving(clip.site) as target:
        cameras = {camera: camera for camera in clip.camera_ids}
        job = PostJob(target.url, f"/detect?site={clip.site['id']}", cameras, connections=workers + 1)
        with in_process(pack, sets, workers) as inproc:

            async def run_bare(turn_s: float, into: Turns) -> None:
                into.add(*await asyncio.to_thread(bare.run, turn_s, workers))

            async def run_inproc(turn_s: float, into: Turns) -> None:
                measured = Measured()
                await asyncio.to_thread(inproc, turn_s, measured)
                into.add(measured.sets, measured.seconds)

            async def run_ws(turn_s: float, into: Turns) -> None:
                async with stream_generator(target.url, turn_s, in_flight=workers + 1) as generator:
                    done = await generator.run()
                into.add(done["sets"], done["seconds"], done["cpu_cores"])

            async def run_http(turn_s: float, into: Turns) -> None:
                (done,) = await post_load([job], turn_s)
                into.add(done.in_time, done.seconds, done.cpu_s / done.seconds)

            turns = await _in_turns({"bare": run_bare, "inproc": run_inproc, "http": run_http, "ws": run_ws}, seconds)
    return figures(turns)


async def _in_turns(ways: Mapping[str, Callable[[float, Turns], Awaitable[None]]], seconds: float) -> dict[str, Turns]:
    for run in ways.values():
        await run(_WARM_UP_S, Turns())
    turns = {name: Turns() for name in ways}
    for _ in range(ROUNDS):
        for name, run in ways.items():
            await run(seconds / (ROUNDS * len(ways)), turns[name])
    return turns


def figures(turns: Mapping[str, Turns]) -> dict[str, Any]:
    """The ways' figures, their ratios, and whether the limit was kept."""
    rates = {name: way.sets_per_second for name, way in turns.items()}
    ratios = {
        f"{over}_over_{under}": round(rates[over] / rates[under], 3)
        for under in ("bare", "inproc")
        for over in ("inproc", "http", "ws")
        if over != under
    }
    return {
        "ways": {name: way.document() for name, way in turns.items()},
        "ratios": ratios,
        "min_inproc_over_bare": MIN_INPROC_RATIO,
        "passed": rates["inproc"] / rates["bare"] >= MIN_INPROC_RATIO,
    }
