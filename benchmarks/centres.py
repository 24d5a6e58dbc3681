"""Fused boxes against true vehicles by the distance of their centres: recall, false boxes, error percentiles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from service.geometry.transforms import Array
from service.site import Site

MATCH_M = 1.0
"""A box whose centre is farther from every vehicle's is false, and a vehicle without a nearer box is missed."""
RANGE_M = 40.0
"""Vehicles and boxes are counted up to this distance from the cameras that vouch for them."""
MIN_VISIBLE = 0.5
MIN_CAMERAS = 2


def near_cameras(site: Site, center: Array) -> NDArray[np.int64]:
    """How many cameras (N,) are within ``RANGE_M`` of each centre (N, 3)."""
    return _within_range(site, center).sum(1)


def countable(site: Site, center: Array, visible: Array) -> NDArray[np.bool_]:
    """Vehicles (N,) that at least two cameras see more than half of, each from within ``RANGE_M``. visible: (N, C)."""
    return ((visible > MIN_VISIBLE) & _within_range(site, center)).sum(1) >= MIN_CAMERAS


def _within_range(site: Site, center: Array) -> NDArray[np.bool_]:
    positions = np.array([camera.position_m for camera in site.cameras]).reshape(-1, 3)
    return np.linalg.norm(center[:, None] - positions[None], axis=-1) <= RANGE_M


def match_centres(ours: Array, truth: Array, limit_m: float = MATCH_M) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """One-to-one matches of centres (M, 3) and (N, 3) nearer than a limit, most matches first, then least distance.

    Returns rows of ours, rows of the truth, and their distances.
    """
    distance = np.linalg.norm(ours[:, None] - truth[None], axis=-1)
    # A pair beyond the limit costs more than all pairs within it together.
    beyond = (min(len(ours), len(truth)) + 1) * limit_m
    rows, columns = linear_sum_assignment(np.where(distance <= limit_m, distance, beyond))
    good = distance[rows, columns] <= limit_m
    return rows[good], columns[good], distance[rows, columns][good]


@dataclass
class CentreScore:
    """Counts over many frame sets."""

    match_m: float = MATCH_M
    vehicles: int = 0
    found: int = 0
    boxes: int = 0
    false: int = 0
    errors_m: list[float] = field(default_factory=list)

    def add(self, ours: Array, ours_counted: NDArray[np.bool_], truth: Array, truth_counted: NDArray[np.bool_]) -> None:
        """One frame set: our centres (M, 3), all true centres (N, 3), and which of either are counted.

        All may match all, so that a box on a vehicle that is not counted is not false.
        """
        rows, columns, distance = match_centres(ours, truth, self.match_m)
        matched = np.zeros(len(ours), dtype=bool)
        matched[rows] = True
        self.vehicles += int(truth_counted.sum())
        self.found += int(truth_counted[columns].sum())
        self.boxes += int(ours_counted.sum())
        self.false += int((ours_counted & ~matched).sum())
        self.errors_m += distance[truth_counted[columns]].tolist()

    def summary(self) -> dict[str, float | int]:
        """Counts, recall and false share in percent, error percentiles in metres."""
        errors: Sequence[float] = self.errors_m or [float("nan")]
        return {
            "vehicles": self.vehicles,
            "found": self.found,
            "recall_percent": round(100 * self.found / max(self.vehicles, 1), 2),
            "boxes": self.boxes,
            "false": self.false,
            "false_percent": round(100 * self.false / max(self.boxes, 1), 2),
            "error_median_m": round(float(np.median(errors)), 3),
            "error_p90_m": round(float(np.percentile(errors, 90)), 3),
        }
