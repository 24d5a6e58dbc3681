"""Start the edge detector from NanoDet-g, a public detector of COCO's 80 classes (weights: Apache-2.0).

Backbone, neck and the hidden maps of the heads are NanoDet-g's; what the heads say of anchors is new. Three things differ, and
are learned again: ReLU for LeakyReLU (0.1), nearest for bilinear upsampling, and zero padding around pixels of another mean.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from models_export.data.nanodet import CREDIT, MEAN_BGR, STD_BGR
from models_export.graphs import constants
from models_export.nets.blocks import PIXEL_OFFSET, PIXEL_SCALE
from models_export.nets.detector import DetectorConfig
from models_export.train.exported import read_model, start_from
from models_export.train.task import Task
from service.errors import InputError
from service.geometry.transforms import Array


def load_nanodet(task: Task, path: Path) -> dict[str, Any]:
    """Put NanoDet-g's weights into the edge detector of a task; returns where they come from, for the record.

    path: an ONNX file whose batch norms are folded into its convolutions. Raises InputError when it cannot be read, is not
    NanoDet-g, or the detector does not have NanoDet-g's shape.
    """
    try:
        new = ["down", *(f"heads.{scale}.1" for scale in range(len(task.config.strides)))]
        start_from(task, nanodet_values(read_model(path).graph, task.config), new)
    except (KeyError, ValueError) as error:
        raise InputError(
            f"is not NanoDet-g, or the detector has another shape: {error}",
            field=str(path),
            remedy="Give NanoDet-g in ONNX, and the detector its shape.",
        ) from error
    return {"taken_from": CREDIT}


def nanodet_values(graph: onnx.GraphProto, config: DetectorConfig) -> dict[str, Array]:
    """Weights and biases by the parameter of the edge detector that they become, for RGB pixels as its networks see them.

    Raises ValueError when the graph has not as many convolutions as NanoDet-g.
    """
    stored = {name: array.astype(np.float64) for name, array in constants(graph).items()}
    convolutions = [node for node in graph.node if node.op_type == "Conv"]
    names = list(_names(config))
    if len(convolutions) != len(names):
        raise ValueError(f"{len(convolutions)} convolutions, not {len(names)}")
    values: dict[str, Array] = {}
    for name, node in zip(names, convolutions, strict=True):
        if name is not None:
            values[f"{name}.weight"], values[f"{name}.weight_bias"] = (stored[entry] for entry in node.input[1:3])
    pixels, shift = values["stem.0.weight"], values["stem.0.weight_bias"]
    # (x - mean) / std of x = (n + offset) / scale, channels turned around.
    values["stem.0.weight"] = (pixels / (STD_BGR.reshape(1, 3, 1, 1) * PIXEL_SCALE))[:, ::-1].copy()
    values["stem.0.weight_bias"] = shift + (pixels.sum((2, 3)) * ((PIXEL_OFFSET / PIXEL_SCALE - MEAN_BGR) / STD_BGR)).sum(1)
    return values


def _names(config: DetectorConfig) -> Iterator[str | None]:
    """The edge detector's convolutions in the order of NanoDet-g's file, which the graph's own order of running is; None for
    what it leaves out."""
    yield "stem.0"
    for stride, blocks in zip((4, 8, 16, 32), config.blocks, strict=True):
        yield f"stage{stride}.first.0"
        for block in range(blocks):
            yield f"stage{stride}.inner.{block}.first.0"
            yield f"stage{stride}.inner.{block}.second.0"
        yield f"stage{stride}.last.0"
    yield from ("lateral32.0", "lateral16.0", "lateral8.0")
    for scale in reversed(range(len(config.strides))):
        yield f"heads.{scale}.0.0"
        yield None
