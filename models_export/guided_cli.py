"""Command line ``quadlift guided``: train the depth-guided detector, and add it to a pack."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from models_export.guided import RECIPES, export_guided, train_guided
from service.errors import QuadliftError

app = typer.Typer(help="The depth-guided detector: train it, and add it to a pack.", no_args_is_help=True)
console = Console()


class Size(StrEnum):
    """Sizes of the network."""

    EDGE = "edge"
    PAPER = "paper"


DataOption = Annotated[list[Path], typer.Option("--data", help="Data set: a folder of scenes. Repeatable.")]
PackOption = Annotated[str, typer.Option(help="Pack whose depth net guides: a shipped one's name, or a folder.")]
SizeOption = Annotated[Size, typer.Option(help="edge, or paper: the published network.")]
RunsOption = Annotated[Path, typer.Option(help="Folder of checkpoint, logs and curves.")]
RUNS = Path("runs/guided")


@app.command("train")
def train_command(
    data: DataOption,
    pack: PackOption = "edge",
    size: SizeOption = Size.EDGE,
    runs: RunsOption = RUNS,
    steps: Annotated[int | None, typer.Option(help="Optimiser steps; the recipe's if left out.")] = None,
    batch_size: Annotated[int | None, typer.Option(help="Frames a step; the recipe's if left out.")] = None,
    learning_rate: Annotated[float | None, typer.Option(help="Peak rate; the recipe's if left out.")] = None,
    max_minutes: Annotated[
        float | None, typer.Option(help="Stop by then, with a checkpoint, the schedule run to its end.")
    ] = None,
    device: Annotated[str, typer.Option(help="torch device: cpu, cuda, ...")] = "cpu",
    seed: Annotated[int, typer.Option(help="Of weights, data order and augmentation.")] = 1,
    init: Annotated[
        Path | None, typer.Option(help="Checkpoint, or for size paper ImageNet's ResNet-50, to start from.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint.")] = False,
) -> None:
    """Train on scenes, guided by a pack's depth net."""
    changes: dict[str, Any] = {
        "batch_size": batch_size, "learning_rate": learning_rate, "max_minutes": max_minutes, "device": device, "seed": seed,
    }  # fmt: skip
    given = {key: value for key, value in changes.items() if value is not None}
    if steps is not None:
        given |= {"steps": steps, "epochs": None}
    recipe = RECIPES[size.value]
    with _errors_named():
        recipe = replace(recipe, training=replace(recipe.training, **given))
        train_guided(data, pack, runs, recipe, init=init, resume=resume)


@app.command("export")
def export_command(
    data: DataOption,
    out: Annotated[Path, typer.Option(help="Folder of the pack with the detector; may be that of --pack.")],
    pack: PackOption = "edge",
    size: SizeOption = Size.EDGE,
    runs: RunsOption = RUNS,
) -> None:
    """Export, check against torch, measure on validation scenes, and write the pack with it."""
    with _errors_named():
        manifest = export_guided(runs, data, pack, out, RECIPES[size.value], console)
        console.print(f"pack '{manifest.name}' with {', '.join(manifest.networks)} in {out}")


@contextmanager
def _errors_named() -> Iterator[None]:
    """Turn the errors that a user can mend into one line and exit code 1."""
    try:
        yield
    except QuadliftError as error:
        console.print(f"[red]{escape(str(error))}[/red]")
        raise typer.Exit(1) from None


if __name__ == "__main__":
    app()
