"""The parity gate: what is exported must compute what was trained."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from service.errors import PackError
from service.nets.pack import Network

MAX_RELATIVE_DIFFERENCE = 1e-3
"""Largest absolute difference of an output over that output's range."""


def parity(net: nn.Module, network: Network, inputs: Sequence[NDArray[np.uint8]]) -> float:
    """Largest absolute difference between torch and ONNX Runtime, over each output's range, on real inputs.

    inputs: batches (B, H, W, 3) uint8; give several shapes, non-square ones among them.
    """
    worst = 0.0
    for batch in inputs:
        with torch.inference_mode():
            expected = net(torch.from_numpy(batch))
        expected = expected if isinstance(expected, tuple) else (expected,)
        worst = max(worst, relative_difference([ours.numpy() for ours in expected], network.run(batch), network.name))
    return worst


def require_parity(net: nn.Module, network: Network, inputs: Sequence[NDArray[np.uint8]]) -> float:
    """:func:`parity`, raising PackError when it exceeds ``MAX_RELATIVE_DIFFERENCE``."""
    return require_small(parity(net, network, inputs), network.name, "The exporter changed the network")


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


def require_small(difference: float, name: str, reason: str) -> float:
    """The difference, raising PackError with the reason when it exceeds ``MAX_RELATIVE_DIFFERENCE``."""
    if not difference <= MAX_RELATIVE_DIFFERENCE:
        raise PackError(
            f"the original and the pack's network differ by {difference:.2e} of the output's range.",
            field=name,
            remedy=f"{reason}; at most {MAX_RELATIVE_DIFFERENCE:.0e} is accepted.",
        )
    return difference
