"""The parity gate: what is exported must compute what was trained."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from service.errors import PackError
from service.nets.pack import Network

MAX_RELATIVE_DIFFERENCE = {"fp32": 1e-3, "fp16": 1e-2}
"""Largest absolute difference of an output over that output's range, by the precision of the exported network.

float16 keeps 11 bits, so that each rounding moves a value by up to 5e-4 of itself, and a deep network rounds many times.
"""


def parity(net: nn.Module, network: Network, inputs: Sequence[NDArray[np.uint8]]) -> float:
    """Largest absolute difference between torch and ONNX Runtime, over each output's range, on real inputs.

    inputs: batches (B, H, W, 3) uint8; give several shapes, non-square ones among them.
    """
    worst = 0.0
    for batch in inputs:
        with torch.inference_mode():
            expected = net(torch.from_numpy(batch))
        expected = expected if isinstance(expected, tuple) else (expected,)
        for ours, theirs in zip(expected, network.run(batch), strict=True):
            reference = ours.numpy()
            if reference.shape != theirs.shape:
                raise PackError(f"shape {theirs.shape}, torch gives {reference.shape}.", field=network.name)
            span = float(np.ptp(reference)) or 1.0
            worst = max(worst, float(np.abs(reference - theirs).max()) / span)
    return worst


def require_parity(
    net: nn.Module, network: Network, inputs: Sequence[NDArray[np.uint8]], precision: Literal["fp32", "fp16"] = "fp32"
) -> float:
    """:func:`parity`, raising PackError when it exceeds ``MAX_RELATIVE_DIFFERENCE`` of the precision."""
    worst, accepted = parity(net, network, inputs), MAX_RELATIVE_DIFFERENCE[precision]
    if not worst <= accepted:
        raise PackError(
            f"torch and ONNX Runtime differ by {worst:.2e} of the output's range.",
            field=network.name,
            remedy=f"The exporter changed the network; {precision} may differ by {accepted:.0e}.",
        )
    return worst
