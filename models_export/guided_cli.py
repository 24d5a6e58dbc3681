"""Command line ``quadlift guided``: the depth-guided detector, trained beside a pack's depth net and added to that pack."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from models_export.guided import GuidedRecipe, export_guided, train_guided
from service.errors import QuadliftError

app = typer.Typer(help="The depth-guided detector: train it, add it to a pack.", no_args_is_help=True)
console = Console()

DataOption = Annotated[list[Path], typer.Option("--data", help="Data set: a folder of scenes. Repeatable.")]
RunsOption = Annotated[Path, typer.Option(help="Folder of checkpoints, logs and curves.")]
PackOption = Annotated[str, typer.Option(help="Pack whose depth net guides: a shipped one's name, or a folder.")]
RUNS = Path("runs/edge")


@app.command("train")
def train_command(
    data: DataOption,
    pack: PackOption = "edge",
    runs: RunsOption = RUNS,
    steps: Annotated[int | None, typer.Option(help="Optimiser steps; the recipe's if left out.")] = None,
    batch_size: Annotated[int | None, typer.Option(help="Frames a step; the recipe's if left out.")] = None,
    max_minutes: Annotated[float | None, typer.Option(help="Stop by then, with a checkpoint.")] = None,
    device: Annotated[str, typer.Option(help="torch device: cpu, cuda, ...")] = "cpu",
    seed: Annotated[int, typer.Option(help="Of weights, data order and augmentation.")] = 1,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint.")] = False,
) -> None:
    """Train the depth-guided detector beside a pack's depth net."""
    given = {"steps": steps, "batch_size": batch_size, "max_minutes": max_minutes, "device": device, "seed": seed}
    try:
        training = replace(GuidedRecipe().training, **{key: value for key, value in given.items() if value is not None})
        train_guided(data, pack, runs, replace(GuidedRecipe(), training=training), resume=resume)
    except QuadliftError as error:
        raise _failed(error) from None


@app.command("export")
def export_command(
    data: DataOption,
    out: Annotated[Path, typer.Option(help="Folder of the pack with the detector.")],
    pack: PackOption = "edge",
    runs: RunsOption = RUNS,
) -> None:
    """Export the depth-guided detector, check it against torch, score it, and write the pack with it."""
    try:
        export_guided(runs, data, pack, out, GuidedRecipe(), console)
    except QuadliftError as error:
        raise _failed(error) from None


def _failed(error: QuadliftError) -> typer.Exit:
    console.print(f"[red]{escape(str(error))}[/red]")
    return typer.Exit(1)
