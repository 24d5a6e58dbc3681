"""Weather presets for CARLA: what differs from a cloudless, dry day, by the names of ``carla.WeatherParameters``."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType


class Weather(StrEnum):
    """Names of the presets, also what ``scene.json`` gives as condition."""

    CLEAR = "clear"
    FOG = "fog"
    RAIN = "rain"
    NIGHT = "night"


_DAY = {
    "cloudiness": 10.0,
    "precipitation": 0.0,
    "precipitation_deposits": 0.0,
    "wind_intensity": 10.0,
    "sun_azimuth_angle": 40.0,
    "sun_altitude_angle": 55.0,
    "fog_density": 2.0,
    "fog_distance": 0.75,
    "fog_falloff": 0.1,
    "wetness": 0.0,
    "scattering_intensity": 1.0,
    "mie_scattering_scale": 0.03,
}

PRESETS: Mapping[Weather, Mapping[str, float]] = MappingProxyType(
    {
        Weather.CLEAR: _DAY,
        Weather.FOG: {
            **_DAY,
            "cloudiness": 60.0,
            "sun_altitude_angle": 30.0,
            "fog_density": 65.0,
            "fog_distance": 5.0,
            "fog_falloff": 0.5,
            "wetness": 20.0,
        },
        Weather.RAIN: {
            **_DAY,
            "cloudiness": 90.0,
            "precipitation": 80.0,
            "precipitation_deposits": 70.0,
            "wind_intensity": 60.0,
            "sun_altitude_angle": 35.0,
            "fog_density": 10.0,
            "wetness": 90.0,
        },
        Weather.NIGHT: {**_DAY, "cloudiness": 20.0, "sun_altitude_angle": -60.0, "fog_density": 5.0},
    }
)
"""Percentages, except angles (degrees), fog_distance (metres) and the scattering scales."""
