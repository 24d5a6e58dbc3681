"""The detector of pack ``paper``: YOLOv3 at its published size, from ``darknet53.conv.74`` where the user has it."""

from __future__ import annotations

from pathlib import Path

from models_export.darknet_weights import read_backbone
from models_export.metadata import yolov3_metadata
from models_export.nets.yolov3 import Yolov3, Yolov3Config
from models_export.recipe import NetworkRecipe, load_checkpoint
from models_export.train.config import TrainConfig
from models_export.train.yolov3 import Yolov3Task

_CHECKPOINT = ".pt"


def yolov3_recipe(config: Yolov3Config | None = None) -> NetworkRecipe:
    """The network, its training and its export.

    Darknet trains by SGD for half a million steps; AdamW learns from the same loss in a small part of that.
    """
    config = config or Yolov3Config()
    return NetworkRecipe(
        name="detector",
        config=config,
        build=Yolov3,
        task=Yolov3Task,
        training=TrainConfig(steps=20_000, batch_size=16, learning_rate=1e-3, weight_decay=5e-4, clip_norm=10.0),
        outputs=config.outputs,
        metadata=yolov3_metadata,
        load_pretrained=load_yolov3,
    )


def load_yolov3(net: Yolov3, path: Path) -> None:
    """Start from the convolutions of a Darknet file, whole or partial, or from an earlier run's checkpoint (``.pt``).

    Raises InputError for a file that does not fit.
    """
    if path.suffix == _CHECKPOINT:
        load_checkpoint(net, path)
    else:
        read_backbone(net, path)
