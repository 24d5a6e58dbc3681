"""The depth net: images in, affine-invariant inverse depth out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.errors import PackError
from service.nets.canvas import batches
from service.nets.pack import Network


@dataclass(frozen=True, eq=False)
class InverseDepth:
    """An inverse-depth map up to an unknown scale and shift: ``1 / Z = scale * values + shift``."""

    values: NDArray[np.float32]
    """(h, w), row and column (i, j) at pixel ((j + 0.5) * stride - 0.5, (i + 0.5) * stride - 0.5) of the image."""
    stride: int
    """Pixels of the image a cell."""


class DepthNet:
    """The depth net of a pack.

    ``sigma_relative`` is the standard deviation of its depth over the depth, measured on validation scenes.
    """

    def __init__(self, network: Network) -> None:
        try:
            self.stride = int(network.metadata["stride"])
            self.sigma_relative = float(network.metadata["sigma_relative"])
        except (KeyError, TypeError, ValueError) as error:
            raise PackError(f"metadata is incomplete: {error!r}.", field="depth", remedy="Export the pack again.") from error
        self.network = network

    def infer(self, images: Sequence[NDArray[np.uint8]]) -> list[InverseDepth]:
        """Inverse depth of images (H, W, 3) RGB uint8, which may differ in size; cells of the padding are cut off."""
        results: list[InverseDepth | None] = [None] * len(images)
        for members, canvases in batches(images):
            (maps,) = self.network.run(canvases)
            for row, member in enumerate(members):
                height, width = images[member].shape[:2]
                values = maps[row, : -(-height // self.stride), : -(-width // self.stride)]
                results[member] = InverseDepth(values, self.stride)
        return [result for result in results if result is not None]
