"""A run's settings: refused when they make no sense, and what the learning rate makes of them."""

from __future__ import annotations

import itertools
from typing import Any

import pytest

from models_export.train.config import TrainConfig
from models_export.train.schedule import learning_rate
from service.errors import InputError


@pytest.mark.parametrize(
    ("field", "settings"),
    [
        ("steps", {}),
        ("steps", {"steps": 5, "epochs": 1.0}),
        ("steps", {"steps": 0}),
        ("epochs", {"epochs": -1.0}),
        ("batch_size", {"steps": 5, "batch_size": 0}),
        ("learning_rate", {"steps": 5, "learning_rate": float("inf")}),
        ("learning_rate", {"steps": 5, "learning_rate": 0.0}),
        ("momentum", {"steps": 5, "momentum": 1.0}),
        ("weight_decay", {"steps": 5, "weight_decay": -0.1}),
        ("max_minutes", {"steps": 5, "max_minutes": 0.0}),
        ("optimizer", {"steps": 5, "optimizer": "lion"}),
        ("schedule", {"steps": 5, "schedule": "linear"}),
        ("milestones", {"steps": 5, "milestones": (0.9, 0.8)}),
        ("milestones", {"steps": 5, "milestones": (0.5, 1.5)}),
        ("amp_dtype", {"steps": 5, "amp_dtype": "float16"}),
        ("validate_every", {"steps": 5, "validate_every": 0}),
    ],
)
def test_a_setting_that_makes_no_sense_is_named(field: str, settings: dict[str, Any]) -> None:
    with pytest.raises(InputError) as caught:
        TrainConfig(**settings)
    assert caught.value.field == field
    assert caught.value.remedy


def test_epochs_become_steps() -> None:
    config = TrainConfig(epochs=2.5, batch_size=16).resolved(100)
    assert (config.steps, config.epochs) == (16, None)
    assert config.resolved(7) is config


def test_the_learning_rate_warms_up_and_decays() -> None:
    config = TrainConfig(steps=1000, batch_size=1, warmup_steps=100)
    rates = [learning_rate(config, step) for step in range(1000)]
    assert rates[0] < rates[99] <= config.learning_rate
    assert rates[-1] == pytest.approx(0.02 * config.learning_rate, rel=0.05)
    assert all(a >= b for a, b in itertools.pairwise(rates[100:]))


def test_multistep_cuts_the_rate_at_its_milestones() -> None:
    config = TrainConfig(steps=1000, learning_rate=1.0, warmup_steps=0, schedule="multistep", milestones=(0.5, 0.75))
    rates = [learning_rate(config, step) for step in (0, 499, 500, 749, 750, 999)]
    assert rates == pytest.approx([1.0, 1.0, 0.1, 0.1, 0.01, 0.01])


def test_a_time_limit_ends_the_schedule_in_time() -> None:
    limited = TrainConfig(steps=1000, warmup_steps=0, max_minutes=10.0)
    assert learning_rate(limited, 10, minutes=10.0) == pytest.approx(limited.final_rate * limited.learning_rate)
    assert learning_rate(limited, 900, minutes=0.0) == learning_rate(TrainConfig(steps=1000, warmup_steps=0), 900)
    pieces = TrainConfig(steps=1000, warmup_steps=0, max_minutes=10.0, anneal_in_time=False)
    assert learning_rate(pieces, 10, minutes=10.0) == learning_rate(pieces, 10)
