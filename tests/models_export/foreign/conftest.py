"""Tiny detectors in every foreign format. Each finds what is red and calls it a car, and what is blue and calls it a person."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from models_export.foreign.formats import PRESETS
from models_export.foreign.graph import Normalisation

WIDTH, HEIGHT = 96, 64
CLASSES = ("person", "car", "bus")
STRIDES = (8, 16, 32)
BINS = 8
CALIBRATED = 6.0
"""Logit of a colour that fills a cell; its negative where there is none of it."""

Writer = Callable[..., Path]


class Builder:
    """Nodes and constants of one graph."""

    def __init__(self, normalisation: Normalisation, batch: int | str) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self.normalisation = normalisation
        self.inputs = [helper.make_tensor_value_info("images", TensorProto.FLOAT, [batch, 3, HEIGHT, WIDTH])]

    def add(self, operator: str, inputs: list[str], **attributes: object) -> str:
        name = f"t{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, inputs, [name], **attributes))
        return name

    def constant(self, value: np.ndarray) -> str:
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(value, name))
        return name

    def colours(self, stride: int, rows: list[str]) -> str:
        """(B, len(rows), h, w): logits of ``red``, ``blue``, ``both``; or ``none``, which is very unlikely; or ``zero``."""
        weights, bias = np.zeros((len(rows), 3, 1, 1), np.float32), np.zeros(len(rows), np.float32)
        mean, std = np.array(self.normalisation.mean), np.array(self.normalisation.std)
        channel = {"red": 2, "blue": 0} if self.normalisation.is_bgr else {"red": 0, "blue": 2}
        for index, row in enumerate(rows):
            if row == "zero":
                continue
            wanted = {"both": ["red", "blue"], "none": []}.get(row, [row])
            bias[index] = -CALIBRATED
            for name in wanted:
                # A part p of 255 in the channel is worth 2 p CALIBRATED.
                k = channel[name]
                weights[index, k] = 2 * CALIBRATED * std[k] / 255
                bias[index] += 2 * CALIBRATED * mean[k] / 255
        pooled = self.add("AveragePool", ["images"], kernel_shape=[stride, stride], strides=[stride, stride])
        return self.add("Conv", [pooled, self.constant(weights), self.constant(bias)], kernel_shape=[1, 1])

    def rows(self, head: str, columns: int) -> str:
        """(B, C, h, w) as (B, h * w, C)."""
        flat = self.add("Reshape", [head, self.constant(np.array([0, columns, -1], np.int64))])
        return self.add("Transpose", [flat], perm=[0, 2, 1])


def cell_boxes(stride: int = 8, side: float = 24.0) -> np.ndarray:
    """Boxes cx cy w h of one size about the centre of every cell, (1, N, 4)."""
    y, x = np.mgrid[0 : HEIGHT // stride, 0 : WIDTH // stride]
    centers = (np.stack([x.ravel(), y.ravel()], -1) + 0.5) * stride
    return np.concatenate([centers, np.full_like(centers, side)], 1)[None].astype(np.float32)


def _yolov3(b: Builder) -> list[str]:
    anchor = ["zero"] * 4 + ["both", "blue", "red", "none"]
    return [b.colours(stride, anchor * 3) for stride in (32, 8, 16)]


def _yolox(b: Builder) -> list[str]:
    parts = []
    for stride in STRIDES:
        scores = b.add("Sigmoid", [b.rows(b.colours(stride, ["both", "blue", "red", "none"]), 4)])
        parts.append(b.add("Concat", [b.rows(b.colours(stride, ["zero"] * 4), 4), scores], axis=2))
    return [b.add("Concat", parts, axis=1)]


def _nanodet(b: Builder) -> list[str]:
    return [b.add("Concat", [b.add("Concat", list(pair), axis=2) for pair in zip(*_nanodet_parts(b), strict=True)], axis=1)]


def _nanodet_parts(b: Builder) -> tuple[list[str], list[str]]:
    scores = [b.add("Sigmoid", [b.rows(b.colours(stride, ["blue", "red", "none"]), 3)]) for stride in STRIDES]
    return scores, [b.rows(b.colours(stride, ["zero"] * 4 * BINS), 4 * BINS) for stride in STRIDES]


def _nanodet_pairs(b: Builder) -> list[str]:
    scores, distances = _nanodet_parts(b)
    return [name for pair in zip(distances[::-1], scores[::-1], strict=True) for name in pair]


def _nanodet_logits(b: Builder) -> list[str]:
    scores = [b.rows(b.colours(stride, ["blue", "red", "none"]), 3) for stride in STRIDES]
    return [*scores, *(b.rows(b.colours(stride, ["zero"] * 4 * BINS), 4 * BINS) for stride in STRIDES)]


def _boxed(b: Builder, boxes: np.ndarray) -> tuple[str, str]:
    """Boxes (B, N, 4) and class scores (B, N, 3), which keep the batch of the images."""
    scores = b.add("Sigmoid", [b.rows(b.colours(8, ["blue", "red", "none"]), 3)])
    return b.add("Add", [b.rows(b.colours(8, ["zero"] * 4), 4), b.constant(boxes)]), scores


def _v8(b: Builder) -> list[str]:
    return [b.add("Transpose", [b.add("Concat", list(_boxed(b, cell_boxes())), axis=2)], perm=[0, 2, 1])]


def _v5(b: Builder) -> list[str]:
    boxes, scores = _boxed(b, cell_boxes())
    objectness = b.add("Sigmoid", [b.rows(b.colours(8, ["both"]), 1)])
    return [b.add("Concat", [boxes, objectness, scores], axis=2)]


def _best(b: Builder, scores: str) -> tuple[str, str]:
    """Best score and its class, (B, N) each."""
    axis = b.constant(np.array([2], np.int64))
    return b.add("ReduceMax", [scores, axis], keepdims=0), b.add("ArgMax", [scores], axis=2, keepdims=0)


def _end2end(b: Builder) -> list[str]:
    boxes = cell_boxes()
    corners = np.concatenate([boxes[..., :2] - boxes[..., 2:] / 2, boxes[..., :2] + boxes[..., 2:] / 2], 2)
    kept, scores = _boxed(b, corners)
    best, cls = _best(b, scores)
    axis = b.constant(np.array([2], np.int64))
    columns = [b.add("Unsqueeze", [best, axis]), b.add("Unsqueeze", [b.add("Cast", [cls], to=TensorProto.FLOAT), axis])]
    return [b.add("Concat", [kept, *columns], axis=2)]


def _rtdetr(b: Builder) -> list[str]:
    unit = cell_boxes() / np.array([WIDTH, HEIGHT, WIDTH, HEIGHT], np.float32)
    return [b.add("Concat", list(_boxed(b, unit)), axis=2)]


def _rtdetr_authors(b: Builder) -> list[str]:
    """Labels, boxes and scores; the boxes x0 y0 x1 y1 in pixels of a picture whose size is an input."""
    b.inputs.append(helper.make_tensor_value_info("orig_target_sizes", TensorProto.INT64, ["batch", 2]))
    boxes = cell_boxes() / np.array([WIDTH, HEIGHT, WIDTH, HEIGHT], np.float32)
    corners = np.concatenate([boxes[..., :2] - boxes[..., 2:] / 2, boxes[..., :2] + boxes[..., 2:] / 2], 2)
    kept, scores = _boxed(b, corners)
    best, cls = _best(b, scores)
    sides = b.add("Cast", ["orig_target_sizes"], to=TensorProto.FLOAT)
    four = b.add("Unsqueeze", [b.add("Concat", [sides, sides], axis=1), b.constant(np.array([1], np.int64))])
    return [cls, b.add("Mul", [kept, four]), best]


_MODELS: dict[str, tuple[str, Callable[[Builder], list[str]]]] = {
    "yolov3": ("yolov3", _yolov3),
    "yolox": ("yolox", _yolox),
    "nanodet": ("nanodet", _nanodet),
    "nanodet pairs": ("nanodet", _nanodet_pairs),
    "nanodet logits": ("nanodet", _nanodet_logits),
    "v8": ("ultralytics", _v8),
    "v5": ("ultralytics", _v5),
    "end2end": ("ultralytics", _end2end),
    "rtdetr": ("rtdetr", _rtdetr),
    "rtdetr authors": ("rtdetr", _rtdetr_authors),
}


@pytest.fixture
def write_model(tmp_path: Path) -> Writer:
    """Writes a model by name, and gives its path; ``batch`` is a number, or a name for any."""

    def write(name: str, batch: int | str = 1) -> Path:
        form, build = _MODELS[name]
        builder = Builder(PRESETS[form].normalisation, batch)  # type: ignore[index]
        outputs = [helper.make_empty_tensor_value_info(output) for output in build(builder)]
        graph = helper.make_graph(builder.nodes, "tiny", builder.inputs, outputs, builder.constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
        inferred = onnx.shape_inference.infer_shapes(model)
        path = tmp_path / f"{name.replace(' ', '_')}.onnx"
        onnx.save(inferred, path)
        return path

    return write
