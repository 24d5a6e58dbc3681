"""What an ONNX graph holds, by name, and what is written into it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper


def constants(graph: onnx.GraphProto) -> dict[str, NDArray[np.generic]]:
    """The initializers."""
    return {entry.name: numpy_helper.to_array(entry) for entry in graph.initializer}


def makers(graph: onnx.GraphProto) -> dict[str, onnx.NodeProto]:
    """The node that gives each tensor."""
    return {name: node for node in graph.node for name in node.output}


def users(graph: onnx.GraphProto, tensor: str) -> list[onnx.NodeProto]:
    """The nodes that take a tensor, in the graph's order."""
    return [node for node in graph.node if tensor in node.input]


class GraphWriter:
    """Adds to a graph, each thing under a name of its own that begins with ``prefix``."""

    def __init__(self, graph: onnx.GraphProto, prefix: str) -> None:
        self._graph = graph
        self._prefix = prefix
        self._count = 0

    def before(
        self, user: onnx.NodeProto, kind: str, inputs: Sequence[str], output: str | None = None, **attributes: Any
    ) -> str:
        """A new node before another one; returns its output."""
        name = self._name(kind)
        node = helper.make_node(kind, list(inputs), [output or name], name=name, **attributes)
        self._graph.node.insert(list(self._graph.node).index(user), node)
        return output or name

    def reshaped(self, user: onnx.NodeProto, tensor: str, shape: Sequence[int]) -> str:
        """A tensor in another shape, of which 0 keeps an axis, and -1 takes what is left."""
        return self.before(user, "Reshape", [tensor, self.constant(np.array(shape, np.int64))])

    def constant(self, array: NDArray[np.generic], name: str | None = None) -> str:
        """An initializer; returns its name."""
        name = name or self._name("constant")
        self._graph.initializer.append(numpy_helper.from_array(array, name))
        return name

    def _name(self, kind: str) -> str:
        self._count += 1
        return f"{self._prefix}_{kind.lower()}_{self._count}"
