"""How hard a scene is, and which of its vehicles are no harder than that: the paper's easy, moderate and hard."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models_export.data.dataset import Scene, SceneTruth
from models_export.scenes.scenario import SCENARIOS, vehicle_difficulty
from service.errors import InputError

UNGRADED = "ungraded"
"""Difficulty of a scene whose ``scene.json`` names no ``scenario``."""


@dataclass(frozen=True)
class Grade:
    """A scene's difficulty, and what the difficulty of its vehicles follows from."""

    difficulty: str
    weather: str | None
    axes_rad: Sequence[float]
    """Directions of the lanes in the world, radians; empty where the scene does not say."""

    def fits(self, truth: SceneTruth) -> NDArray[np.bool_]:
        """Vehicles (N,) that are no harder than their scene: a hidden car in an easy scene asks too much of it.

        All of them in a scene that names no scenario, no weather or no lanes.
        """
        if self.difficulty == UNGRADED or self.weather is None or not len(self.axes_rad):
            return np.ones(len(truth), dtype=bool)
        allowed = SCENARIOS[: SCENARIOS.index(self.difficulty) + 1]
        return np.isin(vehicle_difficulty(truth, self.weather, self.axes_rad), allowed)


def grade_of(scene: Scene) -> Grade:
    """The grade of a scene from ``scenario``, ``condition`` and ``axes_rad`` in its ``scene.json``. Raises InputError."""
    path = scene.path / "scene.json"
    document = json.loads(path.read_text("utf-8"))
    scenario, weather = document.get("scenario"), document.get("condition")
    if scenario not in (None, *SCENARIOS):
        raise InputError(
            f"there is no scenario {scenario!r}.", field=str(path), remedy=f"Use one of {', '.join(SCENARIOS)}, or none."
        )
    axes = tuple(float(axis) for axis in document.get("axes_rad", ()))
    return Grade(scenario or UNGRADED, None if weather is None else str(weather), axes)
