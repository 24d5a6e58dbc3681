"""What the training loop needs to know of a network: its data, its loss, and how fast each part of it learns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

Batch = dict[str, Any]
"""Named tensors, which the loop moves to the device, and whatever else the loss wants."""


@dataclass(frozen=True, eq=False)
class ParameterGroup:
    """Weights that learn at the same pace."""

    parameters: Sequence[nn.Parameter]
    rate: float = 1.0
    """Factor on the learning rate."""
    decay: bool = True
    """Whether weight decay pulls on them."""


class Task(Protocol):
    """A network with the items that it learns from: frames, or vehicles in frames."""

    name: str
    """Names the checkpoint, log and curves."""
    net: nn.Module
    config: Any
    """The network's, with what the data decided."""

    def __len__(self) -> int:
        """Number of items; an epoch is as many draws."""

    def draw(self, rng: np.random.Generator, size: int) -> NDArray[np.int64]:
        """Indices (size,) of the items of one batch; :func:`draw_uniform` unless some data count for more."""

    def batch(self, indices: NDArray[np.int64], rng: np.random.Generator) -> Batch:
        """A batch of the items at ``indices``, augmented with ``rng``: the same for the same two."""

    def labels(self, index: int) -> dict[str, str]:
        """What an item is told apart by in validation, e.g. ``{"camera": "north", "weather": "night"}``."""

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Named scalar losses; ``total`` is minimised."""

    def parameter_groups(self, net: nn.Module) -> list[ParameterGroup]:
        """The weights that learn; :func:`decayed_groups` unless parts learn at their own pace."""

    def describe(self) -> dict[str, Any]:
        """The resolved configuration of network and data, for checkpoint and manifest."""


def draw_uniform(rng: np.random.Generator, items: int, size: int) -> NDArray[np.int64]:
    """Indices (size,) of ``items`` items, each as likely as the others, with replacement."""
    return rng.integers(items, size=size)


def decayed_groups(net: nn.Module, rate: float = 1.0) -> list[ParameterGroup]:
    """The trainable weights of a network, or of a part of it: matrices and kernels decay, biases and norms do not."""
    trainable = [p for p in net.parameters() if p.requires_grad]
    return [
        ParameterGroup([p for p in trainable if p.ndim > 1], rate),
        ParameterGroup([p for p in trainable if p.ndim <= 1], rate, decay=False),
    ]
