"""How hard a scene or one vehicle is: the paper's easy, moderate and hard. The rule stands in docs/scenes.md."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models_export.data.dataset import SceneTruth
from models_export.scenes.light import CLEAR_WEATHERS
from service.errors import InputError
from service.geometry.transforms import Array

SCENARIOS = ("easy", "moderate", "hard")
ROTATION_THRESHOLD_RAD = float(np.deg2rad(10.0))
"""The paper's r_th, which it does not give: lane keeping stays below 3 degrees, a turn passes 10 within a car's length."""
HIDDEN_BELOW = 0.5
"""A vehicle that no camera sees to this fraction is occluded; KITTI calls it largely occluded."""
TURNING_WORLDS = ("intersection", "t-junction", "curve", "garage")
STRAIGHT_WORLDS = ("intersection", "straight", "t-junction", "garage")
"""Worlds in which all vehicles can go straight on."""


def rotation_from_axes(yaw_rad: ArrayLike, axes_rad: Sequence[float]) -> Array:
    """|rotation| (N,) of headings (N,) from the nearest lane direction, radians in 0..pi/2; each axis stands for both ways."""
    yaw = np.asarray(yaw_rad, dtype=np.float64).reshape(-1, 1)
    apart = (yaw - np.asarray(axes_rad, dtype=np.float64) + np.pi / 2) % np.pi - np.pi / 2
    return np.abs(apart).min(axis=1)


def is_hard_weather(weather: str) -> bool:
    """Whether a scene is dark, foggy or rainy; ``clear`` is what captures from CARLA say of a fine day."""
    return weather not in (*CLEAR_WEATHERS, "clear")


def vehicle_difficulty(truth: SceneTruth, weather: str, axes_rad: Sequence[float]) -> NDArray[np.str_]:
    """One of ``SCENARIOS`` per vehicle (N,), or ``unseen`` for those that no camera sees.

    hard: the scene is dark, foggy or rainy, or no camera sees at least ``HIDDEN_BELOW`` of it. moderate: otherwise, when it
    is rotated by ``ROTATION_THRESHOLD_RAD`` or more from every lane direction. easy: the rest.
    """
    best = truth.visible.max(axis=1, initial=0.0)
    rotated = rotation_from_axes(truth.yaw, axes_rad) >= ROTATION_THRESHOLD_RAD
    level = np.where(rotated, "moderate", "easy")
    level = np.where((best < HIDDEN_BELOW) | is_hard_weather(weather), "hard", level)
    return np.where(best > 0, level, "unseen")


def check_scenario(scenario: str | None, world: str, weather: str | None) -> None:
    """Raises InputError when a world or weather cannot make a scenario."""
    if scenario is None:
        return
    if scenario not in SCENARIOS:
        raise InputError(f"there is no scenario {scenario!r}.", field="scenario", remedy=f"Use one of {', '.join(SCENARIOS)}.")
    if scenario == "easy" and world not in STRAIGHT_WORLDS:
        raise InputError(f"in the world {world} every vehicle turns.", field="scenario", remedy="Use moderate or hard there.")
    if scenario == "moderate" and world not in TURNING_WORLDS:
        raise InputError(f"in the world {world} no vehicle turns.", field="scenario", remedy="Use easy or hard there.")
    if scenario != "hard" and weather is not None and is_hard_weather(weather):
        raise InputError(f"the weather {weather} is always hard.", field="weather", remedy="Use the scenario hard with it.")
