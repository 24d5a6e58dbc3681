"""The depth net: images in, affine-invariant inverse depth out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from service.errors import PackError
from service.nets.canvas import CanvasBatch, InputFit, Placement
from service.nets.pack import Network


@dataclass(frozen=True, eq=False)
class InverseDepth:
    """An inverse-depth map up to an unknown scale and shift: ``1 / Z = scale * values + shift``."""

    values: NDArray[np.float32]
    """(h, w), row and column (i, j) at pixel ((j + 0.5) * stride - 0.5, (i + 0.5) * stride - 0.5) of the image."""
    stride: float
    """Pixels of the image a cell; not whole where the image was scaled to the net's size."""

    def on_cells(self, shape: tuple[int, int], stride: float) -> InverseDepth:
        """The map on other cells (h, w) of the same image, of ``stride`` px: bilinear, the last cell repeated at the border."""
        if shape == self.values.shape and stride == self.stride:
            return self
        ratio = stride / self.stride
        # Cell j lies at pixel (j + 0.5) * stride - 0.5.
        to_ours = np.array([[ratio, 0.0, 0.5 * ratio - 0.5], [0.0, ratio, 0.5 * ratio - 0.5]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        values = cv2.warpAffine(self.values, to_ours, shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return InverseDepth(np.asarray(values, dtype=np.float32), stride)

    def at_width(self, width: int, new_width: int) -> InverseDepth:
        """The same map of the image at another size: from ``width`` to ``new_width`` px."""
        return replace(self, stride=self.stride * new_width / width)


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

    ``stride`` is the canvas' pixels a cell; ``reading`` how far off readings in detected boxes are; ``fit`` what the net
    takes in.
    """

    def __init__(self, network: Network) -> None:
        try:
            self.stride = int(network.metadata["stride"])
            self.reading = ReadingError(float(network.metadata["bias_relative"]), float(network.metadata["sigma_relative"]))
            self.fit = InputFit.from_metadata(network.metadata.get("fit"))
            if self.fit.place != "corner":
                # The cells of a centred image would begin within a cell.
                raise ValueError("the image of a depth net lies in the corner of its canvas")
        except (KeyError, TypeError, ValueError) as error:
            raise PackError(f"metadata is incomplete: {error!r}.", field="depth", remedy="Export the pack again.") from error
        self.network = network

    def infer(self, images: Sequence[NDArray[np.uint8]]) -> list[InverseDepth]:
        """Inverse depth of images (H, W, 3) RGB uint8, which may differ in size; cells of the padding are cut off."""
        return self.infer_on(self.fit.batches(images))

    def infer_on(self, batches: Sequence[CanvasBatch]) -> list[InverseDepth]:
        """:meth:`infer` on canvases that were made with ``fit``; one result an image, in the images' order."""
        results: dict[int, InverseDepth] = {}
        for batch in batches:
            (maps,) = self.network.run(batch.pixels)
            for member, values, placement in zip(batch.members, maps, batch.placements, strict=True):
                results[member] = self._cut(values, placement)
        return [results[member] for member in sorted(results)]

    def _cut(self, values: NDArray[np.float32], placement: Placement) -> InverseDepth:
        width, height = placement.size_px
        cells = values[: -(-height // self.stride), : -(-width // self.stride)]
        return InverseDepth(cells, self.stride / placement.scale)
