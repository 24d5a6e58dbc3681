"""Augmentation of training images: what another camera, lens, hour or compression would have changed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from service.geometry.transforms import Array
from service.nets.canvas import PAD_VALUE

Image = NDArray[np.uint8]

_NOISE_BANK = 2**23


@dataclass(frozen=True)
class AugmentConfig:
    """Strengths; each effect is drawn anew an image."""

    scale: tuple[float, float] = (0.6, 1.7)
    """Least and largest factor; drawn evenly in its logarithm."""
    shift: float = 0.12
    """Largest translation over the image's size."""
    geometric: float = 0.7
    """Probability of scaling and shifting."""
    tiles: float = 0.3
    """Probability that a canvas holds four times as many pictures, each reduced: of detectors' canvases only."""
    tile_scale: tuple[float, float] = (0.45, 0.9)
    """Least and largest factor of those."""
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
    jpeg: float = 0.3
    """Probability of another compression."""
    jpeg_quality: tuple[int, int] = (20, 80)
    motion_blur: float = 0.1
    """Probability of a camera that shakes or a shutter that is slow."""
    motion_px: int = 9
    """Longest streak."""
    night: float = 0.12
    """Probability of a dark hour: what is bright stays, the rest sinks into the sensor's noise."""
    night_gain: tuple[float, float] = (0.15, 0.5)
    fog: float = 0.12
    """Probability of a veil, denser towards the top, where the picture is usually farther away."""
    fog_opacity: tuple[float, float] = (0.2, 0.8)
    """Of the veil at the top edge."""
    cut_out: float = 0.25
    """Probability of things in front: poles, signs, leaves."""
    cut_out_side: tuple[float, float] = (0.02, 0.2)
    """Sides of one over the picture's."""
    cut_outs: int = 4
    """Most of them."""
    max_covered: float = 0.6
    """A vehicle of which more is cut out is neither positive nor negative."""
    hidden: float = 0.0
    """Probability that another vehicle hides a part: of crops of single vehicles only."""
    hidden_reach: tuple[float, float] = (0.1, 0.45)
    """How far it reaches into the crop over the crop's side."""
    cut: float = 0.0
    """Probability that the picture ends within a vehicle: of crops of single vehicles only."""
    cut_share: tuple[float, float] = (0.1, 0.7)
    """Of its width or height, what lies beyond."""


NO_AUGMENT = AugmentConfig(
    scale=(1.0, 1.0), shift=0.0, geometric=0.0, tiles=0.0, flip=0.0, brightness=0.0, contrast=(1.0, 1.0), saturation=(1.0, 1.0),
    white_balance=0.0, blur=0.0, noise=0.0, jpeg=0.0, motion_blur=0.0, night=0.0, fog=0.0, cut_out=0.0,
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
    pixels = cv2.LUT(pixels, np.clip(levels, 0, 255).astype(np.uint8).reshape(1, 256, 3))
    if rng.random() < config.night:
        pixels = darkened(pixels, rng.uniform(*config.night_gain))
    if rng.random() < config.fog:
        pixels = veiled(pixels, rng.uniform(*config.fog_opacity), rng.uniform(140, 225))
    if rng.random() < config.motion_blur:
        pixels = streaked(pixels, rng.uniform(2, config.motion_px), rng.uniform(0, np.pi))
    if rng.random() < config.blur:
        pixels = cv2.GaussianBlur(pixels, (0, 0), rng.uniform(0.4, 1.0))
    if rng.random() < config.noise:
        sigma = rng.uniform(1.0, config.noise_sigma)
        pixels = cv2.add(pixels, unit_noise(pixels.shape, rng) * np.float32(sigma), dtype=cv2.CV_8U)
    if rng.random() < config.jpeg:
        quality = int(rng.integers(*config.jpeg_quality, endpoint=True))
        pixels = simplejpeg.decode_jpeg(simplejpeg.encode_jpeg(np.ascontiguousarray(pixels), quality), "RGB")
    return np.asarray(pixels, dtype=np.uint8)


def unit_noise(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.float32]:
    """Normal noise of unit variance, a random part of a fixed field of eight million numbers."""
    start = int(rng.integers(_NOISE_BANK - int(np.prod(shape)), endpoint=True))
    return _noise_bank()[start : start + int(np.prod(shape))].reshape(shape)


@cache
def _noise_bank() -> NDArray[np.float32]:
    """Unit noise to take parts of: drawing a million normal numbers an image takes longer than all else together."""
    return np.random.default_rng(0).standard_normal(_NOISE_BANK, dtype=np.float32)


def darkened(image: Image, gain: float) -> Image:
    """A darker hour: mid-tones fall to ``gain``, lamps and what they light stay bright."""
    levels = np.arange(256) / 255.0
    curve = 255.0 * (gain * levels + (1 - gain) * levels**6)
    return np.asarray(cv2.LUT(image, curve.astype(np.uint8)), dtype=np.uint8)


def veiled(image: Image, opacity: float, grey: float) -> Image:
    """A veil of one grey level over an image (H, W, 3): ``opacity`` at the top edge, a third of it at the bottom edge."""
    share = 256 * opacity * np.linspace(1.0, 1 / 3, len(image))[:, None, None]
    kept, added = (256 - share).astype(np.uint16), (share * grey).astype(np.uint16)
    return ((image * kept + added) >> 8).astype(np.uint8)


def streaked(image: Image, length_px: float, angle_rad: float) -> Image:
    """Blurred along a line through each pixel."""
    side = 2 * int(np.ceil(length_px / 2)) + 1
    kernel = np.zeros((side, side), np.float32)
    middle, reach = side // 2, length_px / 2 * np.array([np.cos(angle_rad), np.sin(angle_rad)])
    start, end = (tuple(np.round(middle + sign * reach).astype(int).tolist()) for sign in (-1, 1))
    cv2.line(kernel, start, end, 1.0)
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()), dtype=np.uint8)


def cut_out(image: Image, xyxy_px: Array, rng: np.random.Generator, config: AugmentConfig) -> tuple[Image, Array]:
    """Rectangles of one colour over an image (H, W, 3); returns it and how much of each box (N, 4) they cover, (N,) 0..1.

    Where rectangles overlap, the overlap counts twice: the fraction is an upper bound, cut at 1.
    """
    height, width = image.shape[:2]
    covered = image.copy()
    area = np.maximum(np.prod(xyxy_px[:, 2:] - xyxy_px[:, :2], axis=1), 1e-6)
    fraction = np.zeros(len(xyxy_px))
    for _ in range(rng.integers(1, config.cut_outs, endpoint=True)):
        size = rng.uniform(*config.cut_out_side, 2) * (width, height)
        corner = rng.uniform(0, (width, height) - size)
        x0, y0, x1, y1 = np.round(np.concatenate([corner, corner + size])).astype(int)
        covered[y0 : y1 + 1, x0 : x1 + 1] = rng.integers(0, 256, 3)
        sides = np.minimum(xyxy_px[:, 2:], [x1, y1]) - np.maximum(xyxy_px[:, :2], [x0, y0])
        fraction += np.prod(np.maximum(sides, 0), axis=1) / area
    return covered, np.minimum(fraction, 1.0)


def hidden_behind(crop: Image, other: Image, rng: np.random.Generator, config: AugmentConfig) -> Image:
    """A square crop (S, S, 3) with a part of another over its left or right side or its bottom: a neighbour in a row."""
    side = len(crop)
    reach = max(1, round(side * rng.uniform(*config.hidden_reach)))
    along = round(side * rng.uniform(0.4, 1.0))
    # Left and right of the crop the other stands on the same ground, below it anywhere.
    across = (slice(side - along, side), int(rng.choice([0, side - reach])), reach)
    below = (slice(side - reach, side), int(rng.integers(0, side - along, endpoint=True)), along)
    rows, left, width = across if rng.random() < 2 / 3 else below
    start = int(rng.integers(0, side - width, endpoint=True))
    covered = crop.copy()
    covered[rows, left : left + width] = other[rows, start : start + width]
    return covered


def border_within(xyxy_px: Array, rng: np.random.Generator, config: AugmentConfig) -> Array:
    """A border (4,), left top right bottom, of a picture that ends within a box (4,): on one side, or on two that meet."""
    border = np.array([-np.inf, -np.inf, np.inf, np.inf])
    across, down = rng.integers(2) * 2, 1 + rng.integers(2) * 2
    sides = (across, down) if rng.random() < 1 / 3 else (across if rng.random() < 1 / 2 else down,)
    for side in sides:
        share, start = rng.uniform(*config.cut_share), side % 2
        whole = xyxy_px[start + 2] - xyxy_px[start]
        border[side] = xyxy_px[side] + share * whole * (1 if side < 2 else -1)
    return border


def flip_horizontally(image: Image, xyxy_px: Array, width: int) -> tuple[Image, Array]:
    """Mirror the left ``width`` columns of a canvas, and boxes (N, 4) with them."""
    mirrored = image.copy()
    mirrored[:, :width] = image[:, :width][:, ::-1]
    boxes = xyxy_px.copy()
    boxes[:, [0, 2]] = (width - 1) - xyxy_px[:, [2, 0]]
    return mirrored, boxes


def rescale(
    image: Image, xyxy_px: Array, size: tuple[int, int], rng: np.random.Generator, config: AugmentConfig
) -> tuple[Image, Array]:
    """An image and its boxes, scaled and shifted, on a canvas of ``size`` (width, height): grey around, boxes not clipped.

    The image's centre goes to the canvas's, up to the shift.
    """
    scale = _factor(config.scale, rng)
    canvas, middle = np.array(size, dtype=np.float64), np.array(image.shape[1::-1]) / 2
    shift = rng.uniform(-config.shift, config.shift, 2) * canvas
    return _moved(image, xyxy_px, size, scale, canvas / 2 + shift - scale * middle)


def place(image: Image, xyxy_px: Array, size: tuple[int, int], rng: np.random.Generator) -> tuple[Image, Array]:
    """An image and its boxes on a canvas of ``size`` (width, height), not scaled: in its corner, or a random part."""
    if image.shape[1::-1] == size:
        return image, xyxy_px
    spare = np.maximum(np.array(image.shape[1::-1]) - size, 0)
    return _moved(image, xyxy_px, size, 1.0, -rng.integers(0, spare, endpoint=True).astype(np.float64))


def shrink(
    image: Image, xyxy_px: Array, size: tuple[int, int], rng: np.random.Generator, config: AugmentConfig
) -> tuple[Image, Array]:
    """A random part of an image and its boxes, made smaller, on a canvas of ``size`` (width, height): grey only where the
    whole image does not fill it."""
    scale = _factor(config.tile_scale, rng)
    spare = np.array(size) - scale * np.array(image.shape[1::-1])
    return _moved(image, xyxy_px, size, scale, rng.uniform(np.minimum(spare, 0.0), np.maximum(spare, 0.0)))


def _factor(limits: tuple[float, float], rng: np.random.Generator) -> float:
    """A factor between limits, drawn evenly in its logarithm."""
    return float(np.exp(rng.uniform(*np.log(limits))))


def _moved(image: Image, xyxy_px: Array, size: tuple[int, int], scale: float, offset: Array) -> tuple[Image, Array]:
    M = np.array([[scale, 0.0, offset[0]], [0.0, scale, offset[1]]])
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    warped = cv2.warpAffine(image, M, size, flags=interpolation, borderValue=(PAD_VALUE,) * 3)
    return np.asarray(warped, dtype=np.uint8), xyxy_px * scale + np.tile(offset, 2)
