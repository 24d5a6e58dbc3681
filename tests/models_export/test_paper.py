"""Pack ``paper`` at a reduced size, from scenes to boxes: trained, exported, served, with a depth-guided detector beside it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from models_export.cli import export_app, train_app
from models_export.data.dataset import open_scene
from models_export.guided import GuidedRecipe
from models_export.nets.dpt import DptConfig
from models_export.nets.guided import GuidedConfig
from models_export.nets.vgg_multibin import VggMultibinConfig
from models_export.nets.yolov3 import Yolov3Config
from models_export.paper import DEPTH_CANVAS_HW, paper_recipe
from models_export.recipe import PackRecipe
from models_export.train.checkpoint import read_checkpoint
from models_export.train.config import TrainConfig
from models_export.train.guided_targets import AssignConfig
from service.errors import InputError
from service.frames import EncodedFrame, FrameSet
from service.nets.canvas import canvas_size
from service.nets.pack import load_pack
from service.pipeline import Pipeline, PipelineSettings

QUICK = {"warmup_steps": 2, "ema_decay": 0.9, "amp": False, "validation_items": 2}


def small_recipe() -> PackRecipe:
    """The frames are 320x160; the depth net's canvas is smaller and of another shape."""
    recipe = paper_recipe(
        Yolov3Config(width=0.125, residuals=(1, 1, 1, 1, 1), max_width=320),
        VggMultibinConfig(crop_px=32, channels=(8, 8, 16, 16, 16), convolutions=(1, 1, 1, 1, 1), angle_width=16, size_width=16),
        DptConfig(
            image_px=64, stem=16, stages=(32, 64, 96), depths=(1, 1, 1), groups=8, width=32, blocks=2, heads=2, mlp=64,
            taps=(0, 1), fusion=32,
        ),
        GuidedRecipe(
            GuidedConfig(max_width=320, channels=(8, 8, 16, 16, 16), neck=16),
            assign=AssignConfig(best_iou=0.2, background_iou=0.4),
            training=TrainConfig(steps=6, **QUICK),
        ),
        depth_canvas_hw=(96, 256),
    )  # fmt: skip
    for network in recipe.networks:
        recipe = recipe.with_training(network.name, replace(network.training, **QUICK))
    return recipe


def run(app: object, *arguments: object) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])  # type: ignore[arg-type]
    assert result.exit_code == 0, result.output
    return result.output


def test_the_pack_is_trained_exported_and_served(toy_scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("models_export.cli.paper_recipe", small_recipe)
    runs, first, whole = tmp_path / "runs", tmp_path / "first", tmp_path / "whole"
    common = ("--pack", "paper", "--data", toy_scenes, "--runs", runs)
    run(train_app, "all", *common, "--steps", 4, "--batch-size", 4)
    assert read_checkpoint(runs / "depth.pt")["config"]["optimizer"] == "adam"
    # So little training finds no vehicle, and then there is nothing to measure errors on.
    run(export_app, *common, "--out", first, "--stand-ins")
    run(train_app, "guided", *common, "--batch-size", 2, "--guide", first)
    run(export_app, *common, "--out", whole, "--beside", first)

    pack = load_pack(str(whole))
    assert set(pack.networks) == {"detector", "multibin", "depth", "guided"}
    assert pack.networks["detector"].metadata["format"] == "yolov3"
    assert pack.networks["depth"].metadata["fit"]["width"] == 256
    scores = json.loads((whole / "manifest.json").read_text())["scores"]
    assert all(scores[name]["parity_with_torch"] < 1e-3 for name in pack.networks)
    assert scores["detector"]["stand_ins"] is True

    # The guided detector's cells are 8 px of the frame, the depth net's 8 px of a canvas on which the frame is scaled by 0.6.
    pipeline = Pipeline(pack, PipelineSettings(hard_mode="always", score_threshold=1e-4))
    pipeline.warm_up()
    scene = open_scene(toy_scenes / "toy-09")
    moment = scene.truth(0).captured_at_ns
    frames = tuple(EncodedFrame(camera, scene.frame_bytes(camera, 0), moment) for camera in scene.camera_ids)
    result = pipeline.run(FrameSet(scene.site, frames, moment, 1))
    assert result.hard == frozenset(scene.camera_ids)
    assert {"detect", "orient", "depth", "guided", "fuse"} <= set(result.timing_ms)
    assert sum(result.detections.values()) > 0
    assert all(np.isfinite(own.center).all() for own in result.per_camera)


def test_the_recipe_is_the_papers() -> None:
    recipe = paper_recipe()
    assert recipe.names == ("detector", "multibin", "depth")
    rates = {network.name: network.training.learning_rate for network in recipe.networks}
    assert (rates["multibin"], rates["depth"]) == (1e-4, 1e-4)
    # The paper's frames are decoded at half size, and lie on the depth net's canvas as they are.
    assert canvas_size(642, 192) == DEPTH_CANVAS_HW[::-1]
    assert recipe.network("multibin").config.max_width is None


@pytest.mark.parametrize("name", ["detector", "multibin", "depth"])
def test_weights_that_are_not_there_are_named(name: str, tmp_path: Path) -> None:
    network = small_recipe().network(name)
    net = network.build(network.config)
    for file in ("absent.pt", "absent"):
        with pytest.raises(InputError, match="absent"):
            network.load_pretrained(net, tmp_path / file)
