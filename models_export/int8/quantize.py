"""Static int8 quantization of an exported network (QDQ, per channel), calibrated on training images."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray

from models_export.int8.float_results import multiply_in_int8
from models_export.int8.pixel_reading import PIXEL_STEP, PIXEL_ZERO, normalised_pixels, read_as_quantized, read_in_groups
from models_export.int8.upsampling import repeat_cells
from service.nets.quiet_onnxruntime import ort

# isort: split
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantFormat, QuantType, quantize_static

QUANTIZED_OPS = ["Conv", "Relu", "Add", "Resize", "MatMul", "Gemm", "Concat", "MaxPool", "AveragePool"]
"""Operators that run in int8; all others stay in float. Relu is among them so that chains of convolutions stay in int8."""

_PIXEL_RANGE = {"quant_type": QuantType.QUInt8, "scale": PIXEL_STEP, "zero_point": PIXEL_ZERO}


class _Calibration(CalibrationDataReader):
    def __init__(self, input_name: str, batches: Sequence[NDArray[np.uint8]]) -> None:
        self._name = input_name
        self._batches = iter(batches)

    def get_next(self) -> dict[str, NDArray[np.uint8]] | None:
        batch = next(self._batches, None)
        return None if batch is None else {self._name: batch}


def quantize(model: bytes, batches: Sequence[NDArray[np.uint8]], *, keep_float: Sequence[str] = ()) -> bytes:
    """An int8 copy of a model, as any runtime reads it.

    batches: calibration inputs (B, H, W, 3) uint8. keep_float: outputs whose last operator stays in float, for it feeds
    an exponential or a sigmoid where a coarse step would show.
    """
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "float.onnx", Path(folder) / "int8.onnx"
        _basic_optimised(model, source)
        graph = onnx.load(source).graph
        excluded = [node.name for node in graph.node if set(node.output) & set(keep_float)] + _attention(graph)
        pixels = normalised_pixels(graph)
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
        return target.read_bytes()


def for_onnxruntime(model: bytes, keep_float: Sequence[str] = ()) -> bytes:
    """What :func:`quantize` gave, ``keep_float`` as there, so that ONNX Runtime computes the same in less time."""
    quantized = onnx.load_from_string(model)
    read_as_quantized(quantized.graph)
    read_in_groups(quantized.graph)
    multiply_in_int8(quantized.graph, keep_float)
    repeat_cells(quantized.graph)
    return bytes(quantized.SerializeToString())


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
