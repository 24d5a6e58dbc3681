"""The road worlds by name."""

from __future__ import annotations

import numpy as np

from models_export.scenes.intersection import intersection
from models_export.scenes.layout import RoadWorld
from models_export.scenes.straight import straight

WORLDS = ("intersection", "straight")
"""In the order that seeds refer to."""


def build_world(kind: str, rng: np.random.Generator) -> RoadWorld:
    """The layout of a world of a kind (one of ``WORLDS``), drawn from ``rng``."""
    return {"intersection": intersection, "straight": straight}[kind](rng)
