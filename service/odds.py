"""Probabilities and their log-odds."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from service.geometry.transforms import Array, between


def log_odds(probability: ArrayLike, least: float) -> Array:
    """ln(p / (1 - p)) of probabilities, which count as ``least`` to 1 - ``least``."""
    bounded = between(np.asarray(probability, dtype=np.float64), least, 1.0 - least)
    odds: Array = np.log(bounded / (1.0 - bounded))
    return odds


def probability(log_odds: Array) -> Array:
    """1 / (1 + e^-x)."""
    return np.asarray(1.0 / (1.0 + np.exp(-between(log_odds, -500.0, 500.0))))
