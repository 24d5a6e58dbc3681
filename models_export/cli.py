"""Command lines ``quadlift train`` and ``quadlift export``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from models_export.edge import NETWORKS, EdgeRecipe, export, train
from models_export.guided import GuidedRecipe, export_guided, train_guided
from service.errors import QuadliftError

train_app = typer.Typer(help="Train the networks of pack `edge` on rendered scenes.", no_args_is_help=True)
export_app = typer.Typer(help="Export trained networks to a pack.", no_args_is_help=True)
console = Console()

DataOption = Annotated[list[Path], typer.Option("--data", help="Data set: a folder of scenes. Repeatable.")]
RunsOption = Annotated[Path, typer.Option("--runs", help="Folder of checkpoints, logs and curves.")]
StepsOption = Annotated[int | None, typer.Option(help="Optimiser steps; the recipe's if left out.")]
BatchOption = Annotated[int | None, typer.Option(help="Samples a step; the recipe's if left out.")]
DeviceOption = Annotated[str, typer.Option(help="torch device: cpu, cuda, ...")]
SeedOption = Annotated[int, typer.Option(help="Seed of weights and data order.")]
ResumeOption = Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint.")]
RUNS = Path("runs/edge")


def _train(
    networks: tuple[str, ...],
    data: list[Path],
    runs: Path,
    steps: int | None,
    batch_size: int | None,
    device: str,
    seed: int,
    resume: bool,
) -> None:
    recipe = EdgeRecipe()
    for name in networks:
        base = recipe.training[name]
        config = replace(base, device=device, seed=seed, steps=steps or base.steps, batch_size=batch_size or base.batch_size)
        try:
            train(name, data, runs, replace(recipe, training={**recipe.training, name: config}), resume=resume)
        except QuadliftError as error:
            console.print(f"[red]{error}[/red]")
            raise typer.Exit(1) from None


def _add_train_command(name: str, networks: tuple[str, ...], text: str) -> None:
    @train_app.command(name, help=text)
    def command(
        data: DataOption,
        runs: RunsOption = RUNS,
        steps: StepsOption = None,
        batch_size: BatchOption = None,
        device: DeviceOption = "cpu",
        seed: SeedOption = 1,
        resume: ResumeOption = False,
    ) -> None:
        _train(networks, data, runs, steps, batch_size, device, seed, resume)


for _name in NETWORKS:
    _add_train_command(_name, (_name,), f"Train the {_name} network.")
_add_train_command("all", NETWORKS, "Train all three networks in turn.")


@train_app.command("guided")
def train_guided_command(
    data: DataOption,
    pack: Annotated[str, typer.Option(help="Pack whose depth net guides: a shipped one's name, or a folder.")] = "edge",
    runs: RunsOption = RUNS,
    steps: StepsOption = None,
    batch_size: BatchOption = None,
    device: DeviceOption = "cpu",
    seed: SeedOption = 1,
    resume: ResumeOption = False,
) -> None:
    """Train the depth-guided detector beside a pack's depth net."""
    base = GuidedRecipe().training
    config = replace(base, device=device, seed=seed, steps=steps or base.steps, batch_size=batch_size or base.batch_size)
    try:
        train_guided(data, pack, runs, replace(GuidedRecipe(), training=config), resume=resume)
    except QuadliftError as error:
        console.print(f"[red]{error}[/red]")
        raise typer.Exit(1) from None


@export_app.command("edge")
def export_edge(
    data: DataOption,
    runs: RunsOption = RUNS,
    out: Annotated[Path, typer.Option(help="Folder of the pack.")] = Path("service/models/edge"),
    fp32: Annotated[list[str] | None, typer.Option("--fp32", help="Keep this network in float. Repeatable.")] = None,
) -> None:
    """Export, check against torch, quantize, score, and write the manifest."""
    recipe = EdgeRecipe()
    recipe = replace(recipe, int8=tuple(name for name in recipe.int8 if name not in (fp32 or ())))
    try:
        manifest = export(runs, data, out, recipe, console)
    except QuadliftError as error:
        console.print(f"[red]{error}[/red]")
        raise typer.Exit(1) from None
    size = sum((out / entry.file).stat().st_size for entry in manifest.networks.values())
    console.print(f"pack '{manifest.name}' in {out}: {size / 1e6:.1f} MB")


@export_app.command("guided")
def export_guided_command(
    data: DataOption,
    pack: Annotated[str, typer.Option(help="Pack to add the detector to: a shipped one's name, or a folder.")] = "edge",
    runs: RunsOption = RUNS,
    out: Annotated[Path, typer.Option(help="Folder of the pack with the detector.")] = Path("runs/guided-pack"),
) -> None:
    """Export the depth-guided detector, check it against torch, score it, and write the pack with it."""
    try:
        export_guided(runs, data, pack, out, GuidedRecipe(), console)
    except QuadliftError as error:
        console.print(f"[red]{error}[/red]")
        raise typer.Exit(1) from None


@export_app.callback()
def _export() -> None:
    """Export trained networks to a pack."""


if __name__ == "__main__":
    train_app()
