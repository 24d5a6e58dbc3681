"""The canvas: a decoded image as a network takes it in. Training and serving both go through it.

A network that takes any size gets the image as it is, padded right and below to what convolutions of stride 32 need: an
image is scaled while it is decoded (``service.frames``), so pixel (u, v) of the image is pixel (u, v) of the canvas. A
network of one fixed size gets the image scaled to fit, its shape kept, and the rest of the canvas filled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from service.geometry.transforms import Array

ALIGN_PX = 32
PAD_VALUE = 114
"""Grey of the padding, 0..255."""
MAX_SIDE_PX = 8192
"""Longest side of a fixed canvas."""


@dataclass(frozen=True)
class Placement:
    """Where an image lies on its canvas: image pixel u is canvas pixel ``(u + 0.5) * scale - 0.5 + offset``."""

    scale: float
    """Canvas pixels an image pixel, along both axes."""
    offset_px: tuple[int, int]
    """Columns left of the image and rows above it."""
    size_px: tuple[int, int]
    """Width and height of the image on the canvas."""

    def to_canvas(self, points_px: ArrayLike) -> Array:
        """Image coordinates (..., 2k), x and y in turn, on the canvas: points, or boxes x0 y0 x1 y1."""
        points = np.asarray(points_px, dtype=np.float64)
        return np.asarray((points + 0.5) * self.scale - 0.5 + self._offset(points.shape[-1]))

    def to_image(self, points_px: ArrayLike) -> Array:
        """Canvas coordinates (..., 2k) in the image: the inverse of :meth:`to_canvas`."""
        points = np.asarray(points_px, dtype=np.float64)
        return np.asarray((points + 0.5 - self._offset(points.shape[-1])) / self.scale - 0.5)

    def _offset(self, coordinates: int) -> Array:
        return np.resize(np.asarray(self.offset_px, dtype=np.float64), coordinates)


@dataclass(frozen=True, eq=False)
class CanvasBatch:
    """Canvases of one size, ready for a network."""

    members: tuple[int, ...]
    """(B,) which of the images they show."""
    pixels: NDArray[np.uint8]
    """(B, H, W, 3) RGB."""
    placements: tuple[Placement, ...]
    """(B,) where each image lies."""


@dataclass(frozen=True)
class InputFit:
    """How the canvas of a network is made from an image of any size."""

    size: tuple[int, int] | None = None
    """Width and height of every canvas, px; None: the image's own size, rounded up to multiples of ``ALIGN_PX``."""
    place: Literal["corner", "center"] = "corner"
    """Where an image that does not fill a canvas of fixed size lies: in its upper left corner, or in its middle."""
    pad_value: int = PAD_VALUE
    """Grey of the rest, 0..255."""

    @staticmethod
    def from_metadata(values: Any) -> InputFit:
        """From the object {width, height, place, pad} of an ONNX file's metadata; None gives the default.

        Raises KeyError, TypeError or ValueError.
        """
        if values is None:
            return PADDED
        fit = InputFit((int(values["width"]), int(values["height"])), values["place"], int(values["pad"]))
        sides = fit.size or ()
        if not all(0 < side <= MAX_SIDE_PX for side in sides) or fit.place not in ("corner", "center"):
            raise ValueError(f"fit {values!r}: sides of 1..{MAX_SIDE_PX} px, place 'corner' or 'center'")
        if not 0 <= fit.pad_value <= 255:
            raise ValueError(f"fit {values!r}: pad must be 0..255")
        return fit

    def to_metadata(self) -> dict[str, Any] | None:
        """The inverse of :meth:`from_metadata`."""
        if self.size is None:
            return None
        return {"width": self.size[0], "height": self.size[1], "place": self.place, "pad": self.pad_value}

    def canvas_size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of the canvas of an image, px."""
        return self.size or (-(-width // ALIGN_PX) * ALIGN_PX, -(-height // ALIGN_PX) * ALIGN_PX)

    def placement(self, width: int, height: int) -> Placement:
        """Where an image of ``width`` x ``height`` px lies on its canvas."""
        if self.size is None:
            return Placement(1.0, (0, 0), (width, height))
        scale = min(self.size[0] / width, self.size[1] / height)
        fitted = max(round(width * scale), 1), max(round(height * scale), 1)
        offset = ((self.size[0] - fitted[0]) // 2, (self.size[1] - fitted[1]) // 2) if self.place == "center" else (0, 0)
        return Placement(scale, offset, fitted)

    def batches(self, images: Sequence[NDArray[np.uint8]]) -> list[CanvasBatch]:
        """Canvases of images (H, W, 3) RGB, which may differ in size, grouped by the canvases' size."""
        groups: dict[tuple[int, int], list[int]] = {}
        for index, image in enumerate(images):
            groups.setdefault(self.canvas_size(image.shape[1], image.shape[0]), []).append(index)
        return [self._batch(images, size, members) for size, members in groups.items()]

    def _batch(self, images: Sequence[NDArray[np.uint8]], size: tuple[int, int], members: list[int]) -> CanvasBatch:
        pixels = np.full((len(members), size[1], size[0], 3), self.pad_value, np.uint8)
        placements = []
        for canvas, member in zip(pixels, members, strict=True):
            image = images[member]
            placement = self.placement(image.shape[1], image.shape[0])
            (left, top), (width, height) = placement.offset_px, placement.size_px
            canvas[top : top + height, left : left + width] = _scaled(image, placement)
            placements.append(placement)
        return CanvasBatch(tuple(members), pixels, tuple(placements))


PADDED = InputFit()
"""The fit of networks that take any size."""


class Canvases:
    """The images of one frame set, and their canvases, made once for each fit that a network asks for."""

    def __init__(self, images: Sequence[NDArray[np.uint8]]) -> None:
        self.images = images
        self._batches: dict[InputFit, list[CanvasBatch]] = {}

    def batches(self, fit: InputFit) -> list[CanvasBatch]:
        """:meth:`InputFit.batches` of the images."""
        if fit not in self._batches:
            self._batches[fit] = fit.batches(self.images)
        return self._batches[fit]


def canvas_size(width: int, height: int) -> tuple[int, int]:
    """Width and height of the padded canvas of an image: each rounded up to a multiple of 32 px."""
    return PADDED.canvas_size(width, height)


def to_canvas(image: NDArray[np.uint8], fit: InputFit = PADDED) -> NDArray[np.uint8]:
    """The canvas (H', W', 3) of one image (H, W, 3) RGB."""
    canvas: NDArray[np.uint8] = fit.batches([image])[0].pixels[0]
    return canvas


def _scaled(image: NDArray[np.uint8], placement: Placement) -> NDArray[np.uint8]:
    if placement.scale == 1.0:
        return image
    # The factor, not the size, is handed over: rounding the size must not stretch the picture. Where a side rounds to
    # nothing, no factor gives one pixel.
    if min(image.shape[0], image.shape[1]) * placement.scale < 1.0:
        return np.asarray(cv2.resize(image, placement.size_px, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    interpolation = cv2.INTER_AREA if placement.scale < 1.0 else cv2.INTER_LINEAR
    scaled = cv2.resize(image, None, fx=placement.scale, fy=placement.scale, interpolation=interpolation)
    return np.asarray(scaled, dtype=np.uint8)
