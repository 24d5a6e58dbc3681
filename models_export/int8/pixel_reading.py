"""How a quantized network reads its pixels: as the bytes that they are, and several at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import onnx
from onnx import helper, numpy_helper

from models_export.graphs import GraphWriter, makers, users
from models_export.nets.blocks import PIXEL_OFFSET, PIXEL_SCALE
from service.nets.canvas import ALIGN_PX

PIXEL_STEP, PIXEL_ZERO = np.array(PIXEL_SCALE, np.float32), np.array(round(PIXEL_OFFSET / PIXEL_SCALE), np.uint8)
"""Scale and zero point of the pixels as quantized numbers; the latter is whole, so pixels shift by half a grey level."""
_NORMALISATION = ("Transpose", "Cast", "Mul", "Sub")
_GROUPED = ("Transpose", "DequantizeLinear", "Conv", "QuantizeLinear")
_OUTPUTS = 2
"""Of one row that share a kernel. More would share their copies too, but multiply with more zeros (docs: networks)."""
_CHANNELS = 3


def normalised_pixels(graph: onnx.GraphProto) -> str | None:
    """The tensor of normalised pixels: the graph's input after Transpose, Cast, Mul, Sub; None if it begins otherwise."""
    chain = _chain(graph, _NORMALISATION)
    return chain[-1].output[0] if chain else None


def read_as_quantized(graph: onnx.GraphProto) -> None:
    """Read uint8 pixels as quantized numbers, instead of scaling them in float and quantizing them again; changes the graph.

    Cast, multiply and subtract over every pixel become one DequantizeLinear, which fuses into the operator behind it.
    """
    chain = _chain(graph, _NORMALISATION)
    if not chain:
        return
    requantized = _chain(graph, (*_NORMALISATION, "QuantizeLinear", "DequantizeLinear"))[len(chain) :]
    graph.initializer.extend(
        [numpy_helper.from_array(PIXEL_STEP, "pixel_scale"), numpy_helper.from_array(PIXEL_ZERO, "pixel_zero_point")]
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


def read_in_groups(graph: onnx.GraphProto) -> None:
    """Let the quantized convolution that reads the pixels (B, H, W, 3) read groups of them; changes the graph.

    ONNX Runtime gathers an int8 convolution's inputs a pixel a copy, which here is three bytes long, and the gathering takes
    several times as long as the products. But a row of W pixels of 3 channels is in memory also a row of W / G groups of 3 G
    channels. On those a kernel holds the old one's weights among zeros, once for each output that begins in a group, and a
    group's outputs lie side by side as the old ones did: bit for bit the same numbers. The graph computes the new kernel from
    the old one, which keeps its name and shape; ONNX Runtime does that once, as it opens the file.

    Nothing changes where no quantized convolution reads the pixels, where a row has not as many outputs as strides, or rows
    are not whole groups.
    """
    chain = _chain(graph, _GROUPED)
    made = makers(graph)
    if not chain or not all(name in made for name in chain[2].input):
        return
    transpose, _, conv, quantize = chain
    old: dict[str, Any] = {a.name: helper.get_attribute_value(a) for a in conv.attribute}
    groups = _Groups.of(old["kernel_shape"][1], old["strides"][1], (old["pads"][1], old["pads"][3]))
    if groups is None or not _is_multiple(graph.input[0].type.tensor_type.shape.dim[2], groups.pixels):
        return
    added = GraphWriter(graph, "grouped")
    weight, *bias = [made[name] for name in conv.input[1:]]
    channels = next(entry.dims[0] for entry in graph.initializer if entry.name == weight.input[0])
    kernel = _grouped_kernel(added, weight, groups, old["kernel_shape"])
    weight.input[:] = [kernel, *_repeated(added, weight, weight.input[1:])]
    for node in bias:
        node.input[:] = _repeated(added, node, node.input)
    transpose.input[0] = added.reshaped(transpose, transpose.input[0], (0, 0, -1, _CHANNELS * groups.pixels))
    new = old | {
        "kernel_shape": (old["kernel_shape"][0], groups.across),
        "strides": (old["strides"][0], 1),
        "pads": (old["pads"][0], groups.before, old["pads"][2], groups.across - 1 - groups.before),
    }
    del conv.attribute[:]
    conv.attribute.extend(helper.make_attribute(name, value) for name, value in new.items())
    # Shapes that were noted no longer hold; ONNX Runtime infers them itself.
    del graph.value_info[:]
    # Behind the rounding: bytes are moved, not floats.
    (rounded,) = quantize.output
    readers = users(graph, rounded)
    beside = added.before(readers[0], "Transpose", [rounded], perm=(0, 2, 3, 1))
    apart = added.reshaped(readers[0], beside, (0, 0, -1, channels))
    result = added.before(readers[0], "Transpose", [apart], perm=(0, 3, 1, 2))
    for user in readers:
        user.input[:] = [result if name == rounded else name for name in user.input]


@dataclass(frozen=True)
class _Groups:
    """A row in groups of pixels, and the kernel on it."""

    pixels: int
    """A group."""
    before: int
    """Groups of the kernel before the one in which its outputs begin."""
    across: int
    """Groups of the kernel."""
    starts: tuple[int, ...]
    """Column of the kernel, px, at which the old one lies, for each output of a group."""

    @classmethod
    def of(cls, width: int, stride: int, pads: tuple[int, int]) -> Self | None:
        """For a convolution along a row; None where it has not one output a stride."""
        if not width - stride <= sum(pads) < width:
            return None
        pixels = _OUTPUTS * stride
        before = -(-pads[0] // pixels)
        starts = tuple(before * pixels - pads[0] + stride * output for output in range(_OUTPUTS))
        return cls(pixels, before, -(-(starts[-1] + width) // pixels), starts)


def _grouped_kernel(added: GraphWriter, weight: onnx.NodeProto, groups: _Groups, shape: Sequence[int]) -> str:
    """The int8 weights (C, 3, h, w) that ``weight`` dequantizes as (outputs C, 3 pixels, h, across)."""
    height, width = shape
    columns = groups.across * groups.pixels
    around = [np.array([0, 0, 0, start, 0, 0, 0, columns - start - width], np.int64) for start in groups.starts]
    placed = [added.before(weight, "Pad", [weight.input[0], added.constant(pads)]) for pads in around]
    rows = added.before(weight, "Concat", placed, axis=0)
    split = added.reshaped(weight, rows, (0, _CHANNELS, height, groups.across, groups.pixels))
    # A group's channels: pixel by pixel, as they lie in memory.
    ordered = added.before(weight, "Transpose", [split], perm=(0, 4, 1, 2, 3))
    return added.reshaped(weight, ordered, (0, _CHANNELS * groups.pixels, height, groups.across))


def _repeated(added: GraphWriter, user: onnx.NodeProto, names: Sequence[str]) -> list[str]:
    """Numbers of each output channel, once more for each output of a group."""
    return [added.before(user, "Concat", [name] * _OUTPUTS, axis=0) for name in names]


def _is_multiple(dim: onnx.TensorShapeProto.Dimension, divisor: int) -> bool:
    """Whether a width always is; one that may vary is a multiple of ``ALIGN_PX``."""
    return (dim.dim_value or ALIGN_PX) % divisor == 0


def _chain(graph: onnx.GraphProto, kinds: Sequence[str]) -> list[onnx.NodeProto]:
    """The nodes of ``kinds`` that follow the graph's input one after another; empty if it goes on otherwise."""
    found: list[onnx.NodeProto] = []
    name = graph.input[0].name
    for kind in kinds:
        after = [node for node in users(graph, name) if node.op_type != "Shape"]
        if len(after) != 1 or after[0].op_type != kind:
            return []
        found.append(after[0])
        name = after[0].output[0]
    return found
