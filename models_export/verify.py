"""The parity gate: what is exported must compute what was trained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from service.errors import PackError
from service.nets.pack import Network

Precision = Literal["fp32", "fp16"]

MAX_RELATIVE_DIFFERENCE: dict[Precision, float] = {"fp32": 1e-3, "fp16": 1e-2}
"""Largest absolute difference of an output over that output's range, by the precision of the exported network.

float16 keeps 11 bits, so that each rounding moves a value by up to 5e-4 of itself, and a deep network rounds many times.
"""


@dataclass(frozen=True, eq=False)
class TorchNetwork:
    """A torch network with the face of :class:`service.nets.pack.Network`, for what decodes its outputs."""

    name: str
    net: nn.Module
    metadata: dict[str, Any]

    def run(self, *batch: NDArray[Any]) -> list[NDArray[np.float32]]:
        """All outputs for one batch of each input."""
        with torch.inference_mode():
            outputs = self.net(*(torch.from_numpy(part) for part in batch))
        return [output.numpy() for output in (outputs if isinstance(outputs, tuple) else (outputs,))]


Inputs = NDArray[np.uint8] | tuple[NDArray[Any], ...]
"""A batch of the network's input, or of each of its inputs."""


def parity(net: nn.Module, network: Network, inputs: Sequence[Inputs]) -> float:
    """Largest absolute difference between torch and ONNX Runtime, over each output's range, on real inputs.

    inputs: batches (B, H, W, 3) uint8, or tuples of a batch for each input; give several shapes, non-square ones among them.
    """
    original = TorchNetwork(network.name, net, network.metadata)
    batches = [given if isinstance(given, tuple) else (given,) for given in inputs]
    return max((relative_difference(original.run(*b), network.run(*b), network.name) for b in batches), default=0.0)


def require_parity(net: nn.Module, network: Network, inputs: Sequence[Inputs], precision: Precision = "fp32") -> float:
    """:func:`parity`, raising PackError when it exceeds ``MAX_RELATIVE_DIFFERENCE`` of the precision."""
    return require_small(parity(net, network, inputs), network.name, "The exporter changed the network", precision)


def relative_difference(expected: Sequence[NDArray[Any]], found: Sequence[NDArray[Any]], name: str) -> float:
    """Largest absolute difference of outputs over each output's range. Raises PackError where shapes differ."""
    worst = 0.0
    for reference, output in zip(expected, found, strict=True):
        if reference.shape != output.shape:
            raise PackError(f"shape {output.shape}, the original gives {reference.shape}.", field=name)
        reference, output = reference.astype(np.float64), output.astype(np.float64)
        span = float(np.ptp(reference)) or 1.0
        worst = max(worst, float(np.abs(reference - output).max()) / span)
    return worst


def require_small(difference: float, name: str, reason: str, precision: Precision = "fp32") -> float:
    """The difference, raising PackError with the reason when it exceeds ``MAX_RELATIVE_DIFFERENCE`` of the precision."""
    accepted = MAX_RELATIVE_DIFFERENCE[precision]
    if not difference <= accepted:
        raise PackError(
            f"the original and the pack's network differ by {difference:.2e} of the output's range.",
            field=name,
            remedy=f"{reason}; {precision} may differ by {accepted:.0e}.",
        )
    return difference
