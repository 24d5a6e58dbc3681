"""Each network learns eight frames by heart, and a run that was cut goes on as if it had not been."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from models_export.data.samples import Sample
from models_export.nets.depth import DepthConfig
from models_export.nets.detector import DetectorConfig
from models_export.nets.multibin import MultibinConfig
from models_export.train.depth import DepthTask
from models_export.train.detector import DetectorTask, anchors_of
from models_export.train.loop import TrainConfig, fit, learning_rate, load_averaged
from models_export.train.multibin import MultibinTask
from service.errors import InputError

SHORT = TrainConfig(steps=60, batch_size=4, learning_rate=3e-3, warmup_steps=5, ema_decay=0.9, amp=False, checkpoint_every=20)
SMALL_DETECTOR = DetectorConfig(channels=(8, 8, 16, 24, 32), residuals=(0, 1, 1, 0))
SMALL_DEPTH = DepthConfig(stem=(8, 8, 16, 16), width=32, blocks=1, heads=2, decoder=8)
SMALL_HEAD = MultibinConfig(crop_px=32, channels=(8, 8, 16, 16), dropout=0.0)


def task_of(name: str, samples: list[Sample]) -> DetectorTask | MultibinTask | DepthTask:
    if name == "detector":
        return DetectorTask(samples, SMALL_DETECTOR)
    if name == "multibin":
        return MultibinTask(samples, SMALL_HEAD)
    return DepthTask(samples, SMALL_DEPTH)


@pytest.mark.parametrize("name", ["detector", "multibin", "depth"])
def test_the_loss_falls_and_the_files_are_written(name: str, toy_samples: list[Sample], tmp_path: Path) -> None:
    task = task_of(name, toy_samples)
    fit(task, SHORT, tmp_path)
    history = torch.load(tmp_path / f"{name}.pt", weights_only=True)["history"]
    first, last = (np.mean([h["total"] for h in part]) for part in (history[:8], history[-8:]))
    assert last < 0.75 * first
    assert (tmp_path / f"{name}.png").stat().st_size > 1000
    assert len((tmp_path / f"{name}.csv").read_text().splitlines()) == SHORT.steps + 1


def test_a_resumed_run_equals_an_unbroken_one(toy_samples: list[Sample], tmp_path: Path) -> None:
    whole = fit(task_of("multibin", toy_samples), SHORT, tmp_path / "whole")

    class CutOff(Exception):
        pass

    broken = task_of("multibin", toy_samples)
    batch = broken.batch

    def cut(rng: np.random.Generator, size: int) -> dict[str, torch.Tensor]:
        cut.calls += 1  # type: ignore[attr-defined]
        if cut.calls > 45:  # type: ignore[attr-defined]
            raise CutOff
        return batch(rng, size)

    cut.calls = 0  # type: ignore[attr-defined]
    broken.batch = cut  # type: ignore[method-assign]
    with pytest.raises(CutOff):
        fit(broken, SHORT, tmp_path / "cut")
    resumed = fit(task_of("multibin", toy_samples), SHORT, tmp_path / "cut", resume=True)
    for ours, theirs in zip(resumed.state_dict().values(), whole.state_dict().values(), strict=True):
        assert torch.allclose(ours.float(), theirs.float(), atol=1e-5)


def test_resuming_with_other_options_is_refused(toy_samples: list[Sample], tmp_path: Path) -> None:
    short = replace(SHORT, steps=2)
    fit(task_of("depth", toy_samples), short, tmp_path)
    with pytest.raises(InputError, match="config differs"):
        fit(task_of("depth", toy_samples), replace(short, batch_size=2), tmp_path, resume=True)


def test_a_checkpoint_holds_its_configuration(toy_samples: list[Sample], tmp_path: Path) -> None:
    task = task_of("detector", toy_samples)
    trained = fit(task, replace(SHORT, steps=2), tmp_path)
    loaded, state = load_averaged(tmp_path / "detector.pt", task_of("detector", toy_samples).net)
    assert state["task"]["net"]["channels"] == SMALL_DETECTOR.channels
    for ours, theirs in zip(loaded.state_dict().values(), trained.state_dict().values(), strict=True):
        assert torch.equal(ours, theirs)


def test_a_missing_checkpoint_says_so(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Train the network first"):
        load_averaged(tmp_path / "none.pt", torch.nn.Identity())


def test_anchors_span_the_boxes(toy_samples: list[Sample]) -> None:
    anchors = np.array(anchors_of(toy_samples, (8, 16, 32)))
    sides = np.concatenate([s.xyxy_px[:, 2:] - s.xyxy_px[:, :2] for s in toy_samples])
    assert anchors.shape == (3, 3, 2)
    assert np.all(anchors.reshape(-1, 2).min(0) >= sides.min(0) - 0.1)
    assert np.all(anchors.reshape(-1, 2).max(0) <= sides.max(0) + 0.1)


def test_the_learning_rate_warms_up_and_decays() -> None:
    config = TrainConfig(steps=1000, batch_size=1, warmup_steps=100)
    rates = [learning_rate(config, step) for step in range(1000)]
    assert rates[0] < rates[99] <= config.learning_rate
    assert rates[-1] == pytest.approx(0.02 * config.learning_rate, rel=0.05)
    assert all(a >= b for a, b in itertools.pairwise(rates[100:]))
