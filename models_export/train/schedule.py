"""The learning rate over a run."""

from __future__ import annotations

import math

from models_export.train.config import TrainConfig

_CUT = 0.1


def learning_rate(config: TrainConfig, step: int, minutes: float = 0.0) -> float:
    """The rate of a step: linear warm-up, then the configured schedule. ``config.steps`` is set.

    minutes: wall-clock time since this call of training began; counts with ``max_minutes`` and ``anneal_in_time`` only.
    """
    assert config.steps is not None, "epochs are resolved before training"
    if step < config.warmup_steps:
        return config.learning_rate * (step + 1) / config.warmup_steps
    done = (step - config.warmup_steps) / max(config.steps - config.warmup_steps, 1)
    if config.max_minutes is not None and config.anneal_in_time:
        done = min(max(done, minutes / config.max_minutes), 1.0)
    if config.schedule == "multistep":
        return config.learning_rate * _CUT ** sum(done >= milestone for milestone in config.milestones)
    cosine = 0.5 * (1 + math.cos(math.pi * done))
    return config.learning_rate * (config.final_rate + (1 - config.final_rate) * cosine)
