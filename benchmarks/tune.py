"""``quadlift tune``: which workers and threads do most on this machine, on the shipped clip, within a latency limit."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from benchmarks.clip_sets import clip_frame_sets
from benchmarks.machine import describe_machine
from clients.clip import ClipError
from service.errors import QuadliftError
from service.nets.providers import Provider
from service.runners import make_runner
from service.scheduler import FrameSetRunner
from service.settings import Settings, usable_cores
from service.tuning import Candidate, Trial, best, candidates, measure, with_settings

out = Console()
console = Console(stderr=True)


def figures(trials: list[Trial], chosen: Trial, is_kept: bool, max_latency_ms: float) -> dict[str, Any]:
    """What ``--json`` prints."""
    return {
        "trials": [
            {
                "workers": trial.candidate.workers,
                "intra_op_threads": trial.candidate.intra_op_threads,
                "sets_per_second": round(trial.sets_per_second, 2),
                "latency_ms": {f"p{p}": round(trial.latency_percentile_ms(p), 2) for p in (50, 99)},
                "sets": trial.sets,
            }
            for trial in trials
        ],
        "settings": chosen.candidate.settings(),
        "max_latency_ms": max_latency_ms,
        "keeps_latency": is_kept,
        "machine": describe_machine(),
    }


def _table(trials: list[Trial], chosen: Trial, cameras: int) -> Table:
    table = Table(title=f"frame sets of {cameras} cameras")
    for column in ("workers", "threads each", "sets/s", "p50 ms", "p99 ms", "sets", ""):
        table.add_column(column, justify="right")
    for trial in trials:
        latency = [f"{trial.latency_percentile_ms(p):.1f}" for p in (50, 99)]
        row = [str(trial.candidate.workers), str(trial.candidate.intra_op_threads), f"{trial.sets_per_second:.2f}", *latency]
        table.add_row(*row, str(trial.sets), "<-" if trial is chosen else "")
    return table


def _write(path: Path, text: str) -> None:
    """Replace a file in one step."""
    handle, temporary = tempfile.mkstemp(dir=path.resolve().parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            stream.write(text)
        if path.exists():
            # An environment file may hold tokens: whoever could read it before still can, and nobody else.
            Path(temporary).chmod(path.stat().st_mode)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def tune(
    pack: Annotated[str, typer.Option(help="Pack: a shipped one's name, or a folder.")] = "edge",
    provider: Annotated[Provider, typer.Option(help="What the networks compute on.")] = "auto",
    cameras: Annotated[int | None, typer.Option(min=1, help="Use only the first cameras of the clip.")] = None,
    seconds: Annotated[float, typer.Option(min=0.5, help="Time of the measurement, loading aside.")] = 30.0,
    latency_ms: Annotated[float, typer.Option(min=1.0, help="p99 of a frame set's latency that must be kept.")] = 100.0,
    write: Annotated[Path | None, typer.Option(help="Environment file to put the settings into.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print figures as JSON.")] = False,
) -> None:
    """Measure ways to use the cores, in turns, and give the settings of the best one."""

    def load(candidate: Candidate) -> FrameSetRunner:
        workers, threads = candidate.workers, candidate.intra_op_threads
        runner = make_runner(Settings(pack=pack, provider=provider, workers=workers, intra_op_threads=threads))
        runner.warm_up()
        return runner

    try:
        sets = clip_frame_sets(cameras=cameras)
        trials = measure(load, sets, candidates(usable_cores()), seconds)
        chosen, is_kept = best(trials, latency_ms)
        if write is not None:
            _write(write, with_settings(write.read_text("utf-8") if write.exists() else "", chosen.candidate.settings()))
    except (QuadliftError, ClipError, OSError) as error:
        console.print(f"Error: {error}", style="red", markup=False)
        raise typer.Exit(1) from None
    if as_json:
        print(json.dumps(figures(trials, chosen, is_kept, latency_ms)))
        return
    out.print(_table(trials, chosen, len(sets[0].frames)))
    out.print(f"pack {pack}; {', '.join(f'{name} {value}' for name, value in describe_machine().items())}", highlight=False)
    if not is_kept:
        console.print(f"No way keeps {latency_ms:g} ms; this one is the quickest.", style="yellow", markup=False)
    for name, value in chosen.candidate.settings().items():
        print(f"{name}={value}")
    if write is not None:
        console.print(f"Written to {write}.", markup=False, highlight=False)


app = typer.Typer(add_completion=False)
app.command()(tune)
