"""How far off the found vehicles are: recall and errors of the centre, by axis (the paper's eq. 14) and by distance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.centres import match_centres
from benchmarks.scored_sets import Found, Wanted
from service.geometry.transforms import Array, wrap_angle

MATCH_M = 2.0
"""A box belongs to a vehicle whose centre is no farther away than this."""
DISTANCE_EDGES_M = (0.0, 10.0, 20.0, 30.0, 40.0)
PERCENTILES = (50, 90, 99)


@dataclass(frozen=True, eq=False)
class PositionErrors:
    """Vehicles that count and the boxes on them, over many frame sets."""

    distance_m: Array
    """(V,) of each vehicle that counts, to the nearest camera that shows it."""
    found: NDArray[np.bool_]
    """(V,) whether a box lies on it."""
    offset: Array
    """(V, 3) box centre minus true centre, world x y z, metres; NaN where not found."""
    turn: Array
    """(V,) box yaw minus true yaw in [-pi, pi), radians; NaN where not found."""
    boxes: int
    """Boxes that count: those on such a vehicle, and the false ones."""
    false: int
    """Boxes in view on no vehicle at all."""

    def summary(self) -> dict[str, Any]:
        """Figures with their units in their names; None where there is nothing to measure."""
        return {
            "vehicles": len(self.found),
            "boxes": self.boxes,
            "recall_percent": _percent(self.found.sum(), len(self.found)),
            "precision_percent": _percent(self.boxes - self.false, self.boxes),
            "rmse_m": dict(zip("xyz", self._rmse(), strict=True)),
            "error_m": self._percentiles(np.ones(len(self.found), dtype=bool)),
            "yaw_error_median_deg": self._yaw_error(),
            "by_distance": [self._band(a, b) for a, b in pairwise(DISTANCE_EDGES_M)],
        }

    def _rmse(self) -> list[float | None]:
        if not self.found.any():
            return [None] * 3
        return [_rounded(v) for v in np.sqrt((self.offset[self.found] ** 2).mean(0))]

    def _yaw_error(self) -> float | None:
        return _rounded(np.degrees(np.median(np.abs(self.turn[self.found])))) if self.found.any() else None

    def _percentiles(self, rows: NDArray[np.bool_]) -> dict[str, float | None]:
        distance = np.linalg.norm(self.offset[rows & self.found], axis=1)
        return {f"p{p}": _rounded(np.percentile(distance, p)) if len(distance) else None for p in PERCENTILES}

    def _band(self, low: float, high: float) -> dict[str, Any]:
        rows = (self.distance_m > low) & (self.distance_m <= high)
        recall = _percent(self.found[rows].sum(), rows.sum())
        return {"from_m": low, "to_m": high, "vehicles": int(rows.sum()), "recall_percent": recall} | self._percentiles(rows)


def position_errors(found: Sequence[Found], wanted: Sequence[Wanted]) -> PositionErrors:
    """Match centres within ``MATCH_M`` one to one in every frame set; ``found`` and ``wanted`` in the same order.

    All vehicles can be matched, so that a box on one that is ignored is not false.
    """
    distance, hit, offset, turn = [np.zeros(0)], [np.zeros(0, bool)], [np.zeros((0, 3))], [np.zeros(0)]
    boxes = false = 0
    for f, w in zip(found, wanted, strict=True):
        rows, columns, _ = match_centres(f.states[:, :3], w.states[:, :3], MATCH_M)
        difference = np.full((len(w), 4), np.nan)
        difference[columns, :3] = f.states[rows, :3] - w.states[columns, :3]
        difference[columns, 3] = wrap_angle(f.states[rows, 6] - w.states[columns, 6])
        free = np.ones(len(f), dtype=bool)
        free[rows] = False
        false += int((free & f.in_view).sum())
        boxes += int((free & f.in_view).sum() + w.counted[columns].sum())
        distance.append(w.distance_m[w.counted])
        hit.append(np.isfinite(difference[w.counted, 0]))
        offset.append(difference[w.counted, :3])
        turn.append(difference[w.counted, 3])
    return PositionErrors(*(np.concatenate(parts) for parts in (distance, hit, offset, turn)), boxes, false)


def _percent(part: float, whole: float) -> float | None:
    return round(100.0 * float(part) / float(whole), 2) if whole else None


def _rounded(value: float) -> float:
    return round(float(value), 4)
