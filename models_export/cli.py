"""Command lines ``quadlift train``, ``quadlift average`` and ``quadlift export``."""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from models_export.data.real import RealData
from models_export.edge import edge_recipe
from models_export.guided import export_guided, train_guided
from models_export.packing import ExportOptions, export
from models_export.paper import paper_recipe
from models_export.recipe import PackRecipe, train
from models_export.train.averaging import average_runs
from models_export.train.config import TrainConfig
from models_export.train.guided import GuidedTask
from service.errors import InputError, QuadliftError

ALL = "all"
GUIDED = GuidedTask.name
train_app = typer.Typer(add_completion=False)
export_app = typer.Typer(add_completion=False)
average_app = typer.Typer(add_completion=False)
console = Console()


class PackName(StrEnum):
    """Packs that can be trained."""

    EDGE = "edge"
    PAPER = "paper"


class PrecisionName(StrEnum):
    """Arithmetic of an exported network."""

    FP32 = "fp32"
    FP16 = "fp16"
    INT8 = "int8"


NetworkArgument = Annotated[str, typer.Argument(help="detector, multibin or depth; 'all' of these; or guided.")]
PackOption = Annotated[PackName, typer.Option("--pack", help="Whose networks.")]
DataOption = Annotated[list[Path], typer.Option("--data", help="Data set: a folder of scenes. Repeatable.")]
RunsOption = Annotated[Path | None, typer.Option(help="Folder of checkpoints, logs and curves; runs/<pack> if left out.")]


@train_app.command()
def train_command(
    network: NetworkArgument,
    data: DataOption,
    pack: PackOption = PackName.EDGE,
    runs: RunsOption = None,
    real: Annotated[Path | None, typer.Option(help="Folder of real recordings that train too.")] = None,
    taught: Annotated[Path | None, typer.Option(help="What `quadlift teach` wrote of them.")] = None,
    steps: Annotated[int | None, typer.Option(help="Optimiser steps; the recipe's if left out.")] = None,
    epochs: Annotated[float | None, typer.Option(help="Passes over the data, instead of steps.")] = None,
    batch_size: Annotated[int | None, typer.Option(help="Items a step; the recipe's if left out.")] = None,
    learning_rate: Annotated[float | None, typer.Option(help="Peak rate; the recipe's if left out.")] = None,
    max_minutes: Annotated[
        float | None, typer.Option(help="Stop by then, with a checkpoint, the schedule run to its end.")
    ] = None,
    device: Annotated[str, typer.Option(help="torch device: cpu, cuda, ...")] = "cpu",
    threads: Annotated[int, typer.Option(help="CPU threads of the arithmetic.")] = 1,
    workers: Annotated[int | None, typer.Option(help="Batches prepared at the same time; the recipe's if left out.")] = None,
    amp: Annotated[
        bool | None, typer.Option("--amp/--no-amp", help="Mixed precision (bfloat16); the recipe's if left out.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of weights, data order and augmentation.")] = 1,
    init: Annotated[Path | None, typer.Option(help="File or folder of weights to start from.")] = None,
    guide: Annotated[str, typer.Option(help="Pack whose depth net guides the network 'guided': a name, or a folder.")] = "edge",
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint.")] = False,
) -> None:
    """Train networks of a pack on scenes: checkpoint, log and loss curves go to --runs."""
    changes: dict[str, Any] = {
        "batch_size": batch_size, "learning_rate": learning_rate, "max_minutes": max_minutes,
        "device": device, "threads": threads, "workers": workers, "amp": amp, "seed": seed,
    }  # fmt: skip
    if steps is not None or epochs is not None:
        changes |= {"steps": steps, "epochs": epochs}
    recipe = _recipe(pack)
    try:
        if network == GUIDED:
            guided = replace(recipe.guided, training=_changed(recipe.guided.training, changes))
            train_guided(data, guide, runs or _runs(pack), guided, init=init, resume=resume)
            return
        names = recipe.names if network == ALL else (recipe.network(network).name,)
        if init is not None and network == ALL:
            raise InputError("is for one network.", field="init", remedy="Train the networks one by one.")
        recordings = _recordings(real, taught)
        for name in names:
            config = _changed(recipe.network(name).training, changes)
            changed = recipe.with_training(name, config)
            train(changed, name, data, runs or _runs(pack), real=recordings, init=init, resume=resume)
    except QuadliftError as error:
        raise _failed(error) from None


@export_app.command()
def export_command(
    data: DataOption,
    out: Annotated[Path, typer.Option(help="Folder of the pack.")],
    pack: PackOption = PackName.EDGE,
    runs: RunsOption = None,
    precision: Annotated[PrecisionName | None, typer.Option(help="Of all networks; the recipe's if left out.")] = None,
    fp32: Annotated[list[str] | None, typer.Option("--fp32", help="Keep this network in float. Repeatable.")] = None,
    batch: Annotated[str, typer.Option(help="Images a run: 'dynamic', or a number that every run has.")] = "dynamic",
    stand_ins: Annotated[
        bool, typer.Option("--stand-ins", help="Export a detector that finds too little to measure errors on.")
    ] = False,
    base: Annotated[str | None, typer.Option(help="Pack that gives the networks of which --runs has no checkpoint.")] = None,
    validation: Annotated[
        list[Path] | None, typer.Option(help="Data set that did not train, to measure on; the held-out scenes if left out.")
    ] = None,
    beside: Annotated[str | None, typer.Option(help="Export 'guided' alone, into a copy of this pack.")] = None,
) -> None:
    """Export trained networks to a pack: checked against torch, measured on validation scenes, with a manifest.

    The depth-guided detector too, when --runs has it.
    """
    runs = runs or _runs(pack)
    try:
        recipe = _recipe(pack)
        keep = tuple(recipe.network(name).name for name in fp32 or ())
        options = ExportOptions(precision.value if precision else None, keep, _batch(batch), stand_ins, base)
        if beside is None:
            manifest = export(recipe, runs, data, out, options, console, validation or ())
        if beside is not None or (runs / f"{GUIDED}.pt").is_file():
            manifest = export_guided(runs, data, beside or str(out), out, recipe.guided, console)
    except QuadliftError as error:
        raise _failed(error) from None
    files = [file for entry in manifest.networks.values() for file in (entry, entry.openvino) if file is not None]
    size = sum((out / file.file).stat().st_size for file in files)
    console.print(f"pack '{manifest.name}' in {out}: {size / 1e6:.1f} MB")


@average_app.command()
def average_command(
    checkpoints: Annotated[list[Path], typer.Argument(help="Checkpoints of one network, each begun where another ended.")],
    out: Annotated[Path, typer.Option(help="Checkpoint to write: NETWORK.pt in the folder that is exported.")],
) -> None:
    """Make several runs of a network one: the mean of their weights, to be exported or begun from."""
    try:
        average_runs(checkpoints, out)
    except QuadliftError as error:
        raise _failed(error) from None
    console.print(f"mean of {len(checkpoints)} runs in {out}")


def _recipe(pack: PackName) -> PackRecipe:
    return {PackName.EDGE: edge_recipe, PackName.PAPER: paper_recipe}[pack]()


def _recordings(folder: Path | None, taught: Path | None) -> RealData | None:
    if folder is None and taught is not None:
        raise InputError("says nothing without recordings.", field="taught", remedy="Give their folder with --real.")
    return None if folder is None else RealData(folder, taught)


def _runs(pack: PackName) -> Path:
    return Path("runs") / pack.value


def _changed(training: TrainConfig, changes: dict[str, Any]) -> TrainConfig:
    """The recipe's training with what the user gave; steps and epochs replace each other."""
    kept = {key: value for key, value in changes.items() if value is not None or key in ("steps", "epochs")}
    return replace(training, **kept)


def _batch(text: str) -> int | None:
    if text == "dynamic":
        return None
    if not text.isdecimal() or int(text) == 0:
        raise InputError(f"is {text!r}.", field="batch", remedy="It must be 'dynamic' or a number above 0.")
    return int(text)


def _failed(error: QuadliftError) -> typer.Exit:
    console.print(f"[red]{escape(str(error))}[/red]")
    return typer.Exit(1)


if __name__ == "__main__":
    train_app()
