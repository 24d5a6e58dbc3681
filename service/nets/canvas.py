"""The canvas: a decoded image, padded to what convolutions of stride 32 need. Training and serving both go through it.

Padding only: an image is scaled while it is decoded (``service.frames``), never resampled here, so pixel (u, v) of the
image is pixel (u, v) of the canvas.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

ALIGN_PX = 32
PAD_VALUE = 114
"""Grey of the padding, 0..255."""


def canvas_size(width: int, height: int) -> tuple[int, int]:
    """Width and height of the canvas of an image: each rounded up to a multiple of 32 px."""
    return -(-width // ALIGN_PX) * ALIGN_PX, -(-height // ALIGN_PX) * ALIGN_PX


def to_canvas(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """An image (H, W, 3) RGB padded right and below with grey: (H', W', 3)."""
    height, width = image.shape[:2]
    canvas_width, canvas_height = canvas_size(width, height)
    pad = (PAD_VALUE,) * 3
    padded = cv2.copyMakeBorder(image, 0, canvas_height - height, 0, canvas_width - width, cv2.BORDER_CONSTANT, value=pad)
    return np.asarray(padded, dtype=np.uint8)


def batches(images: Sequence[NDArray[np.uint8]]) -> list[tuple[list[int], NDArray[np.uint8]]]:
    """Images grouped by the shape of their canvas: (indices into ``images``, canvases (B, H, W, 3))."""
    groups: dict[tuple[int, ...], list[int]] = {}
    canvases = [to_canvas(image) for image in images]
    for index, canvas in enumerate(canvases):
        groups.setdefault(canvas.shape, []).append(index)
    return [(members, np.stack([canvases[i] for i in members])) for members in groups.values()]
