"""``bench-fps``: frame sets a second against a target, with the time of every step, beside a loop of the networks alone."""

from __future__ import annotations

import itertools
import json
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from benchmarks.bare import BareLoop
from benchmarks.clip_sets import clip_frame_sets
from benchmarks.machine import describe_machine
from benchmarks.measured import Measured
from clients.clip import ClipError
from service.errors import OverloadError, QuadliftError
from service.frames import FrameSet
from service.nets.pack import Pack, load_pack
from service.nets.providers import Provider
from service.pipeline import Pipeline, SetResult
from service.runners import make_runner
from service.scheduler import Scheduler, StoppableRunner
from service.settings import Settings, usable_cores
from service.site import load_site

console = Console(stderr=True)
ROUNDS = 4
"""The service and the bare loop take turns this often, so that a drifting machine treats both alike."""
BARE_SHARE = 0.5
"""Time of the bare loop over that of the service."""


class Via(StrEnum):
    """How frame sets reach the workers."""

    INPROC = "inproc"
    HTTP = "http"
    WS = "ws"


def run_inproc(scheduler: Scheduler, sets: Iterator[FrameSet], seconds: float, in_flight: int, into: Measured) -> None:
    """Keep ``in_flight`` sets in the scheduler for a time: a closed loop, so nothing queues for long."""
    flying: deque[tuple[float, Future[SetResult]]] = deque()
    started = time.perf_counter()
    while time.perf_counter() - started < seconds or flying:
        while len(flying) < in_flight and time.perf_counter() - started < seconds:
            flying.append((time.perf_counter(), scheduler.enqueue(next(sets))))
        begun, future = flying.popleft()
        try:
            result = future.result()
        except OverloadError:
            into.dropped += 1
            continue
        into.note(1e3 * (time.perf_counter() - begun), result.timing_ms)
    into.seconds += time.perf_counter() - started


def measure(pack: Pack, sets: Sequence[FrameSet], seconds: float, via: Via, workers: int) -> tuple[Measured, float]:
    """Throughput of the service and sets a second of the bare loop, in turns."""
    pipeline = Pipeline(pack)
    pipeline.warm_up()
    bare = BareLoop(pipeline, sets)
    ours, bare_sets, bare_seconds = Measured(), 0, 0.0
    with _way(pack, sets, via, workers) as run:
        run(min(1.0, seconds / ROUNDS), Measured())
        for _ in range(ROUNDS):
            run(seconds / ROUNDS, ours)
            done, took = bare.run(seconds * BARE_SHARE / ROUNDS, workers)
            bare_sets, bare_seconds = bare_sets + done, bare_seconds + took
    return ours, bare_sets / bare_seconds


@contextmanager
def _way(pack: Pack, sets: Sequence[FrameSet], via: Via, workers: int) -> Iterator[Callable[[float, Measured], None]]:
    if via is not Via.INPROC:
        # Needs the extra `clients`; the way in process does not.
        from benchmarks.served import run_http, served
        from benchmarks.streamed import run_ws

        run_served = run_ws if via is Via.WS else run_http
        with served(str(pack.path), pack.networks["detector"].provider, sets[0].site, workers) as url:
            yield lambda seconds, into: run_served(url, sets, seconds, workers + 1, into)
        return
    with in_process(pack, sets, workers) as run_workers:
        yield run_workers


@contextmanager
def in_process(pack: Pack, sets: Sequence[FrameSet], workers: int) -> Iterator[Callable[[float, Measured], None]]:
    """What keeps a service's workers busy, without its server, for so many seconds: one set more is under way than they run."""
    provider = pack.networks["detector"].provider
    runner = make_runner(Settings(pack=str(pack.path), provider=provider, workers=workers, log_level="warning"))
    scheduler = Scheduler(runner, workers=workers)
    endless = itertools.cycle(sets)
    try:
        runner.warm_up()
        yield lambda seconds, into: run_inproc(scheduler, endless, seconds, workers + 1, into)
    finally:
        scheduler.stop()
        if isinstance(runner, StoppableRunner):
            runner.close()


def report(ours: Measured, bare: float, target: float, pack: str, provider: str, via: Via, cameras: int) -> dict[str, Any]:
    """The figures under their contract names."""
    return {
        "sets_per_second": round(ours.sets_per_second, 2),
        "target": target,
        "latency_ms": _percentiles(ours.latency_ms, ""),
        "stages": {stage: _percentiles(values, "_ms") for stage, values in ours.stages_ms.items()},
        "dropped": ours.dropped,
        "bare_sets_per_second": round(bare, 2),
        "ratio_to_bare": round(ours.sets_per_second / bare, 3),
        "via": via.value,
        "cameras": cameras,
        "sets": ours.sets,
        "seconds": round(ours.seconds, 2),
        "machine": describe_machine(),
        "pack": pack,
        "provider": provider,
    }


def _percentiles(values: list[float], suffix: str) -> dict[str, float]:
    p50, p99 = np.percentile(values or [float("nan")], [50, 99])
    return {f"p50{suffix}": round(float(p50), 2), f"p99{suffix}": round(float(p99), 2)}


def _print_table(figures: dict[str, Any]) -> None:
    table = Table(
        title=f"{figures['sets_per_second']} frame sets/s of {figures['cameras']} cameras, target {figures['target']}"
    )
    for column in ("", "p50 ms", "p99 ms"):
        table.add_column(column, justify="right" if column else "left")
    for stage, values in figures["stages"].items():
        table.add_row(stage, str(values["p50_ms"]), str(values["p99_ms"]))
    table.add_row("latency", str(figures["latency_ms"]["p50"]), str(figures["latency_ms"]["p99"]))
    out = Console()
    out.print(table)
    out.print(
        f"networks and decoding alone: {figures['bare_sets_per_second']} sets/s, ratio {figures['ratio_to_bare']};"
        f" dropped {figures['dropped']};"
        f" pack {figures['pack']} on {figures['provider']}; {figures['machine']}"
    )


def bench_fps(
    site: Annotated[Path | None, typer.Option(help="site.json whose calibration replaces the clip's.")] = None,
    cameras: Annotated[int | None, typer.Option(min=1, help="Use only the first cameras.")] = None,
    seconds: Annotated[float, typer.Option(min=0.5, help="Time of the measurement, the bare loop aside.")] = 10.0,
    pack: Annotated[str, typer.Option(help="Pack: a shipped one's name, or a folder.")] = "edge",
    provider: Annotated[Provider, typer.Option(help="What the networks compute on.")] = "auto",
    via: Annotated[
        Via, typer.Option(help="Straight to the service's workers, or through a served process on loopback: POST or streams.")
    ] = Via.INPROC,
    target: Annotated[float, typer.Option(help="Exit with 1 below this many sets a second.")] = 30.0,
    workers: Annotated[int | None, typer.Option(min=1, help="Workers; the usable cores if left out.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Replay the shipped clip as fast as it goes and compare with a target, 30 sets a second by default."""
    try:
        sets = clip_frame_sets(cameras=cameras, site=load_site(site) if site else None)
        workers = workers or usable_cores()
        loaded = load_pack(pack, provider=provider, concurrent_runs=workers)
        ours, bare = measure(loaded, sets, seconds, via, workers)
    except (QuadliftError, ClipError) as error:
        console.print(f"[red]{error}[/red]")
        raise typer.Exit(2) from None
    figures = report(ours, bare, target, pack, loaded.provider, via, len(sets[0].frames))
    if as_json:
        typer.echo(json.dumps(figures, indent=1))
    else:
        _print_table(figures)
    if ours.sets_per_second < target:
        raise typer.Exit(1)


def main() -> None:
    """Console entry point."""
    typer.run(bench_fps)


if __name__ == "__main__":
    main()
