"""The last layers of a quantized network: int8 products whose sums come out as floats, unrounded."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import onnx
from numpy.typing import NDArray

from models_export.graphs import GraphWriter, constants, makers

_INT8_MOST = 127
_COLUMNS = 16
"""Products have a multiple of as many columns: with others, ONNX Runtime before 1.25 gives garbage on processors with AMX."""


def multiply_in_int8(graph: onnx.GraphProto, outputs: Sequence[str]) -> None:
    """Let outputs that are 1x1 convolutions of quantized maps multiply int8 by int8; changes the graph.

    A result that feeds an exponential or a sigmoid must not be rounded; but the layer's input is int8 already, and weights
    lose little. As a matrix product of cells by channels ONNX Runtime does that without turning the map into floats and into
    another order first. Other outputs stay as they are.
    """
    values, made = constants(graph), makers(graph)
    for output in outputs:
        layer = made[output]
        read = made.get(layer.input[0])
        weight = values.get(layer.input[1]) if len(layer.input) > 1 else None
        if layer.op_type != "Conv" or read is None or read.op_type != "DequantizeLinear" or weight is None:
            continue
        if weight.shape[2:] == (1, 1):
            _as_product(graph, layer, weight, output)


def _as_product(graph: onnx.GraphProto, layer: onnx.NodeProto, weight: NDArray[np.float32], output: str) -> None:
    """Put the product of cells and weights (C_out, C_in, 1, 1) in a layer's place."""
    added = GraphWriter(graph, output)
    read, name, *bias = layer.input
    scale = np.maximum(np.abs(weight).max((1, 2, 3)), np.finfo(np.float32).tiny) / np.float32(_INT8_MOST)
    # Named and shaped as the quantizer leaves all weights: a training can start from them.
    stored = added.constant(np.rint(weight / scale[:, None, None, None]).astype(np.int8), f"{name}_quantized")
    added.constant(scale, f"{name}_scale")
    table = added.before(layer, "Squeeze", [stored, added.constant(np.array([2, 3], np.int64))])
    columns, scales = added.before(layer, "Transpose", [table], perm=(1, 0)), f"{name}_scale"
    beyond = -len(scale) % _COLUMNS
    if beyond:
        columns = added.before(layer, "Pad", [columns, added.constant(np.array([0, 0, 0, beyond], np.int64))])
        scales = added.before(layer, "Concat", [scales, added.constant(np.ones(beyond, np.float32))], axis=0)
    zeros = added.constant(np.zeros(len(scale) + beyond, np.int8))
    factors = added.before(layer, "DequantizeLinear", [columns, scales, zeros], axis=1)
    cells = added.before(layer, "Transpose", [read], perm=(0, 2, 3, 1))
    product = added.before(layer, "MatMul", [cells, factors])
    if beyond:
        span = [added.constant(np.array([number], np.int64)) for number in (0, len(scale), -1)]
        product = added.before(layer, "Slice", [product, *span])
    if bias:
        product = added.before(layer, "Add", [product, *bias])
    added.before(layer, "Transpose", [product], output, perm=(0, 3, 1, 2))
    graph.node.remove(layer)
    graph.initializer.remove(next(entry for entry in graph.initializer if entry.name == name))
