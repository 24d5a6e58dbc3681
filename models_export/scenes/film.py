"""What one camera makes of the light: exposure, white balance, lens faults, rain before the lens, sensor noise, JPEG."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from models_export.scenes.light import Light
from models_export.scenes.mesh import Array

QUALITIES = (30, 95)
"""JPEG qualities that are drawn."""
_NOISE_SCALE = 32.0
_SPARE_PX = 256
_STREAK_LAYERS = 2


@dataclass(frozen=True, eq=False)
class Film:
    """One camera's picture making."""

    gain: Array
    """Exposure and white balance (3,)."""
    vignetting: float
    """Part of the light that is missing in the picture's corners."""
    saturation: float
    noise: float
    """Standard deviation of the sensor noise, 8-bit levels."""
    color_noise: float
    """How much of it differs between the colours, 0..1."""
    blur_px: float
    """Standard deviation of the lens blur."""
    sharpening: float
    """What the camera adds against blur, 0..1."""
    bloom: float
    """Light that bright lamps scatter in the lens, 0..1."""
    rain: float
    """Strength of rain streaks, 0..1."""
    jpeg_quality: int


def sample_film(rng: np.random.Generator, light: Light, quality: int | None = None) -> Film:
    """How one camera renders the light. Its JPEG quality is drawn from ``QUALITIES`` unless given."""
    exposure = 1.15 / (light.brightness**0.85 + 0.05) * np.exp(rng.normal(0, 0.25))
    tint = np.exp(rng.normal(0, 0.042, 3))
    night = light.weather in ("night", "night-rain", "dim")
    # Cameras do not make day of night, though they try.
    exposure *= rng.uniform(0.35, 0.9) if night else 1.0
    noise = np.exp(rng.uniform(np.log(0.8), np.log(4.5))) * (2.0 if night else 1.0)
    # Most cameras are sharp; some are out of focus or have drops on the glass.
    blur = rng.uniform(0.3, 0.8) if rng.random() < 0.8 else rng.uniform(0.8, 1.7)
    return Film(
        exposure * tint / tint.mean(),
        float(rng.uniform(0.0, 0.35)),
        float(rng.uniform(0.65, 1.2)),
        float(noise),
        float(rng.uniform(0.2, 0.9)),
        float(blur),
        float(rng.uniform(0.3, 1.0) if rng.random() < 0.4 else 0.0),
        float(rng.uniform(0.15, 0.5) if light.dark else 0.0),
        light.rain,
        int(rng.integers(QUALITIES[0], QUALITIES[1] + 1)) if quality is None else quality,
    )


def develop(image: NDArray[np.uint8], film: Film, seed: tuple[int, ...]) -> NDArray[np.uint8]:
    """Lens, rain and sensor on an image (H, W, 3) RGB."""
    rng = np.random.default_rng(seed)
    picture = image
    if film.rain > 0:
        picture = _with_rain(picture, film.rain, rng)
    if film.bloom > 0:
        picture = _with_bloom(picture, film.bloom)
    picture = cv2.GaussianBlur(picture, (0, 0) if film.blur_px > 0.8 else (3, 3), film.blur_px)
    if film.sharpening > 0:
        soft = cv2.GaussianBlur(picture, (5, 5), 1.0)
        picture = cv2.addWeighted(picture, 1 + film.sharpening, soft, -film.sharpening, 0.0)
    height, width = image.shape[:2]
    grain, grey = _noise(width, height)
    rows, columns = rng.integers(0, _SPARE_PX, 2)
    cut = np.s_[rows : rows + height, columns : columns + width]
    strength = film.noise / _NOISE_SCALE
    noisy = cv2.addWeighted(
        grain[cut], strength * film.color_noise, grey[cut], strength * np.sqrt(1 - film.color_noise**2), 0.0
    )
    return cv2.add(picture, noisy, dtype=cv2.CV_8U).astype(np.uint8, copy=False)


def encode(picture: NDArray[np.uint8], film: Film) -> bytes:
    """A developed picture (H, W, 3) RGB as JPEG."""
    picture = np.ascontiguousarray(picture)
    return bytes(simplejpeg.encode_jpeg(picture, quality=film.jpeg_quality, colorspace="RGB", colorsubsampling="420"))


def _with_bloom(picture: NDArray[np.uint8], strength: float) -> NDArray[np.uint8]:
    """Adds the scattered light of all that is nearly white."""
    small = cv2.resize(picture, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    bright = cv2.GaussianBlur(cv2.subtract(small, (190, 190, 190, 0)), (0, 0), 5.0)
    wide = cv2.resize(bright, picture.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.addWeighted(picture, 1.0, wide, 2.0 * strength, 0.0), dtype=np.uint8)


def _with_rain(picture: NDArray[np.uint8], strength: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Streaks of falling drops, as bright as what lies behind the camera's view on average; some contrast is lost."""
    height, width = picture.shape[:2]
    tone = float(picture[::8, ::8].mean())
    veil = cv2.convertScaleAbs(picture, alpha=1 - 0.10 * strength, beta=0.10 * strength * tone)
    for layer in range(_STREAK_LAYERS):
        field = _streaks(width, height, layer)
        rows, columns = rng.integers(0, _SPARE_PX, 2)
        cut = field[rows : rows + height, columns : columns + width]
        light = (0.35 + 0.65 * strength) * min(1.0, (tone + 40) / 150)
        veil = cv2.addWeighted(veil, 1.0, cut, light, 0.0)
    return np.asarray(veil, dtype=np.uint8)


@lru_cache(maxsize=8)
def _noise(width: int, height: int) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
    """Noise of three independent colours, and of one brightness; both (H + spare, W + spare, 3)."""
    rng = np.random.default_rng(7)
    shape = (height + _SPARE_PX, width + _SPARE_PX)
    color = rng.normal(0, _NOISE_SCALE, (*shape, 3)).astype(np.int16)
    grey = np.repeat(rng.normal(0, _NOISE_SCALE, (*shape, 1)).astype(np.int16), 3, axis=2)
    return color, grey


@lru_cache(maxsize=8)
def _streaks(width: int, height: int, layer: int) -> NDArray[np.uint8]:
    """Rain (H + spare, W + spare, 3): near drops are few and long, far ones many and short."""
    rng = np.random.default_rng([11, layer])
    field = np.zeros((height + _SPARE_PX, width + _SPARE_PX), np.uint8)
    count, length, bright = ((260, 44, 46), (2600, 13, 34))[layer]
    count = count * field.size // 1_000_000
    x, y = rng.uniform(0, field.shape[1], count), rng.uniform(-length, field.shape[0], count)
    slant = 0.10 + rng.normal(0, 0.02, count)
    reach = length * rng.uniform(0.5, 1.4, count)
    for k in range(count):
        end = (int(x[k] + slant[k] * reach[k]), int(y[k] + reach[k]))
        cv2.line(field, (int(x[k]), int(y[k])), end, int(bright * rng.uniform(0.3, 1.0)), 1 if layer else 2, cv2.LINE_AA)
    return np.repeat(cv2.GaussianBlur(field, (3, 3), 0.8)[..., None], 3, axis=2).astype(np.uint8)
