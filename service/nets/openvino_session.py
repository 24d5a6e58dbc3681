"""A network that OpenVINO computes, with as much of the face of an ONNX Runtime session as :class:`Network` looks at.

On x86-64 processors OpenVINO computes int8 convolutions about twice as fast as ONNX Runtime. It is an optional dependency: this
module is imported where it was chosen. Its Python package reports its use to its maker when it is imported; here it cannot.
"""

from __future__ import annotations

import queue
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Without the package that sends its reports OpenVINO sends none. A service sends nothing that nobody asked it for.
sys.modules["openvino_telemetry"] = None  # type: ignore[assignment]
import openvino  # noqa: E402

_METADATA = ["framework"]
_PROPERTIES = {
    "PERFORMANCE_HINT": "LATENCY",
    # Every process would pin its first thread to the same core.
    "ENABLE_CPU_PINNING": False,
}


@dataclass(frozen=True)
class GraphInput:
    """An input of a graph."""

    name: str
    shape: tuple[int | None, ...]
    """None: any."""


class OpenVinoSession:
    """A compiled network. Safe to run from several threads at once."""

    def __init__(self, model: bytes, threads: int, concurrent_runs: int) -> None:
        """From the bytes of an ONNX file.

        threads: of one run. concurrent_runs: that may compute at the same time; more wait.
        Raises RuntimeError when OpenVINO cannot read or compile it.
        """
        core = openvino.Core()
        graph = core.read_model(model)
        self.metadata: dict[str, str] = {}
        """What the ONNX file's metadata hold."""
        if graph.has_rt_info(_METADATA):
            self.metadata = dict(graph.get_rt_info(_METADATA).value)
        # Sizes stay open: compiled for one size it would be an eighth quicker, and each new one would take a third of a second.
        limits = {"INFERENCE_NUM_THREADS": threads * concurrent_runs, "NUM_STREAMS": concurrent_runs}
        self._compiled = core.compile_model(graph, "CPU", _PROPERTIES | limits)
        self._inputs = [
            GraphInput(given.any_name, tuple(side.get_length() if side.is_static else None for side in given.partial_shape))
            for given in graph.inputs
        ]
        self._idle: queue.SimpleQueue[openvino.InferRequest] = queue.SimpleQueue()

    def get_inputs(self) -> list[GraphInput]:
        """The graph's inputs, in its order."""
        return self._inputs

    def run(self, _: None, feeds: Mapping[str, NDArray[Any]]) -> list[NDArray[np.float32]]:
        """All outputs, in the graph's order."""
        try:
            request = self._idle.get_nowait()
        except queue.Empty:
            request = self._compiled.create_infer_request()
        # A request that failed is not used again.
        results = request.infer(feeds, share_inputs=True)
        outputs = [np.array(results[position]) for position in range(len(results))]
        self._idle.put(request)
        return outputs
