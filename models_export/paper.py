"""The recipe of pack ``paper``: the source paper's networks, at their published size unless other shapes are given."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from models_export.darknet_weights import read_backbone
from models_export.data.guided_frames import NO_GUIDE_NOISE
from models_export.guided import GuidedRecipe
from models_export.guided_losses import GuidedLossConfig
from models_export.metadata import depth_metadata, multibin_metadata, yolov3_metadata
from models_export.nets.dpt import DptConfig, DptHybrid
from models_export.nets.guided import PAPER as PUBLISHED
from models_export.nets.guided import ResNetGuided
from models_export.nets.resnet import load_imagenet
from models_export.nets.vgg_multibin import VggMultibin, VggMultibinConfig
from models_export.nets.yolov3 import Yolov3, Yolov3Config
from models_export.recipe import NetworkRecipe, PackRecipe
from models_export.train.checkpoint import checkpoint_or
from models_export.train.config import TrainConfig
from models_export.train.depth import DepthTask
from models_export.train.guided_targets import AssignConfig
from models_export.train.multibin import MultibinTask
from models_export.train.yolov3 import Yolov3Task

DEPTH_CANVAS_HW = (192, 672)
"""Height and width, px, of the depth net's input: the canvas of the paper's 1284x384 frames at half size, which lie on it
unscaled."""


def paper_recipe(
    detector: Yolov3Config | None = None,
    multibin: VggMultibinConfig | None = None,
    depth: DptConfig | None = None,
    guided: GuidedRecipe | None = None,
    depth_canvas_hw: tuple[int, int] = DEPTH_CANVAS_HW,
) -> PackRecipe:
    """The pack at its published size, or with networks of other shapes."""
    return PackRecipe(
        name="paper",
        version="1",
        networks=(
            _detector(detector or Yolov3Config()),
            _multibin(multibin or VggMultibinConfig()),
            _depth(depth or DptConfig(), depth_canvas_hw),
        ),
        guided=guided or _guided(),
    )


def _detector(config: Yolov3Config) -> NetworkRecipe:
    """Darknet trains by SGD for half a million steps; AdamW learns from the same loss in a small part of that."""
    return NetworkRecipe(
        name="detector",
        config=config,
        build=Yolov3,
        task=Yolov3Task,
        training=TrainConfig(steps=20_000, batch_size=16, learning_rate=1e-3, weight_decay=5e-4, clip_norm=10.0),
        outputs=config.outputs,
        metadata=yolov3_metadata,
        load_pretrained=read_backbone,
    )


def _multibin(config: VggMultibinConfig) -> NetworkRecipe:
    """The paper's rate from the first step on."""
    return NetworkRecipe(
        name="multibin",
        config=config,
        build=VggMultibin,
        task=partial(MultibinTask, build=VggMultibin),
        training=TrainConfig(
            steps=20_000, batch_size=16, optimizer="adam", learning_rate=1e-4, weight_decay=0.0, warmup_steps=0
        ),
        outputs=("vectors", "confidence", "residual"),
        metadata=multibin_metadata,
        canvas_hw=(config.crop_px, config.crop_px),
        load_pretrained=VggMultibin.load_imagenet,
    )


def _depth(config: DptConfig, canvas_hw: tuple[int, int]) -> NetworkRecipe:
    """1e-4 for the decoder; the encoder learns at a tenth of it."""
    return NetworkRecipe(
        name="depth",
        config=config,
        build=DptHybrid,
        task=partial(DepthTask, build=DptHybrid),
        training=TrainConfig(
            steps=10_000, batch_size=8, optimizer="adam", learning_rate=1e-4, weight_decay=0.0, warmup_steps=0
        ),
        outputs=("inverse_depth",),
        metadata=depth_metadata,
        canvas_hw=canvas_hw,
        load_pretrained=DptHybrid.load_pretrained,
        for_export=DptHybrid.with_folded_weights,
    )


def _guided() -> GuidedRecipe:
    """D4LCN's: anchors, loss and optimiser as published."""
    return GuidedRecipe(
        net=PUBLISHED,
        build=ResNetGuided,
        assign=AssignConfig(),
        loss=GuidedLossConfig(),
        noise=NO_GUIDE_NOISE,
        load_pretrained=checkpoint_or(_load_branches),
        training=TrainConfig(
            epochs=30, batch_size=4, optimizer="sgd", learning_rate=0.01, weight_decay=5e-4, schedule="multistep", workers=4
        ),
    )


def _load_branches(net: ResNetGuided, path: Path) -> None:
    """One ResNet-50 for image and depth map."""
    load_imagenet((net.image, net.depth), path)
