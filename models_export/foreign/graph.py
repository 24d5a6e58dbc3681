"""The graph of a foreign detector, and its wrapping: uint8 canvases in, normalisation inside, outputs in a fixed order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from service.errors import InputError
from service.nets.canvas import MAX_SIDE_PX

_PREFIX = "quadlift_"
_FLOATS = {TensorProto.FLOAT: np.float32, TensorProto.FLOAT16: np.float16}
_QUANTIZED = {"QuantizeLinear", "DynamicQuantizeLinear", "ConvInteger", "QLinearConv"}


@dataclass(frozen=True)
class Normalisation:
    """What a network expects of its pixels: ``(x - mean) / std`` of values 0..255."""

    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """A channel, in the network's order."""
    std: tuple[float, float, float] = (255.0, 255.0, 255.0)
    """A channel, in the network's order."""
    is_bgr: bool = False
    """Blue first."""

    def apply(self, canvases: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Canvases (B, H, W, 3) RGB uint8 as a network without our wrapping takes them: (B, 3, H, W) float32."""
        pixels = canvases[..., ::-1] if self.is_bgr else canvases
        normal = (pixels.astype(np.float32) - np.float32(self.mean)) / np.float32(self.std)
        return np.ascontiguousarray(normal.transpose(0, 3, 1, 2))


@dataclass(frozen=True, eq=False)
class ForeignGraph:
    """A detector's ONNX file, and what its inputs say."""

    model: onnx.ModelProto
    image_input: str
    """Input (B, 3, H, W)."""
    size_input: str | None
    """Input (B, 2) int64 for the picture's width and height, where there is one."""
    size: tuple[int, int]
    """Width and height, px."""
    is_batched: bool
    """The graph declares that it takes any number of images at once."""
    dtype: type[np.floating]
    """Of the image input."""

    @property
    def parameters(self) -> int:
        """Numbers in the file's tensors."""
        return sum(int(np.prod(tensor.dims)) for tensor in self.model.graph.initializer)

    @property
    def precision(self) -> str:
        """fp32, fp16 or int8."""
        if any(node.op_type in _QUANTIZED for node in self.model.graph.node):
            return "int8"
        halves = sum(tensor.data_type == TensorProto.FLOAT16 for tensor in self.model.graph.initializer)
        singles = sum(tensor.data_type == TensorProto.FLOAT for tensor in self.model.graph.initializer)
        return "fp16" if halves > singles else "fp32"

    def feeds(self, pixels: NDArray[np.float32]) -> dict[str, NDArray[np.generic]]:
        """Inputs of the graph for normalised pixels (B, 3, H, W)."""
        feeds: dict[str, NDArray[np.generic]] = {self.image_input: pixels.astype(self.dtype)}
        if self.size_input is not None:
            feeds[self.size_input] = np.tile(np.array(self.size, np.int64), (len(pixels), 1))
        return feeds


def read_graph(path: Path, size: tuple[int, int] | None) -> ForeignGraph:
    """Read a detector's ONNX file; ``size`` (width, height) is needed where the file leaves it open.

    Raises InputError, with the file as field, for what cannot be wrapped.
    """
    try:
        model = onnx.load(str(path), load_external_data=False)
    except Exception as error:  # protobuf raises types of its own
        raise _refused(path, f"not an ONNX file: {error}", "Export the model to ONNX.") from error
    if any(tensor.data_location == TensorProto.EXTERNAL for tensor in model.graph.initializer):
        raise _refused(
            path,
            "it keeps tensors outside itself (external data).",
            "Save it as one file: onnx.save(onnx.load('model.onnx'), 'whole.onnx').",
        )
    constants = {tensor.name for tensor in model.graph.initializer}
    inputs = [value for value in model.graph.input if value.name not in constants]
    images = [value for value in inputs if len(value.type.tensor_type.shape.dim) == 4]
    sizes = [value for value in inputs if value.type.tensor_type.elem_type == TensorProto.INT64 and value not in images]
    if len(images) != 1 or len(images) + len(sizes) != len(inputs) or len(sizes) > 1:
        found = ", ".join(f"{value.name} {_dims(value)}" for value in inputs)
        raise _refused(path, f"its inputs are {found}.", "It must have one image input (B, 3, H, W), and at most one of sizes.")
    return _read_image_input(path, model, images[0], sizes[0].name if sizes else None, size)


def _read_image_input(
    path: Path, model: onnx.ModelProto, value: onnx.ValueInfoProto, size_input: str | None, size: tuple[int, int] | None
) -> ForeignGraph:
    batch, channels, height, width = _dims(value)
    dtype = _FLOATS.get(value.type.tensor_type.elem_type)
    if channels != 3 or dtype is None:
        raise _refused(path, f"its image input is {_dims(value)}.", "It must be (B, 3, H, W) of float or half.")
    if isinstance(batch, int) and batch != 1:
        raise _refused(path, f"it takes exactly {batch} images at once.", "Export it with batch 1, or any batch.")
    if not isinstance(width, int) or not isinstance(height, int):
        if size is None:
            raise _refused(path, f"it leaves its input's size open: {_dims(value)}.", "Give --size WIDTHxHEIGHT.")
        width, height = size
    elif size not in (None, (width, height)):
        raise _refused(path, f"its input is {width}x{height} px, not {size[0]}x{size[1]}.", "Leave --size out.")  # type: ignore[index]
    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
        raise _refused(path, f"its input is {width}x{height} px.", f"Sides must be 1..{MAX_SIDE_PX}.")
    return ForeignGraph(model, value.name, size_input, (width, height), not isinstance(batch, int), dtype)


def wrap(graph: ForeignGraph, normalisation: Normalisation, outputs: Sequence[str], *, batched: bool) -> bytes:
    """The model with input (B, H, W, 3) RGB uint8, its normalisation inside, and ``outputs`` alone, in this order."""
    model = onnx.ModelProto()
    model.CopyFrom(graph.model)
    inner = model.graph
    width, height = graph.size
    images = helper.make_tensor_value_info(f"{_PREFIX}images", TensorProto.UINT8, ["batch" if batched else 1, height, width, 3])
    kept = [value for value in inner.input if value.name not in (graph.image_input, graph.size_input)]
    del inner.input[:]
    inner.input.extend([images, *kept])
    steps = _preprocessing(graph, normalisation)
    nodes = [*steps, *inner.node]
    del inner.node[:]
    inner.node.extend(nodes)
    inner.initializer.extend(_constants(graph, normalisation))
    by_name = {value.name: value for value in inner.output}
    chosen = [by_name[name] for name in outputs]
    del inner.output[:]
    inner.output.extend(chosen)
    return bytes(model.SerializeToString())


def _preprocessing(graph: ForeignGraph, normalisation: Normalisation) -> list[onnx.NodeProto]:
    """Nodes from our input to the graph's own."""
    precision = helper.np_dtype_to_tensor_dtype(np.dtype(graph.dtype))
    # (operator, second input if any, attributes), each on the result of the one before it.
    steps: list[tuple[str, str | None, dict[str, object]]] = [("Cast", None, {"to": TensorProto.FLOAT})]
    if normalisation.is_bgr:
        steps.append(("Gather", f"{_PREFIX}bgr", {"axis": 3}))
    steps += [
        ("Sub", f"{_PREFIX}mean", {}),
        ("Div", f"{_PREFIX}std", {}),
        ("Transpose", None, {"perm": [0, 3, 1, 2]}),
        ("Cast", None, {"to": precision}),
    ]
    nodes, current = [], f"{_PREFIX}images"
    for number, (operator, constant, attributes) in enumerate(steps):
        result = graph.image_input if number == len(steps) - 1 else f"{_PREFIX}{number}"
        inputs = [current] if constant is None else [current, constant]
        nodes.append(helper.make_node(operator, inputs, [result], name=f"{_PREFIX}{number}", **attributes))
        current = result
    return nodes


def _constants(graph: ForeignGraph, normalisation: Normalisation) -> list[onnx.TensorProto]:
    values: dict[str, NDArray[np.generic]] = {
        f"{_PREFIX}mean": np.array(normalisation.mean, np.float32),
        f"{_PREFIX}std": np.array(normalisation.std, np.float32),
    }
    if normalisation.is_bgr:
        values[f"{_PREFIX}bgr"] = np.array([2, 1, 0], np.int64)
    if graph.size_input is not None:
        # Boxes then come in pixels of the canvas.
        values[graph.size_input] = np.array([graph.size], np.int64)
    return [numpy_helper.from_array(value, name) for name, value in values.items()]


def _dims(value: onnx.ValueInfoProto) -> list[int | str]:
    """Sizes of a tensor; names or ``?`` where they are open."""
    dims = value.type.tensor_type.shape.dim
    return [dim.dim_value if dim.HasField("dim_value") else dim.dim_param or "?" for dim in dims]


def _refused(path: Path, message: str, remedy: str) -> InputError:
    return InputError(message, field=str(path), remedy=remedy)
