"""From scenes to a pack that the service runs, through the command line, with small networks."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from models_export.cli import export_app, train_app
from models_export.data.dataset import Scene, open_scene
from models_export.edge import edge_recipe
from models_export.nets.depth import DepthConfig
from models_export.nets.detector import DetectorConfig
from models_export.nets.multibin import MultibinConfig
from models_export.recipe import PackRecipe
from models_export.train.checkpoint import read_checkpoint
from service.frames import EncodedFrame, FrameSet
from service.nets.pack import load_pack
from service.pipeline import Pipeline


def small_recipe() -> PackRecipe:
    recipe = edge_recipe(
        DetectorConfig(width=8, blocks=(1, 1, 1, 1), neck=16),
        MultibinConfig(crop_px=32, channels=(8, 16, 16), residuals=(1, 1)),
        DepthConfig(stem=(8, 16, 16), width=32, blocks=1, heads=2, decoder=8),
    )
    for network in recipe.networks:
        quick = replace(network.training, learning_rate=4e-3, warmup_steps=5, ema_decay=0.9, amp=False, validation_items=3)
        recipe = recipe.with_training(network.name, quick)
    return recipe


@pytest.fixture(scope="module")
def runs(toy_scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Checkpoints of the small networks."""
    out = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("models_export.cli.edge_recipe", small_recipe)
        run_train("all", toy_scenes, out, "--steps", "6", "--batch-size", "4")
        run_train("detector", toy_scenes, out, "--steps", "80", "--batch-size", "6")
    return out


def run_train(network: str, data: Path, runs: Path, *options: str) -> str:
    result = CliRunner().invoke(train_app, [network, "--data", str(data), "--runs", str(runs), *options])
    assert result.exit_code == 0, result.output
    return result.output


def run_export(data: Path, runs: Path, out: Path, *options: str) -> str:
    result = CliRunner().invoke(export_app, ["--data", str(data), "--runs", str(runs), "--out", str(out), *options])
    assert result.exit_code == 0, result.output
    return result.output


def frame_set(scene: Scene, step: int) -> FrameSet:
    moment = scene.truth(step).captured_at_ns
    frames = tuple(EncodedFrame(camera, scene.frame_bytes(camera, step), moment) for camera in scene.camera_ids)
    return FrameSet(scene.site, frames, moment, 1)


def test_training_writes_checkpoints_logs_and_curves(runs: Path) -> None:
    for name in ("detector", "multibin", "depth"):
        for suffix in ("pt", "csv", "png", "validation.csv", "camera.png", "weather.png"):
            assert (runs / f"{name}.{suffix}").stat().st_size > 100, f"{name}.{suffix}"
    assert read_checkpoint(runs / "multibin.pt")["step"] == 6


def test_options_reach_the_run(toy_scenes: Path, tmp_path: Path, runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("models_export.cli.edge_recipe", small_recipe)
    epoch = ("--epochs", "0.1", "--batch-size", "4", "--amp", "--seed", "7", "--init", str(runs / "depth.pt"))
    run_train("depth", toy_scenes, tmp_path, *epoch)
    state = read_checkpoint(tmp_path / "depth.pt")
    given = {key: state["config"][key] for key in ("steps", "epochs", "batch_size", "amp", "seed", "init")}
    # Ten scenes of 8 frames train.
    assert given == {"steps": 2, "epochs": None, "batch_size": 4, "amp": True, "seed": 7, "init": "depth.pt"}
    run_train("depth", toy_scenes, tmp_path, *epoch, "--resume")


def test_a_run_that_overwrites_what_it_began_with_can_be_resumed(
    toy_scenes: Path, tmp_path: Path, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("models_export.cli.edge_recipe", small_recipe)
    own = tmp_path / "multibin.pt"
    own.write_bytes((runs / "multibin.pt").read_bytes())
    began = ("--steps", "2", "--batch-size", "4", "--init", str(own))
    run_train("multibin", toy_scenes, tmp_path, *began)
    first = read_checkpoint(own)
    assert first["config"]["before"]["steps"] == 6
    run_train("multibin", toy_scenes, tmp_path, *began, "--resume")
    again = read_checkpoint(own)
    assert again["config"] == first["config"]
    assert again["task"] == first["task"]


def test_a_pack_goes_from_checkpoints_to_the_service(
    toy_scenes: Path, runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The depth net of the pack takes canvases of one size, smaller than the frames.
    recipe = small_recipe()
    fixed = tuple(replace(n, canvas_hw=(128, 224)) if n.name == "depth" else n for n in recipe.networks)
    monkeypatch.setattr("models_export.cli.edge_recipe", lambda: replace(recipe, networks=fixed))
    run_export(toy_scenes, runs, tmp_path, "--precision", "fp16", "--fp32", "depth", "--batch", "2")
    pack = load_pack(str(tmp_path))
    assert {name: entry.precision for name, entry in pack.manifest.networks.items()} == {
        "detector": "fp16", "multibin": "fp16", "depth": "fp32",
    }  # fmt: skip
    assert pack.networks["detector"].session.get_inputs()[0].shape[0] == 2
    assert pack.networks["depth"].session.get_inputs()[0].shape == [2, 128, 224, 3]
    scores = json.loads((tmp_path / "manifest.json").read_text())["scores"]
    assert scores["depth"]["parity_with_torch"] < 1e-3
    assert scores["detector"]["parity_with_torch"] < 1e-2
    assert scores["detector"]["AP_2d_50"] > 50
    result = Pipeline(pack).run(frame_set(open_scene(toy_scenes / "toy-09"), 0))
    assert sum(result.detections.values()) > 0
    # One network trained anew, the others as they are.
    anew = tmp_path / "anew"
    anew.mkdir()
    shutil.copy(runs / "multibin.pt", anew)
    run_export(toy_scenes, anew, anew / "pack", "--base", str(tmp_path))
    second = load_pack(str(anew / "pack")).manifest
    for name in ("detector", "depth"):
        assert second.networks[name] == pack.manifest.networks[name]
        assert second.scores[name] == pack.manifest.scores[name]
        assert second.training["networks"][name]["taken_from"] == f"edge {load_pack('edge').manifest.version}"
    assert second.networks["multibin"] != pack.manifest.networks["multibin"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["lidar"], "has no network 'lidar'"),
        (["depth", "--steps", "5", "--epochs", "1"], "either steps or epochs"),
        (["depth", "--batch-size", "0"], "batch_size: is 0"),
        (["all", "--init", "x.pt"], "init: is for one network"),
        (["depth", "--init", "absent.pt"], "no such checkpoint"),
        (["depth", "--data", "nowhere"], "holds no scenes"),
    ],
)
def test_what_cannot_be_trained_is_named(
    arguments: list[str], message: str, toy_scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("models_export.cli.edge_recipe", small_recipe)
    common = [] if "--data" in arguments else ["--data", str(toy_scenes)]
    result = CliRunner().invoke(train_app, [*arguments, *common, "--runs", str(tmp_path)], env={"COLUMNS": "400"})
    assert result.exit_code == 1
    assert message in " ".join(result.output.split())


@pytest.mark.parametrize(
    ("options", "message"),
    [(["--batch", "0"], "batch: is '0'"), (["--fp32", "lidar"], "no network 'lidar'"), ([], "Train the network first")],
)
def test_what_cannot_be_exported_is_named(options: list[str], message: str, toy_scenes: Path, tmp_path: Path) -> None:
    arguments = ["--data", str(toy_scenes), "--runs", str(tmp_path), "--out", str(tmp_path / "pack"), *options]
    result = CliRunner().invoke(export_app, arguments, env={"COLUMNS": "400"})
    assert result.exit_code == 1
    assert message in " ".join(result.output.split())
