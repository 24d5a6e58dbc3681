"""A Darknet file becomes a pack that the service loads; the real YOLOv3-tiny finds the cars of a real drive."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from benchmarks.drive_score import score_drive
from benchmarks.drive_torch import score_darknet
from benchmarks.drive_truth import drive_frames
from benchmarks.recordings import PANDASET_CLIP, recording
from models_export.darknet_import import app, config_of, import_darknet, yolov3_metadata
from models_export.darknet_weights import write_weights
from models_export.data.pandaset import open_pandaset
from models_export.foreign.names import COCO_CLASSES
from models_export.nets.yolov3 import Yolov3, Yolov3Config, tiny_config
from service.errors import NotFoundError
from service.nets.detector import Detector
from service.nets.pack import load_pack

WEIGHTS_VARIABLE = "QUADLIFT_YOLOV3_TINY"
"""Path of the public COCO weights of YOLOv3-tiny, 35,434,956 bytes."""


def test_a_weight_file_becomes_a_pack(tmp_path: Path) -> None:
    config = replace(tiny_config(("person", "car", "truck")), width=0.125, max_width=160)
    torch.manual_seed(3)
    write_weights(Yolov3(config), tmp_path / "toy.weights", seen=64)
    manifest = import_darknet(tmp_path / "toy.weights", config, tmp_path / "pack", renamed={"car": "car", "truck": "car"})
    pack = load_pack(str(tmp_path / "pack"))
    assert set(pack.networks) >= {"detector", "multibin", "depth"}
    assert manifest.training["detector"]["images_seen"] == 64
    detector = Detector(pack.networks["detector"])
    assert detector.spec.format == "yolov3"
    assert detector.spec.class_of == (-1, 0, 0)
    image = np.random.default_rng(0).integers(0, 255, (90, 150, 3), dtype=np.uint8)
    found = detector.detect([image], score_threshold=1e-6)[0]
    assert len(found) > 0
    assert set(found.cls.tolist()) == {0}


def test_the_metadata_describe_the_published_networks() -> None:
    for config in (Yolov3Config(classes=("a", "b")), tiny_config(("a", "b"))):
        assert replace(config_of({**yolov3_metadata(config), "network_classes": 2}), classes=("a", "b")) == config


def test_anchors_that_do_not_fit_the_network_are_refused(tmp_path: Path) -> None:
    command = [str(tmp_path / "none.weights"), "--tiny", "--out", str(tmp_path / "pack"), "--anchors"]
    for anchors in ("1,2 3,4 5,6", "10x13", "1,2 3,4 / 5,6"):
        done = CliRunner().invoke(app, [*command, anchors])
        assert done.exit_code == 1
        assert "anchors" in done.output


def test_the_real_tiny_network_finds_the_cars_of_a_real_drive(tmp_path: Path) -> None:
    weights = Path(os.environ.get(WEIGHTS_VARIABLE, ""))
    if not weights.is_file():
        pytest.skip(f"set {WEIGHTS_VARIABLE} to the public YOLOv3-tiny COCO weights.")
    try:
        clip = open_pandaset(recording(PANDASET_CLIP))
    except NotFoundError as error:
        pytest.skip(str(error))
    config = tiny_config(COCO_CLASSES, max_width=640)
    import_darknet(weights, config, tmp_path / "pack", renamed=dict.fromkeys(("car", "truck", "bus"), "car"))
    network = load_pack(str(tmp_path / "pack")).networks["detector"]
    frames = list(drive_frames(clip, 30))
    (ours,) = score_drive(Detector(network), 640, frames, [0.3])
    (theirs,), difference = score_darknet(network, weights, frames, [0.3])
    assert ours == theirs
    assert difference < 1e-4
    # Unreadable weights find next to nothing: clear vehicles in view are mostly found, with few false boxes.
    assert ours.clear_found > 0.5 * ours.clear
    assert ours.false < ours.found
