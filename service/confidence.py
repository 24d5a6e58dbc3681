"""How sure a fused box is: the probability that it covers its vehicle, from what its cameras say and what it knows of itself.

A detector's score says that something is there. Whether the box fits it, the covariance says; and cameras agree on false
alarms more often than chance, so that their scores do not multiply. Each piece of evidence moves the log-odds by a weight,
fitted by logistic regression on validation scenes (docs: fusion).
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

from service.geometry.boxes import Boxes
from service.geometry.transforms import Array
from service.odds import log_odds, probability

MAX_LOG_ODDS = 20.0
"""Scores of 0 and 1 count as this much."""
LEAST_SCORE = float(probability(np.array(-MAX_LOG_ODDS)))
"""The same as a score."""
_LEAST_DOUBT = 1e-6


@dataclass(frozen=True)
class Confidence:
    """Weights of the evidence; as they stand a box is as sure as its cameras are on average."""

    offset: float = 0.0
    """Log-odds without any evidence."""
    score: float = 1.0
    """A unit of the mean log-odds of the cameras' scores."""
    doubt: float = 0.0
    """The logarithm of :func:`footprint_doubt`."""
    several: float = 0.0
    """More than one camera reports the vehicle: then the covariance takes their errors for more independent than they are."""
    silent: float = 0.0
    """A camera that has the vehicle in full view and does not report it. Not sure to be telling: another may hide it."""

    def of(self, evidence: Array) -> Array:
        """Probabilities (M,) from :func:`evidence` (M, 4)."""
        offset, *weights = astuple(self)
        return probability(offset + evidence @ np.array(weights))


def evidence(boxes: Boxes, cameras: NDArray[np.int64], silences: Array) -> Array:
    """What is known of M fused boxes (M, 4), in the order of the weights.

    boxes: their scores are the cameras' mean, :func:`mean_score`. cameras: (M,) how many report each. silences: (M,) how many
    should and do not.
    """
    doubt = np.log(np.maximum(footprint_doubt(boxes), _LEAST_DOUBT))
    return np.stack([log_odds(boxes.score, LEAST_SCORE), doubt, cameras > 1, silences], 1)


def footprint_doubt(boxes: Boxes) -> Array:
    """(M,) standard deviation of the centre along the length over the length, plus that across it over the width."""
    heading = np.stack([np.cos(boxes.yaw), np.sin(boxes.yaw)], 1)
    across = np.stack([-heading[:, 1], heading[:, 0]], 1)
    place = boxes.covariance[:, :2, :2]
    variances = [((place @ axis[..., None])[..., 0] * axis).sum(1) for axis in (heading, across)]
    doubt: Array = sum(np.sqrt(variance) / boxes.dims_lwh[:, side] for side, variance in enumerate(variances))
    return doubt


def mean_score(score: Array, row: NDArray[np.int64], rows: int) -> Array:
    """Scores (M,) of vehicles from their cameras' (K,), ``row`` (K,) saying whose: the mean of the log-odds."""
    total = np.bincount(row, log_odds(score, LEAST_SCORE), rows)
    return probability(total / np.bincount(row, minlength=rows))
