"""Each network learns eight frames by heart, and a run that was cut goes on as if it had not been."""

from __future__ import annotations

import csv
import itertools
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from models_export.data.samples import Sample
from models_export.nets.depth import DepthConfig
from models_export.nets.detector import DetectorConfig
from models_export.nets.multibin import MultibinConfig
from models_export.train.batches import batches
from models_export.train.checkpoint import go_on_from, load_averaged, read_checkpoint
from models_export.train.config import Optimizer, TrainConfig
from models_export.train.depth import DepthTask
from models_export.train.detector import DetectorTask
from models_export.train.loop import fit
from models_export.train.multibin import MultibinTask
from models_export.train.task import decayed_groups
from models_export.train.validation import Validation
from service.errors import InputError

SHORT = TrainConfig(steps=60, batch_size=4, learning_rate=3e-3, warmup_steps=5, ema_decay=0.9, amp=False, checkpoint_every=20)
SMALL_DETECTOR = DetectorConfig(width=8, blocks=(1, 1, 1, 1), neck=16)
SMALL_DEPTH = DepthConfig(stem=(8, 16, 16), width=32, blocks=1, heads=2, decoder=8)
SMALL_HEAD = MultibinConfig(crop_px=32, channels=(8, 16, 16), residuals=(1, 1), squeezed=16, dropout=0.1)


@pytest.fixture(scope="session")
def toy_samples(toy_samples: list[Sample]) -> list[Sample]:
    """The toys with a truth of the edge depth net's cells: every 16 px instead of every 8."""
    return [replace(sample, inverse_depth=sample.inverse_depth[::2, ::2]) for sample in toy_samples]


def task_of(name: str, samples: list[Sample]) -> DetectorTask | MultibinTask | DepthTask:
    torch.manual_seed(0)
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

    def cut(indices: np.ndarray, rng: np.random.Generator) -> dict[str, torch.Tensor]:
        cut.calls += 1  # type: ignore[attr-defined]
        if cut.calls > 45:  # type: ignore[attr-defined]
            raise CutOff
        return batch(indices, rng)

    cut.calls = 0  # type: ignore[attr-defined]
    broken.batch = cut  # type: ignore[method-assign]
    with pytest.raises(CutOff):
        fit(broken, SHORT, tmp_path / "cut")
    resumed = fit(task_of("multibin", toy_samples), SHORT, tmp_path / "cut", resume=True)
    for ours, theirs in zip(resumed.state_dict().values(), whole.state_dict().values(), strict=True):
        assert torch.equal(ours, theirs)


def test_resuming_with_other_options_is_refused(toy_samples: list[Sample], tmp_path: Path) -> None:
    short = replace(SHORT, steps=2)
    fit(task_of("depth", toy_samples), short, tmp_path)
    with pytest.raises(InputError, match="config differs"):
        fit(task_of("depth", toy_samples), replace(short, batch_size=2), tmp_path, resume=True)


def test_a_checkpoint_holds_its_configuration(toy_samples: list[Sample], tmp_path: Path) -> None:
    task = task_of("detector", toy_samples)
    trained = fit(task, replace(SHORT, steps=2), tmp_path)
    loaded, state = load_averaged(tmp_path / "detector.pt", task_of("detector", toy_samples).net)
    assert state["task"]["net"]["width"] == SMALL_DETECTOR.width
    for ours, theirs in zip(loaded.state_dict().values(), trained.state_dict().values(), strict=True):
        assert torch.equal(ours, theirs)


def test_another_run_goes_on_with_the_priors_that_the_weights_are_bound_to(toy_samples: list[Sample], tmp_path: Path) -> None:
    earlier = task_of("multibin", toy_samples)
    trained = fit(earlier, replace(SHORT, steps=2), tmp_path)
    longer = [replace(sample, dims_lwh=1.1 * sample.dims_lwh) for sample in toy_samples]
    task = task_of("multibin", longer)
    assert task.config.mean_dims_lwh != earlier.config.mean_dims_lwh
    before = go_on_from(task, tmp_path / "multibin.pt")
    assert task.config.mean_dims_lwh == task.net.config.mean_dims_lwh == earlier.config.mean_dims_lwh
    assert (before["taken_from"], before["steps"]) == ("multibin.pt", 2)
    for ours, theirs in zip(task.net.parameters(), trained.parameters(), strict=True):
        assert torch.equal(ours, theirs)


def test_a_missing_checkpoint_says_so(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Train the network first"):
        load_averaged(tmp_path / "none.pt", torch.nn.Identity())


def with_weather(samples: list[Sample]) -> list[Sample]:
    return [replace(sample, weather=("day", "night")[k % 2]) for k, sample in enumerate(samples)]


@pytest.mark.parametrize("name", ["detector", "multibin", "depth"])
def test_validation_is_logged_by_camera_and_weather(name: str, toy_samples: list[Sample], tmp_path: Path) -> None:
    task = task_of(name, toy_samples)
    config = replace(SHORT, steps=4, validate_every=2)
    fit(task, config, tmp_path, task.held_out(with_weather(toy_samples[4:])))
    with (tmp_path / f"{name}.validation.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["step"], row["axis"], row["label"]) for row in rows] == [
        (step, axis, label)
        for step in ("2", "4")
        for axis, label in (("all", "all"), ("camera", "north"), ("weather", "day"), ("weather", "night"))
    ]
    losses = {(row["axis"], row["label"]): float(row["loss"]) for row in rows[-4:]}
    both = losses["weather", "day"] + losses["weather", "night"]
    assert losses["camera", "north"] == losses["all", "all"] == pytest.approx(both / 2)
    for axis in ("camera", "weather"):
        assert (tmp_path / f"{name}.{axis}.png").stat().st_size > 1000


def test_validation_is_the_same_whenever_it_is_asked(toy_samples: list[Sample]) -> None:
    task = task_of("multibin", toy_samples)
    validation, again = (Validation.of(task.held_out(with_weather(toy_samples)), SHORT) for _ in range(2))
    task.net.train()
    assert validation.losses(task.net, SHORT, 0) == again.losses(task.net, SHORT, 0)
    assert task.net.training


def test_groups_are_bounded(toy_samples: list[Sample]) -> None:
    held_out = task_of("depth", toy_samples).held_out(with_weather(toy_samples))
    groups = Validation.of(held_out, replace(SHORT, validation_items=3)).groups
    assert {group: len(members) for group, members in groups.items()} == {
        ("camera", "north"): 3,
        ("weather", "day"): 3,
        ("weather", "night"): 3,
    }


def test_held_out_items_share_the_net_and_are_not_augmented(toy_samples: list[Sample]) -> None:
    task = task_of("depth", toy_samples)
    held_out = task.held_out(toy_samples[:1])
    assert held_out.net is task.net
    assert (len(held_out), len(task)) == (1, 8)
    for seed in range(3):
        images = held_out.batch(np.array([0]), np.random.default_rng(seed))["images"].numpy()
        np.testing.assert_array_equal(images[0], toy_samples[0].canvas)


def test_a_time_limit_stops_and_resuming_goes_on(
    toy_samples: list[Sample], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A clock that goes on by a second whenever it is read: at the start, and before each step.
    monkeypatch.setattr("models_export.train.loop.monotonic", itertools.count().__next__)
    pieces = replace(SHORT, steps=20, max_minutes=7.5 / 60, anneal_in_time=False)
    whole = fit(task_of("multibin", toy_samples), replace(pieces, max_minutes=None), tmp_path / "whole")
    fit(task_of("multibin", toy_samples), pieces, tmp_path / "cut")
    assert read_checkpoint(tmp_path / "cut" / "multibin.pt")["step"] == 7
    assert len((tmp_path / "cut" / "multibin.csv").read_text().splitlines()) == 8
    resumed = fit(task_of("multibin", toy_samples), replace(pieces, max_minutes=None), tmp_path / "cut", resume=True)
    assert read_checkpoint(tmp_path / "cut" / "multibin.pt")["step"] == 20
    for ours, theirs in zip(resumed.state_dict().values(), whole.state_dict().values(), strict=True):
        assert torch.equal(ours, theirs)


@pytest.mark.parametrize("optimizer", ["adam", "sgd"])
def test_other_optimisers_learn(optimizer: Optimizer, toy_samples: list[Sample], tmp_path: Path) -> None:
    rate = 3e-2 if optimizer == "sgd" else 3e-3
    fit(task_of("depth", toy_samples), replace(SHORT, steps=40, optimizer=optimizer, learning_rate=rate, workers=3), tmp_path)
    history = read_checkpoint(tmp_path / "depth.pt")["history"]
    assert np.mean([h["total"] for h in history[-8:]]) < 0.85 * np.mean([h["total"] for h in history[:8]])


def test_autocast_changes_the_arithmetic_only_where_asked(toy_samples: list[Sample]) -> None:
    task = task_of("depth", toy_samples)
    validation = Validation.of(task.held_out(toy_samples), SHORT)
    whole, half = (validation.losses(task.net, replace(SHORT, amp=amp), 0)[0].loss for amp in (False, True))
    assert half != whole
    assert half == pytest.approx(whole, rel=0.05)


def test_weights_learn_at_the_pace_of_their_group(toy_samples: list[Sample], tmp_path: Path) -> None:
    task = task_of("depth", toy_samples)
    before = deepcopy(task.net.state_dict())
    task.parameter_groups = lambda net: decayed_groups(net.stem8, rate=0.0) + decayed_groups(net.head)  # type: ignore[method-assign]
    fit(task, replace(SHORT, steps=2), tmp_path)
    after = task.net.state_dict()
    moved = {
        key
        for key, value in after.items()
        if value.is_floating_point() and "running" not in key and not torch.equal(value, before[key])
    }
    assert moved == {"head.weight", "head.bias"}


def test_a_device_that_is_not_there_is_refused(toy_samples: list[Sample], tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        fit(task_of("depth", toy_samples), replace(SHORT, device="nonsense"), tmp_path)
    assert caught.value.field == "device"


def test_a_loss_that_is_not_finite_is_refused(toy_samples: list[Sample], tmp_path: Path) -> None:
    task = task_of("depth", toy_samples)
    task.loss = lambda net, batch: {"total": net(batch["images"]).sum() * float("nan")}  # type: ignore[method-assign]
    with pytest.raises(InputError, match="not finite") as caught:
        fit(task, SHORT, tmp_path)
    assert caught.value.field == "learning_rate"


def test_processes_prepare_the_batches_that_threads_do(toy_samples: list[Sample]) -> None:
    task = task_of("multibin", toy_samples)
    config = replace(SHORT, steps=4, workers=2)
    beside_a_gpu = list(batches(task, replace(config, device="cuda"), 1))
    expected = list(batches(task, config, 1))
    assert len(beside_a_gpu) == len(expected) == 3
    for ours, theirs in zip(beside_a_gpu, expected, strict=True):
        assert all(torch.equal(ours[key], theirs[key]) for key in theirs)
