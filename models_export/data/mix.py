"""How often each data set is drawn: a few hundred real frames beside many thousands of simulated ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.errors import InputError
from service.geometry.transforms import Array


@dataclass(frozen=True)
class MixConfig:
    """Shares of the draws by the first part of a sample's source; those of the data sets present are scaled to sum to 1."""

    shares: tuple[tuple[str, float], ...] = (
        ("simulated", 0.48),
        # One camera filmed all of the gantry's frames: at most 40 % of the roadside share.
        ("rf100_vehicles_tollroad_id", 0.07),
        ("atl_v2_highway_mix", 0.12),
        ("farzad_overpass_vehicle_boxonly", 0.08),
        ("carla2d", 0.13),
        ("pandaset", 0.08),
        ("traffic_videos", 0.04),
    )


def draw_odds(sources: Sequence[str], config: MixConfig) -> Array:
    """Probabilities (N,) of drawing each of N samples: a data set's share, the same for each of its samples.

    Raises InputError for a source whose data set has no share.
    """
    names = [source.split("/")[0] for source in sources]
    shares = dict(config.shares)
    if strange := sorted(set(names) - set(shares)):
        raise InputError(f"no share for {', '.join(strange)}.", field="shares", remedy="Give each data set a share.")
    counts = {name: names.count(name) for name in set(names)}
    odds = np.array([shares[name] / counts[name] for name in names])
    return odds / odds.sum()


def draw_by_odds(rng: np.random.Generator, odds: Array, size: int) -> NDArray[np.int64]:
    """Indices (size,) drawn with replacement by probabilities (N,)."""
    return rng.choice(len(odds), size=size, p=odds)
