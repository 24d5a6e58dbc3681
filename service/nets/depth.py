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


@dataclass(frozen=True)
class ReadingError:
    """Relative error of a depth read in a detected box, measured on validation scenes."""

    bias: float
    """Median of (reading - truth) / truth: the map blurs a vehicle into the road behind it."""
    sigma: float
    """Standard deviation about the bias."""


UNBIASED = ReadingError(0.0, 0.0)


class DepthNet:
    """The depth net of a pack.

    ``stride`` is the image's pixels a cell; ``reading`` how far off readings in detected boxes are.
    """

    def __init__(self, network: Network) -> None:
        try:
            self.stride = int(network.metadata["stride"])
            self.reading = ReadingError(float(network.metadata["bias_relative"]), float(network.metadata["sigma_relative"]))
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
