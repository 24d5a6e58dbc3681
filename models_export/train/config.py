"""The settings of one training run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, get_args

from models_export.train.task import Task
from service.errors import InputError

Optimizer = Literal["adamw", "adam", "sgd"]
Schedule = Literal["cosine", "multistep"]
AmpType = Literal["bfloat16", "float16"]

_PRIORS = ("anchors_px", "mean_dims_lwh")
_FREE_ON_RESUME = ("max_minutes", "anneal_in_time", "checkpoint_every", "device", "threads", "workers")


@dataclass(frozen=True)
class TrainConfig:
    """One run. Travels in the checkpoint and in the manifest. Raises InputError for a value that makes no sense."""

    steps: int | None = None
    """Optimiser steps. Give these or ``epochs``."""
    batch_size: int = 16
    """Items (images or crops) a step."""
    epochs: float | None = None
    """Length of the run in draws of as many items as the task has; :meth:`resolved` makes steps of it."""
    optimizer: Optimizer = "adamw"
    """``adam`` couples its decay with the gradient, ``adamw`` does not; ``sgd`` takes ``momentum``."""
    momentum: float = 0.9
    """Of ``sgd``."""
    learning_rate: float = 2e-3
    """Peak, after the warm-up."""
    weight_decay: float = 0.02
    """Of the parameter groups that decay."""
    warmup_steps: int = 100
    """Steps over which the rate rises linearly."""
    schedule: Schedule = "cosine"
    """After the warm-up: a cosine down to ``final_rate``, or a cut to a tenth at each of ``milestones``."""
    final_rate: float = 0.02
    """Where the cosine ends, over the peak."""
    milestones: tuple[float, ...] = (0.8, 0.9)
    """Of ``multistep``: parts of the run."""
    ema_decay: float = 0.998
    """Decay of the averaged weights, which are what is validated and exported; after n steps at most (1 + n) / (10 + n)."""
    clip_norm: float = 5.0
    """Largest norm of the gradient."""
    seed: int = 1
    """Of weights, data order, augmentation and dropout."""
    device: str = "cpu"
    """torch device: ``cpu``, ``cuda``, ``cuda:1``, ..."""
    threads: int = 1
    """CPU threads of the arithmetic. One loses little against two at these sizes, and two trainings run side by side."""
    workers: int = 1
    """Batches that are prepared at the same time: on threads of a CPU run, in processes beside a GPU, which wants many. Batches
    are the same for any number."""
    amp: bool = True
    """Autocast: bfloat16 is three times as fast on CPUs with AMX, harmless elsewhere."""
    amp_dtype: AmpType = "bfloat16"
    """``float16`` is for CUDA devices without bfloat16; its gradients are scaled (GradScaler)."""
    max_minutes: float | None = None
    """Wall-clock limit of one call: then a checkpoint is written and training stops. Resuming gives as much again."""
    anneal_in_time: bool = True
    """With ``max_minutes``, the schedule follows steps or minutes, whichever are further along.

    The run ends with the low rate then, and its weights are worth exporting; but it repeats only as exactly as the clock,
    and resuming raises the rate again (a warm restart). False: steps alone, for a run cut into pieces that equal the whole.
    """
    checkpoint_every: int = 500
    """Steps."""
    validate_every: int = 250
    """Steps between validations; the last step always validates."""
    validation_items: int = 32
    """Items of each camera and of each weather that validate, at most."""
    init: str | None = None
    """Name of the file or folder whose weights training starts from, for the record."""
    before: Mapping[str, Any] | None = None
    """How those weights came about, when they are a pack's and its manifest says so, for the record."""
    recordings: tuple[str, ...] = ()
    """Real recordings that train too, with their authors and licences, for the record."""

    def __post_init__(self) -> None:
        if (self.steps is None) == (self.epochs is None):
            raise InputError("give either steps or epochs.", field="steps", remedy="One of the two says how long to train.")
        for name in ("batch_size", "threads", "workers", "checkpoint_every", "validate_every", "validation_items"):
            _require(getattr(self, name) >= 1, name, getattr(self, name), "at least 1")
        for name in ("steps", "epochs", "max_minutes", "learning_rate", "clip_norm"):
            value = getattr(self, name)
            _require(value is None or (value > 0 and math.isfinite(value)), name, value, "above 0")
        for name in ("weight_decay", "warmup_steps", "seed"):
            _require(getattr(self, name) >= 0, name, getattr(self, name), "at least 0")
        for name in ("momentum", "ema_decay", "final_rate"):
            _require(0 <= getattr(self, name) < 1, name, getattr(self, name), "at least 0 and below 1")
        for name, choices in (("optimizer", Optimizer), ("schedule", Schedule), ("amp_dtype", AmpType)):
            _require(getattr(self, name) in get_args(choices), name, getattr(self, name), f"one of {get_args(choices)}")
        rising = all(0 < a < 1 for a in self.milestones) and tuple(sorted(set(self.milestones))) == self.milestones
        _require(rising, "milestones", self.milestones, "rising parts of the run between 0 and 1")
        on_cpu = self.amp and self.amp_dtype == "float16" and self.device == "cpu"
        _require(not on_cpu, "amp_dtype", self.amp_dtype, "bfloat16 on the CPU")

    def resolved(self, items: int) -> TrainConfig:
        """With ``steps`` in the place of ``epochs``, for a task of ``items`` items."""
        if self.epochs is None:
            return self
        return replace(self, steps=max(math.ceil(self.epochs * items / self.batch_size), 1), epochs=None)


def nested_tuples(rows: Any) -> Any:
    """Lists of lists, as JSON and checkpoints hold them, as the tuples of a frozen configuration."""
    return tuple(nested_tuples(row) for row in rows) if isinstance(rows, list | tuple) else rows


def take_priors(task: Task, values: Mapping[str, Any]) -> None:
    """Give a task and its network the priors among ``values``: what training data decide, and weights are bound to."""
    known = {field.name for field in fields(task.config)}
    priors = {name: nested_tuples(values[name]) for name in _PRIORS if name in known and name in values}
    task.config = task.net.config = replace(task.config, **priors)


def decisive(config: Mapping[str, Any]) -> dict[str, Any]:
    """Of a config's fields, those that a resumed run must share with the one it goes on from."""
    return {key: value for key, value in config.items() if key not in _FREE_ON_RESUME}


def _require(holds: bool, name: str, value: object, what: str) -> None:
    if not holds:
        raise InputError(f"is {value!r}.", field=name, remedy=f"It must be {what}.")
