"""Augmentation of training images: what another camera, lens, hour or compression would have changed."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from service.geometry.transforms import Array
from service.nets.canvas import PAD_VALUE

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class AugmentConfig:
    """Strengths; each effect is drawn anew an image."""

    scale: tuple[float, float] = (0.75, 1.35)
    shift: float = 0.12
    """Largest translation over the image's size."""
    geometric: float = 0.7
    """Probability of scaling and shifting."""
    flip: float = 0.5
    brightness: float = 40.0
    """Largest offset, grey levels."""
    contrast: tuple[float, float] = (0.6, 1.4)
    saturation: tuple[float, float] = (0.3, 1.5)
    white_balance: float = 0.12
    """Largest relative gain of a colour channel."""
    blur: float = 0.15
    """Probability of a small Gaussian blur."""
    noise: float = 0.3
    """Probability of sensor noise."""
    noise_sigma: float = 10.0
    """Largest standard deviation of the noise, grey levels."""


NO_AUGMENT = AugmentConfig(
    scale=(1.0, 1.0), shift=0.0, geometric=0.0, flip=0.0, brightness=0.0, contrast=(1.0, 1.0), saturation=(1.0, 1.0),
    white_balance=0.0, blur=0.0, noise=0.0,
)  # fmt: skip
"""Images as they are: for validation."""


def photometric(image: Image, rng: np.random.Generator, config: AugmentConfig) -> Image:
    """Another exposure, colour, sharpness and noise; (H, W, 3) RGB in and out."""
    image = np.ascontiguousarray(image)
    saturation = rng.uniform(*config.saturation)
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    pixels = cv2.addWeighted(image, saturation, cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB), 1 - saturation, 0)
    # Contrast, white balance and brightness are one table a channel, about the image's mean.
    gains = rng.uniform(*config.contrast) * (1 + rng.uniform(-config.white_balance, config.white_balance, 3))
    mean = float(grey.mean())
    levels = (np.arange(256)[:, None] - mean) * gains + mean + rng.uniform(-config.brightness, config.brightness)
    pixels = cv2.LUT(pixels, np.clip(np.rint(levels), 0, 255).astype(np.uint8).reshape(1, 256, 3))
    if rng.random() < config.blur:
        pixels = cv2.GaussianBlur(pixels, (0, 0), rng.uniform(0.4, 1.0))
    if rng.random() < config.noise:
        sigma = rng.uniform(1.0, config.noise_sigma)
        noise = (sigma * rng.standard_normal(pixels.shape, dtype=np.float32)).astype(np.int16)
        pixels = cv2.add(pixels, noise, dtype=cv2.CV_8U)
    return np.asarray(pixels, dtype=np.uint8)


def flip_horizontally(image: Image, xyxy_px: Array, width: int) -> tuple[Image, Array]:
    """Mirror the left ``width`` columns of a canvas, and boxes (N, 4) with them."""
    mirrored = image.copy()
    mirrored[:, :width] = image[:, :width][:, ::-1]
    boxes = xyxy_px.copy()
    boxes[:, [0, 2]] = (width - 1) - xyxy_px[:, [2, 0]]
    return mirrored, boxes


def rescale(image: Image, xyxy_px: Array, rng: np.random.Generator, config: AugmentConfig) -> tuple[Image, Array]:
    """Scale and shift a canvas and its boxes; the canvas keeps its size, the new border is grey, boxes are not clipped."""
    height, width = image.shape[:2]
    scale = rng.uniform(*config.scale)
    center = np.array([width, height]) / 2
    offset = center + rng.uniform(-config.shift, config.shift, 2) * (width, height) - scale * center
    M = np.array([[scale, 0.0, offset[0]], [0.0, scale, offset[1]]])
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    warped = cv2.warpAffine(image, M, (width, height), flags=interpolation, borderValue=(PAD_VALUE,) * 3)
    return np.asarray(warped, dtype=np.uint8), xyxy_px * scale + np.tile(offset, 2)
