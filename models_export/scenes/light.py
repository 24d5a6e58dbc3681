"""Light and weather of a scene, drawn from a seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models_export.scenes.mesh import Array

OUTDOOR_WEATHERS = ("day", "overcast", "dusk", "night", "fog", "rain", "night-rain")
INDOOR_WEATHERS = ("indoor", "dim")
WEATHERS = (*OUTDOOR_WEATHERS, *INDOOR_WEATHERS)
CLEAR_WEATHERS = ("day", "overcast", "indoor")
"""Bright and dry: what is left for the scenarios easy and moderate."""
_OUTDOOR_SHARES = (0.40, 0.16, 0.10, 0.12, 0.08, 0.08, 0.06)

_SUNNY = np.array([1.0, 0.95, 0.86])
_LOW_SUN = np.array([1.0, 0.68, 0.42])
_PALE = np.array([0.75, 0.82, 0.90])
_LAMP_COLORS = (np.array([1.0, 0.62, 0.28]), np.array([1.0, 0.88, 0.70]), np.array([0.86, 0.94, 1.0]))
"""Sodium, warm and cold LED."""


@dataclass(frozen=True, eq=False)
class Light:
    """The light of one scene; colours (3,) are linear RGB."""

    weather: str
    """One of ``WEATHERS``."""
    sun_direction: Array
    """Unit vector (3,) towards the sun, or the moon."""
    sun: Array
    zenith: Array
    horizon: Array
    """Also the colour of haze and fog."""
    bounce: Array
    """Light that comes up from the ground."""
    haze_per_m: float
    """Extinction: of a surface's light exp(-haze * distance) arrives."""
    cloudiness: float
    """0 clear .. 1 covered."""
    lamps_on: bool
    """Whether vehicles drive with their lamps on."""
    lamp_rgb: Array
    """What street or ceiling lamps throw on the ground below them; zero when they are off."""
    wet: float
    """0 dry road .. 1 wet with puddles."""
    rain: float
    """Strength of the streaks in the air, 0..1."""

    @property
    def dark(self) -> bool:
        """Whether lamps matter to what is seen."""
        return self.weather in ("dusk", "night", "night-rain", "dim")

    @property
    def brightness(self) -> float:
        """What a camera's exposure goes by: mean light on level ground and around."""
        direct = float(self.sun.mean()) * max(float(self.sun_direction[2]), 0.05)
        return direct + 0.6 * float((self.zenith + self.horizon).mean()) + 0.7 * float(self.lamp_rgb.mean())


def sample_light(rng: np.random.Generator, weather: str | None = None, *, indoor: bool = False) -> Light:
    """A random light; ``weather`` is one of ``WEATHERS``, drawn when None."""
    if weather is None:
        weather = str(
            rng.choice(INDOOR_WEATHERS, p=[0.75, 0.25]) if indoor else rng.choice(OUTDOOR_WEATHERS, p=_OUTDOOR_SHARES)
        )
    if weather in INDOOR_WEATHERS:
        return _indoor(rng, weather)
    if weather in ("night", "night-rain"):
        return _night(rng, weather)
    return _daylight(rng, weather)


def _direction(rng: np.random.Generator, low_deg: float, high_deg: float) -> Array:
    elevation, azimuth = np.deg2rad(rng.uniform(low_deg, high_deg)), rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])


def _daylight(rng: np.random.Generator, weather: str) -> Light:
    gloomy = weather in ("overcast", "fog", "rain")
    direction = _direction(rng, *{"day": (18, 65), "dusk": (5, 13)}.get(weather, (35, 65)))
    strength = {"day": rng.uniform(2.2, 3.2), "overcast": rng.uniform(0.1, 0.5), "dusk": rng.uniform(0.3, 1.0)}.get(
        weather, 0.08
    )
    warmth = {"day": _SUNNY, "dusk": _LOW_SUN}.get(weather, np.ones(3))
    cloud = 1.0 if gloomy else rng.uniform(0, 1)
    blue = np.array([0.22, 0.42, 0.85]) * (1 - cloud) + np.array([0.62, 0.66, 0.72]) * cloud
    level = {"day": 0.85, "dusk": 0.28, "rain": rng.uniform(0.35, 0.7)}.get(weather, rng.uniform(0.7, 1.1))
    horizon = {"day": _PALE, "dusk": np.array([0.50, 0.40, 0.36]), "rain": level * _PALE}.get(weather, 0.95 * _PALE)
    horizon = horizon * rng.uniform(0.85, 1.05)
    zenith = blue * level
    haze = float(rng.uniform(0.0002, 0.0022))
    if weather == "fog":
        grey = horizon.mean() * np.array([0.98, 1.0, 1.02])
        horizon, zenith, haze = grey, grey * 1.05, float(np.exp(rng.uniform(np.log(0.011), np.log(0.045))))
    elif weather == "rain":
        haze = float(rng.uniform(0.003, 0.011))
    bounce = 0.16 * (zenith + horizon + 0.3 * strength * max(direction[2], 0) * warmth)
    lit = weather in ("dusk", "fog") or rng.random() < (0.7 if weather == "rain" else 0.12)
    lamps = _lamp_color(rng) * rng.uniform(0.15, 0.45) if weather == "dusk" and rng.random() < 0.7 else np.zeros(3)
    wet, rain = (float(rng.uniform(0.5, 1.0)), float(rng.uniform(0.35, 1.0))) if weather == "rain" else (0.0, 0.0)
    cloudiness = 1.0 if gloomy else 0.3
    return Light(weather, direction, strength * warmth, zenith, horizon, bounce, haze, cloudiness, lit, lamps, wet, rain)


def _night(rng: np.random.Generator, weather: str) -> Light:
    rainy = weather == "night-rain"
    moon = rng.uniform(0.0, 0.03) * np.array([0.8, 0.9, 1.0])
    glow = rng.uniform(0.5, 1.3)
    horizon = glow * np.array([0.050, 0.042, 0.040])
    zenith = glow * np.array([0.010, 0.013, 0.024])
    bounce = 0.5 * (horizon + zenith) * 0.5
    haze = float(rng.uniform(0.003, 0.010) if rainy else rng.uniform(0.0003, 0.004))
    lamps = _lamp_color(rng) * np.exp(rng.uniform(np.log(0.08), np.log(0.45)))
    wet, rain = (float(rng.uniform(0.5, 1.0)), float(rng.uniform(0.35, 1.0))) if rainy else (0.0, 0.0)
    return Light(weather, _direction(rng, 30, 60), moon, zenith, horizon, bounce, haze, 1.0, True, lamps, wet, rain)


def _indoor(rng: np.random.Generator, weather: str) -> Light:
    level = rng.uniform(0.25, 0.5) if weather == "indoor" else rng.uniform(0.04, 0.10)
    grey = level * np.exp(rng.normal(0, 0.05, 3))
    lamps = _LAMP_COLORS[int(rng.integers(1, 3))] * level * rng.uniform(0.8, 1.6)
    lit = bool(weather == "dim" or rng.random() < 0.7)
    return Light(
        weather,
        np.array([0.1, 0.0, np.sqrt(0.99)]),
        np.zeros(3),
        grey,
        grey * 0.8,
        0.7 * grey,
        0.0005,
        1.0,
        lit,
        lamps,
        0.0,
        0.0,
    )


def _lamp_color(rng: np.random.Generator) -> Array:
    return np.asarray(_LAMP_COLORS[int(rng.integers(3))])
