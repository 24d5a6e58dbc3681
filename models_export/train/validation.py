"""Losses on held-out items, by camera and by weather."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass

import numpy as np
import torch
from torch import nn

from models_export.train.config import TrainConfig
from models_export.train.task import Batch, Task


@dataclass(frozen=True)
class ValidationLoss:
    """The mean loss of one group of held-out items after a number of steps."""

    step: int
    axis: str
    """``camera`` or ``weather``; ``all`` for every item."""
    label: str
    """Which camera, which weather."""
    loss: float
    items: int


@dataclass(frozen=True, eq=False)
class Validation:
    """A task over held-out items, and the items of it that are looked at, the same at every step."""

    task: Task
    groups: dict[tuple[str, str], list[int]]
    """Indices by axis and label."""

    @staticmethod
    def of(task: Task, config: TrainConfig) -> Validation:
        """At most ``config.validation_items`` items of each label, drawn once, with the run's seed."""
        groups: dict[tuple[str, str], list[int]] = {}
        for index in np.random.default_rng(config.seed).permutation(len(task)).tolist():
            for axis, label in task.labels(index).items():
                members = groups.setdefault((axis, label), [])
                if len(members) < config.validation_items:
                    members.append(index)
        return Validation(task, dict(sorted(groups.items())))

    def losses(self, net: nn.Module, config: TrainConfig, step: int) -> list[ValidationLoss]:
        """The mean total loss of every group, and of all items.

        Each item is a batch of its own with a generator of its own, so its loss depends on nothing but itself and the net.
        """
        chosen = sorted({index for members in self.groups.values() for index in members})
        with _evaluating(net):
            by_item = {index: self._loss(net, config, index) for index in chosen}
        groups = {("all", "all"): chosen, **self.groups}
        return [
            ValidationLoss(step, axis, label, float(np.mean([by_item[index] for index in members])), len(members))
            for (axis, label), members in groups.items()
        ]

    def _loss(self, net: nn.Module, config: TrainConfig, index: int) -> float:
        batch = self.task.batch(np.array([index]), np.random.default_rng((config.seed, index)))
        with autocast(config):
            return float(self.task.loss(net, on_device(batch, config.device))["total"])


def describe(losses: list[ValidationLoss]) -> list[dict[str, float | str]]:
    """Rows for checkpoint and CSV."""
    return [asdict(loss) for loss in losses]


def on_device(batch: Batch, device: str) -> Batch:
    """The batch with its tensors on a device."""
    return {k: v.to(device, non_blocking=True) if isinstance(v, torch.Tensor) else v for k, v in batch.items()}


def autocast(config: TrainConfig) -> torch.autocast:
    """The run's mixed precision."""
    return torch.autocast(torch.device(config.device).type, getattr(torch, config.amp_dtype), enabled=config.amp)


@contextmanager
def _evaluating(net: nn.Module) -> Iterator[None]:
    was = net.training
    net.eval()
    try:
        with torch.no_grad():
            yield
    finally:
        net.train(was)
