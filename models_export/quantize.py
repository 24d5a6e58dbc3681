"""Static int8 quantization of an exported network (QDQ, per channel), calibrated on training images."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
from numpy.typing import NDArray
from onnx import helper, numpy_helper
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantFormat, QuantType, quantize_static

from models_export.nets.blocks import PIXEL_OFFSET, PIXEL_SCALE

QUANTIZED_OPS = ["Conv", "Relu", "Add", "Resize", "MatMul", "Gemm", "Concat", "MaxPool", "AveragePool"]
"""Operators that run in int8; all others stay in float. Relu is among them so that chains of convolutions stay in int8."""

_NORMALISATION = ("Transpose", "Cast", "Mul", "Sub")
_PIXEL_SCALE, _PIXEL_ZERO = np.array(PIXEL_SCALE, np.float32), np.array(round(PIXEL_OFFSET / PIXEL_SCALE), np.uint8)
_PIXEL_RANGE = {"quant_type": QuantType.QUInt8, "scale": _PIXEL_SCALE, "zero_point": _PIXEL_ZERO}


class _Calibration(CalibrationDataReader):
    def __init__(self, input_name: str, batches: Sequence[NDArray[np.uint8]]) -> None:
        self._name = input_name
        self._batches = iter(batches)

    def get_next(self) -> dict[str, NDArray[np.uint8]] | None:
        batch = next(self._batches, None)
        return None if batch is None else {self._name: batch}


def quantize(model: bytes, batches: Sequence[NDArray[np.uint8]], *, keep_float: Sequence[str] = ()) -> bytes:
    """An int8 copy of a model.

    batches: calibration inputs (B, H, W, 3) uint8. keep_float: outputs whose last operator stays in float, for it feeds
    an exponential or a sigmoid where a coarse step would show.
    """
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "float.onnx", Path(folder) / "int8.onnx"
        _basic_optimised(model, source)
        graph = onnx.load(source).graph
        excluded = [node.name for node in graph.node if set(node.output) & set(keep_float)] + _attention(graph)
        pixels = _normalised_tensor(graph)
        quantize_static(
            source,
            target,
            _Calibration(graph.input[0].name, batches),
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            op_types_to_quantize=QUANTIZED_OPS,
            nodes_to_exclude=excluded,
            calibrate_method=CalibrationMethod.MinMax,
            extra_options={
                "CalibMovingAverage": True,
                "TensorQuantOverrides": {pixels: [_PIXEL_RANGE]} if pixels else {},
            },
        )
        return _read_pixels_as_quantized(onnx.load(target))


def _basic_optimised(model: bytes, path: Path) -> None:
    """Fold and fuse with ONNX Runtime itself: its symbolic shape inference, the documented way, fails on the ViT."""
    options = ort.SessionOptions()
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_BASIC
    options.optimized_model_filepath = str(path)
    options.log_severity_level = 3
    ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def _attention(graph: onnx.GraphProto) -> list[str]:
    """Products of two activations. They stay in float: the softmax between them is slow in int8, and coarse."""
    weights = {entry.name for entry in graph.initializer}
    return [node.name for node in graph.node if node.op_type == "MatMul" and not weights & set(node.input)]


def _normalised_tensor(graph: onnx.GraphProto) -> str | None:
    """The tensor of normalised pixels: the graph's input after Transpose, Cast, Mul, Sub; None if it begins otherwise."""
    chain = _chain(graph, _NORMALISATION)
    return chain[-1].output[0] if chain else None


def _chain(graph: onnx.GraphProto, kinds: Sequence[str]) -> list[onnx.NodeProto]:
    """The nodes of ``kinds`` that follow the graph's input one after another; empty if it goes on otherwise."""
    found: list[onnx.NodeProto] = []
    name = graph.input[0].name
    for kind in kinds:
        users = [node for node in graph.node if name in node.input and node.op_type != "Shape"]
        if len(users) != 1 or users[0].op_type != kind:
            return []
        found.append(users[0])
        name = users[0].output[0]
    return found


def _read_pixels_as_quantized(model: onnx.ModelProto) -> bytes:
    """Read uint8 pixels as quantized numbers, instead of scaling them in float and quantizing them again.

    Cast, multiply and subtract over every pixel become one DequantizeLinear, which fuses into the operator behind it. Its
    zero point is a whole number, so pixels shift by half a grey level.
    """
    graph = model.graph
    chain = _chain(graph, _NORMALISATION)
    if not chain:
        return bytes(model.SerializeToString())
    requantized = _chain(graph, (*_NORMALISATION, "QuantizeLinear", "DequantizeLinear"))[len(chain) :]
    graph.initializer.extend(
        [numpy_helper.from_array(_PIXEL_SCALE, "pixel_scale"), numpy_helper.from_array(_PIXEL_ZERO, "pixel_zero_point")]
    )
    output = (requantized or chain)[-1].output[0]
    read = helper.make_node("DequantizeLinear", [chain[0].output[0], "pixel_scale", "pixel_zero_point"], [output])
    read.name = "read_pixels"
    place = list(graph.node).index(chain[0]) + 1
    for node in [*chain[1:], *requantized]:
        graph.node.remove(node)
    graph.node.insert(place, read)
    used = {name for node in graph.node for name in node.input}
    for stale in [entry for entry in graph.initializer if entry.name not in used]:
        graph.initializer.remove(stale)
    return bytes(model.SerializeToString())
