"""``bench-accuracy``: how many vehicles are found, and how exactly."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from benchmarks.clip_score import score_clip, score_roadside
from benchmarks.kitti_folders import read_ids, read_pair
from benchmarks.kitti_protocol import CLASSES, DEFAULT_OVERLAPS, as_percent, evaluate
from benchmarks.kitti_report import kitti_notes, kitti_table
from benchmarks.machine import describe_machine
from benchmarks.recordings import open_roadside_clip
from clients.clip import SHIPPED, ClipError
from service.errors import QuadliftError
from service.nets.pack import load_pack
from service.pipeline import Pipeline, PipelineSettings

app = typer.Typer(help="How many vehicles are found, and how exactly.", no_args_is_help=True)
console = Console()
notes = Console(stderr=True)
"""What is said beside the result, so that standard output stays JSON with --json."""

PackOption = Annotated[str, typer.Option(help="Pack: a shipped one's name, or a folder.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]


@app.command("clip")
def clip_command(
    clip: Annotated[Path, typer.Argument(help="Folder of a clip; the shipped one if left out.")] = SHIPPED,
    pack: PackOption = "edge",
    cameras: Annotated[int | None, typer.Option(help="Use only the first cameras.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Fused boxes on the demo clip against its truth."""
    _report("clip", pack, lambda pipeline: score_clip(pipeline, clip, cameras), as_json)


@app.command("roadside")
def roadside_command(pack: PackOption = "edge", as_json: JsonOption = False) -> None:
    """Three real roadside cameras against a LiDAR system's tracks (needs the recording)."""
    _report("roadside", pack, lambda pipeline: score_roadside(pipeline, open_roadside_clip()), as_json)


@app.command("kitti")
def kitti_command(
    labels: Annotated[Path, typer.Option(help="Folder of KITTI label files (label_2).")],
    results: Annotated[Path, typer.Option(help="Folder of result files in KITTI's format, with scores.")],
    ids: Annotated[Path, typer.Option(help="Text file of frame ids, one a line.")],
    min_overlap: Annotated[float, typer.Option(min=0, max=1, help="Least overlap of a car.")] = DEFAULT_OVERLAPS["Car"],
    min_overlap_others: Annotated[
        float, typer.Option(min=0, max=1, help="Least overlap of a pedestrian or cyclist.")
    ] = DEFAULT_OVERLAPS["Pedestrian"],
    as_json: JsonOption = False,
) -> None:
    """Average precision by KITTI's own protocol: 2D, orientation, bird's-eye view and 3D, at 11 and 40 recalls."""
    started = time.perf_counter()
    with _errors_named():
        pair = read_pair(labels, results, read_ids(ids))
    overlaps = {name: min_overlap if name == "Car" else min_overlap_others for name in CLASSES}
    curves = evaluate(pair, overlaps)
    if as_json:
        typer.echo(json.dumps(as_percent(curves), indent=1))
    else:
        console.print(kitti_table(curves, overlaps))
    for note in kitti_notes(pair, curves):
        notes.print(f"[yellow]{note}[/yellow]")
    notes.print(f"{pair.frames} frames in {time.perf_counter() - started:.1f} s")


@contextmanager
def _errors_named() -> Iterator[None]:
    """Turn the errors that a user can mend into one line and exit code 2."""
    try:
        yield
    except (QuadliftError, ClipError) as error:
        notes.print(f"[red]{escape(str(error))}[/red]")
        raise typer.Exit(2) from None


def _report(name: str, pack: str, score: Any, as_json: bool) -> None:
    with _errors_named():
        result = score(Pipeline(load_pack(pack), PipelineSettings()))
    if as_json:
        typer.echo(json.dumps({name: result, "pack": pack, "machine": describe_machine()}, indent=1))
        return
    table = Table(title=f"{name}, pack {pack}")
    table.add_column("figure")
    table.add_column("value", justify="right")
    for key, value in _flat(result):
        table.add_row(key, str(value))
    console.print(table)


def _flat(result: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for key, value in result.items():
        rows += _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else [(prefix + key, value)]
    return rows


def main() -> None:
    """Console entry point."""
    app()


if __name__ == "__main__":
    main()
