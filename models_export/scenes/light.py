"""Daylight and what the camera makes of it: sun, sky, haze, exposure, noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models_export.scenes.mesh import Array

CONDITIONS = ("day", "overcast", "dusk")


@dataclass(frozen=True, eq=False)
class Light:
    """The light of one scene; colours (3,) are linear RGB."""

    condition: str
    sun_direction: Array
    """Unit vector (3,) towards the sun."""
    sun: Array
    zenith: Array
    horizon: Array
    bounce: Array
    """Light that comes up from the ground."""
    haze_per_m: float
    lamps_on: bool


@dataclass(frozen=True, eq=False)
class Film:
    """One camera's picture making."""

    gain: Array
    """Exposure and white balance (3,)."""
    noise: float
    """Standard deviation of the sensor noise, 8-bit levels."""
    blur_px: float
    """Standard deviation of the lens blur."""
    jpeg_quality: int


def sample_light(rng: np.random.Generator, condition: str | None = None) -> Light:
    """A random light; ``condition`` is one of ``CONDITIONS``."""
    condition = condition or str(rng.choice(CONDITIONS, p=[0.6, 0.25, 0.15]))
    low, high = {"day": (18, 65), "overcast": (35, 65), "dusk": (5, 13)}[condition]
    elevation, azimuth = np.deg2rad(rng.uniform(low, high)), rng.uniform(0, 2 * np.pi)
    direction = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    strength = {"day": rng.uniform(2.2, 3.2), "overcast": rng.uniform(0.1, 0.5), "dusk": rng.uniform(0.5, 1.1)}[condition]
    warmth = {"day": np.array([1.0, 0.95, 0.86]), "overcast": np.ones(3), "dusk": np.array([1.0, 0.68, 0.42])}[condition]
    cloud = rng.uniform(0, 1) if condition != "overcast" else 1.0
    blue = np.array([0.22, 0.42, 0.85]) * (1 - cloud) + np.array([0.62, 0.66, 0.72]) * cloud
    zenith = blue * {"day": 0.85, "overcast": rng.uniform(0.7, 1.1), "dusk": 0.28}[condition]
    pale = np.array([0.75, 0.82, 0.90])
    horizon = {"day": pale, "overcast": 0.95 * pale, "dusk": np.array([0.50, 0.40, 0.36])}[condition] * rng.uniform(0.85, 1.05)
    haze = float(rng.uniform(0.0002, 0.0022))
    bounce = 0.16 * (zenith + horizon + 0.3 * strength * max(direction[2], 0) * warmth)
    return Light(
        condition, direction, strength * warmth, zenith, horizon, bounce, haze, condition == "dusk" or rng.random() < 0.12
    )


def sample_film(rng: np.random.Generator, light: Light, quality: int | None = None) -> Film:
    """How one camera renders the light: exposure, white balance, noise, blur and JPEG quality (75..95 unless given)."""
    flat = light.sun.mean() * max(light.sun_direction[2], 0.05) + 0.6 * (light.zenith + light.horizon).mean()
    exposure = 1.15 / (flat**0.85 + 0.05) * np.exp(rng.normal(0, 0.2))
    tint = np.exp(rng.normal(0, 0.035, 3))
    return Film(
        exposure * tint / tint.mean(),
        float(rng.uniform(0.8, 3.5)),
        float(rng.uniform(0.35, 0.75)),
        int(rng.integers(75, 96)) if quality is None else quality,
    )
