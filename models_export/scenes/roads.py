"""The worlds by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from models_export.scenes.curve import curve
from models_export.scenes.garage import garage
from models_export.scenes.intersection import intersection, t_junction
from models_export.scenes.layout import RoadWorld
from models_export.scenes.straight import straight

WORLD_BUILDERS: Mapping[str, Callable[[np.random.Generator], RoadWorld]] = {
    "intersection": intersection,
    "straight": straight,
    "t-junction": t_junction,
    "curve": curve,
    "garage": garage,
}
WORLDS = tuple(WORLD_BUILDERS)
"""In the order that seeds refer to: new worlds go to the end."""


def build_world(kind: str, rng: np.random.Generator) -> RoadWorld:
    """The layout of a world of a kind (one of ``WORLDS``), drawn from ``rng``."""
    return WORLD_BUILDERS[kind](rng)
