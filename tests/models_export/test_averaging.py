"""The mean of several runs' weights, from checkpoints of toy runs to what export and a new start read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from models_export.cli import average_app
from models_export.data.samples import Sample
from models_export.nets.multibin import MultibinConfig
from models_export.train.averaging import average_runs
from models_export.train.checkpoint import load_checkpoint, read_checkpoint
from models_export.train.config import TrainConfig
from models_export.train.loop import fit
from models_export.train.multibin import MultibinTask
from service.errors import InputError

SMALL = MultibinConfig(crop_px=32, channels=(8, 16, 16), residuals=(1, 1), squeezed=16)
SHORT = TrainConfig(steps=3, batch_size=4, learning_rate=3e-3, warmup_steps=1, ema_decay=0.9, amp=False, checkpoint_every=3)


def run(samples: list[Sample], config: MultibinConfig, out: Path, seed: int) -> Path:
    torch.manual_seed(seed)
    fit(MultibinTask(samples, config), replace(SHORT, seed=seed), out)
    return out / "multibin.pt"


@pytest.fixture(scope="module")
def runs(toy_samples: list[Sample], tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    out = tmp_path_factory.mktemp("averaging")
    return [run(toy_samples, SMALL, out / str(seed), seed) for seed in (1, 2, 3)]


def test_the_weights_are_means_and_the_record_names_the_runs(
    runs: list[Path], toy_samples: list[Sample], tmp_path: Path
) -> None:
    result = CliRunner().invoke(average_app, [*map(str, runs), "--out", str(tmp_path / "new" / "multibin.pt")])
    assert result.exit_code == 0, result.output
    mean, states = read_checkpoint(tmp_path / "new" / "multibin.pt"), [read_checkpoint(path) for path in runs]
    for key, value in mean["averaged"].items():
        parts = [state["averaged"][key] for state in states]
        expected = np.mean([part.numpy() for part in parts], 0) if value.is_floating_point() else parts[-1].numpy()
        np.testing.assert_allclose(value.numpy(), expected, rtol=1e-5, atol=1e-7)
    assert mean["config"]["mean_of_runs"] == [f"seed {seed}, 3 steps" for seed in (1, 2, 3)]
    # A new run may begin from it; the mean itself is no run to go on with.
    task = MultibinTask(toy_samples, SMALL)
    load_checkpoint(task.net, tmp_path / "new" / "multibin.pt")
    with pytest.raises(InputError, match="mean of runs"):
        fit(task, SHORT, tmp_path / "new", resume=True)


def test_runs_of_other_networks_are_refused(runs: list[Path], toy_samples: list[Sample], tmp_path: Path) -> None:
    wider = run(toy_samples, replace(SMALL, squeezed=24), tmp_path / "wider", 1)
    with pytest.raises(InputError, match="network"):
        average_runs([wider, runs[0]], tmp_path / "multibin.pt")
    with pytest.raises(InputError, match="two runs"):
        average_runs(runs[:1], tmp_path / "multibin.pt")
    assert not (tmp_path / "multibin.pt").exists()


def test_dropout_is_no_difference(runs: list[Path], toy_samples: list[Sample], tmp_path: Path) -> None:
    careful = run(toy_samples, replace(SMALL, dropout=0.1), tmp_path / "careful", 4)
    average_runs([runs[0], careful], tmp_path / "multibin.pt")
    assert read_checkpoint(tmp_path / "multibin.pt")["task"]["net"]["dropout"] == 0.1
