"""Batches prepared ahead of the arithmetic: on threads beside a CPU that trains, in processes beside a GPU."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from models_export.data.ahead import mapped_ahead
from models_export.train.config import TrainConfig
from models_export.train.task import Batch, Task

_AHEAD = 3
"""Batches that each process keeps ready."""


def batches(task: Task, config: TrainConfig, start: int) -> Iterator[Batch]:
    """The batches of the steps from ``start`` on, in order; the same for any number of workers and either kind of them.

    A GPU is faster than one interpreter can feed it, so its workers are processes; they share the samples' memory.
    """
    assert config.steps is not None, "epochs are resolved before training"
    if config.device == "cpu":
        yield from mapped_ahead(lambda step: _batch(task, config, step), range(start, config.steps), config.workers)
        return
    # Before the fork: a child cannot stop the threads of its parent's OpenCV, which it has not got, and would wait for them.
    cv2.setNumThreads(1)
    yield from DataLoader(
        _Steps(task, config),
        batch_size=None,
        sampler=range(start, config.steps),
        num_workers=config.workers,
        prefetch_factor=_AHEAD,
        multiprocessing_context="fork",
        pin_memory=torch.cuda.is_available(),
    )


@dataclass(frozen=True)
class _Steps(Dataset[Batch]):
    """A run's batches by step."""

    task: Task
    config: TrainConfig

    def __getitem__(self, step: int) -> Batch:
        return _batch(self.task, self.config, step)


def _batch(task: Task, config: TrainConfig, step: int) -> Batch:
    # One generator a step: a resumed run draws the batches that the whole run would have drawn.
    rng = np.random.default_rng((config.seed, step))
    return task.batch(task.draw(rng, config.batch_size), rng)
