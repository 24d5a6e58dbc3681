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


Inputs = NDArray[np.uint8] | tuple[NDArray[Any], ...]
"""A batch of the network's input, or of each of its inputs."""


def parity(net: nn.Module, network: Network, inputs: Sequence[Inputs]) -> float:
    """Largest absolute difference between torch and ONNX Runtime, over each output's range, on real inputs.

    inputs: batches (B, H, W, 3) uint8, or tuples of a batch for each input; give several shapes, non-square ones among them.
    """
    worst = 0.0
    for given in inputs:
        batch = given if isinstance(given, tuple) else (given,)
        with torch.inference_mode():
            expected = net(*(torch.from_numpy(part) for part in batch))
        expected = expected if isinstance(expected, tuple) else (expected,)
        for ours, theirs in zip(expected, network.run(*batch), strict=True):
            reference = ours.numpy()
            if reference.shape != theirs.shape:
                raise PackError(f"shape {theirs.shape}, torch gives {reference.shape}.", field=network.name)
            span = float(np.ptp(reference)) or 1.0
            worst = max(worst, float(np.abs(reference - theirs).max()) / span)
    return worst


def require_parity(net: nn.Module, network: Network, inputs: Sequence[Inputs]) -> float:
    """:func:`parity`, raising PackError when it exceeds ``MAX_RELATIVE_DIFFERENCE``."""
    worst = parity(net, network, inputs)
    if not worst <= MAX_RELATIVE_DIFFERENCE:
        raise PackError(
            f"torch and ONNX Runtime differ by {worst:.2e} of the output's range.",
            field=network.name,
            remedy=f"The exporter changed the network; at most {MAX_RELATIVE_DIFFERENCE:.0e} is accepted.",
        )
    return worst
