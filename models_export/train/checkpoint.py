"""Checkpoints: one file that training goes on from, and that export reads."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from models_export.train.config import take_priors
from models_export.train.task import Task
from service.errors import InputError

SUFFIX = ".pt"


def write_checkpoint(path: Path, contents: Mapping[str, Any]) -> None:
    """Write a checkpoint in one move: a process that dies leaves the old one or the new one."""
    temporary = path.with_suffix(".tmp")
    torch.save({**contents, "saved_at": time.time()}, temporary)
    temporary.replace(path)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """A checkpoint's contents, on the CPU. Raises InputError when there is none."""
    if not path.is_file():
        raise InputError("no such checkpoint.", field=str(path), remedy="Train the network first.")
    state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    return state


def require_same(path: Path, saved: Mapping[str, Any], ours: Mapping[str, Any], what: str) -> None:
    """Raise InputError, naming the first setting that differs, unless a saved description equals ours."""
    for key in sorted({*saved, *ours}):
        if saved.get(key) != ours.get(key):
            raise InputError(
                f"the checkpoint's {what} differs from this run's: {key} was {saved.get(key)!r}, now {ours.get(key)!r}.",
                field=str(path),
                remedy="Resume with the same options, or start anew without --resume.",
            )


def load_averaged(checkpoint: Path, net: nn.Module) -> tuple[nn.Module, dict[str, Any]]:
    """The averaged weights of a checkpoint in ``net``, in eval mode, and the checkpoint's description."""
    state = read_checkpoint(checkpoint)
    weights = {key.removeprefix("module."): value for key, value in state["averaged"].items() if key != "n_averaged"}
    net.load_state_dict(weights)
    return net.eval(), state


def load_checkpoint(net: nn.Module, path: Path) -> dict[str, Any]:
    """Start from the averaged weights of an earlier run's checkpoint; gives its description.

    Raises InputError when they do not fit.
    """
    try:
        _, state = load_averaged(path, net)
    except (RuntimeError, KeyError) as error:
        raise InputError(
            f"holds no weights of this network: {error}", field=str(path), remedy="Give its checkpoint."
        ) from error
    net.train()
    return state


def go_on_from(task: Task, path: Path) -> dict[str, Any]:
    """Start a task from an earlier run's averaged weights, with the priors (anchors, mean sizes) that they are bound to.

    Returns how they came about, for the record. Raises InputError when they do not fit.
    """
    state = load_checkpoint(task.net, path)
    take_priors(task, state["task"]["net"])
    return {"taken_from": path.name, "training": state["config"], "task": state["task"], "steps": state["step"]}


def begun_with(task: Task, path: Path) -> Any:
    """For a run that goes on from its own checkpoint: what ``go_on_from`` or an exported file gave it at the start.

    The priors become the task's; returned is how the first weights came about. Raises InputError when there is no checkpoint.
    """
    state = read_checkpoint(path)
    take_priors(task, state["task"]["net"])
    return state["config"]["before"]


def checkpoint_or(read: Callable[[Any, Path], object]) -> Callable[[Any, Path], None]:
    """What starts a network from an earlier run's checkpoint (``.pt``), or from any other file or folder through ``read``."""

    def load(net: nn.Module, path: Path) -> None:
        if path.suffix == SUFFIX:
            load_checkpoint(net, path)
        else:
            read(net, path)

    return load
