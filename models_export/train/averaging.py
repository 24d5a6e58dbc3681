"""Several runs made one: the mean of their weights.

Runs that begin where another one ended lie in one valley of the loss, and the mean of their weights lies nearer to its bottom
than each of them (model soups, Wortsman et al., ICML 2022). It costs nothing when it serves.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from models_export.train.checkpoint import read_checkpoint, write_checkpoint
from service.errors import InputError

_LEARNING_ONLY = frozenset({"dropout"})
"""Settings of a network that its weights do not depend on."""


def average_runs(checkpoints: Sequence[Path], out: Path) -> None:
    """Write a checkpoint whose averaged weights are the mean of those of several runs of one network, for export or as a start.

    Everything else is the last run's; its configuration says under ``mean_of_runs`` which runs went in. It cannot be resumed.
    Raises InputError when there are fewer than two, when one is missing, or when their networks differ.
    """
    if len(checkpoints) < 2:
        raise InputError("a mean takes two runs or more.", field="checkpoints", remedy="Name their checkpoints.")
    states = [read_checkpoint(path) for path in checkpoints]
    last = states[-1]
    for path, state in zip(checkpoints, states, strict=True):
        if _decisive(state) != _decisive(last):
            raise InputError(
                f"its network is not that of {checkpoints[-1]}.", field=str(path), remedy="Average runs of one network."
            )
    means = {key: _mean([state["averaged"][key] for state in states]) for key in last["averaged"]}
    runs = [f"seed {state['config']['seed']}, {state['step']} steps" for state in states]
    out.parent.mkdir(parents=True, exist_ok=True)
    kept = {key: last[key] for key in ("step", "config", "task")}
    write_checkpoint(out, {**kept, "averaged": means, "config": {**last["config"], "mean_of_runs": runs}})


def _decisive(state: dict[str, Any]) -> dict[str, Any]:
    """A run's settings and priors of its network that the weights depend on."""
    return {key: value for key, value in state["task"]["net"].items() if key not in _LEARNING_ONLY}


def _mean(values: list[Tensor]) -> Tensor:
    """Of counters, which are no weights, the last."""
    if not values[-1].is_floating_point():
        return values[-1]
    return torch.stack([value.double() for value in values]).mean(0).to(values[-1].dtype)
