"""Average precision of boxes by their overlap with true vehicles, over many frame sets.

Boxes choose in the order of their score, over each frame set: of the vehicles that no better box has taken and that it overlaps
by strictly more than the limit, a box takes the one of the largest overlap that counts, or else one that is ignored. A box
without a vehicle is false if a camera looks at its place, and is left out otherwise, like a box on an ignored vehicle.

Precision at recall r is the largest at r or beyond. Unlike KITTI's evaluator this uses the whole curve, not 41 samples of it,
so that perfect boxes score 100 however few they are. R11 averages the recalls 0, 0.1 .. 1; R40 averages 1/40 .. 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.scored_sets import Found, Wanted
from service.geometry.iou import iou_3d, iou_bev
from service.geometry.transforms import Array

OVERLAPS = {"3d": iou_3d, "bev": iou_bev}
RECALLS = {"R11": np.linspace(0.0, 1.0, 11), "R40": np.linspace(1 / 40, 1.0, 40)}
_RIGHT, _FALSE, _LEFT_OUT = 1, 0, -1


@dataclass(frozen=True, eq=False)
class PrecisionRecall:
    """A curve: K points in the order of falling score, one for each score that occurs."""

    recall: Array
    """(K,) in 0..1."""
    precision: Array
    """(K,) in 0..1."""
    score: Array
    """(K,) the least score that still counts at the point."""
    counted: int
    """How many vehicles had to be found."""

    def at(self, recalls: Array) -> Array:
        """Precision (R,) at recalls (R,): the largest there or beyond, 0 where the curve does not reach."""
        if not len(self.recall):
            return np.zeros(len(recalls))
        best = np.maximum.accumulate(self.precision[::-1])[::-1]
        # Recall 1 has to be reached by a curve whose last recall is 1 up to rounding.
        first = np.searchsorted(self.recall, recalls - 1e-9, side="left")
        return np.where(first < len(best), best[np.minimum(first, len(best) - 1)], 0.0)

    def average(self, sampling: str) -> float:
        """Average precision in percent, by "R11" or "R40"; NaN when no vehicle counts."""
        return 100.0 * float(self.at(RECALLS[sampling]).mean()) if self.counted else float("nan")


def precision_recall(found: Sequence[Found], wanted: Sequence[Wanted], metric: str, min_overlap: float) -> PrecisionRecall:
    """The curve over frame sets, ``found`` and ``wanted`` in the same order. metric: "3d" or "bev"."""
    overlap_of = OVERLAPS[metric]
    outcomes = [outcome(f, w, overlap_of(f.states, w.states), min_overlap) for f, w in zip(found, wanted, strict=True)]
    result = np.concatenate([np.zeros(0, np.int64), *outcomes])
    score = np.concatenate([np.zeros(0), *(f.score for f in found)])
    counted = int(sum(w.counted.sum() for w in wanted))
    return curve(result, score, counted)


def outcome(found: Found, wanted: Wanted, overlap: Array, min_overlap: float) -> NDArray[np.int64]:
    """What became of each box (M,) of a frame set: 1 right, 0 false, -1 left out. overlap: (M, N)."""
    result = np.where(found.in_view, _FALSE, _LEFT_OUT).astype(np.int64)
    # A vehicle that counts goes before any that is ignored: overlaps are at most 1.
    wish = np.where(overlap > min_overlap, overlap + wanted.counted, 0.0)
    for row in np.argsort(-found.score, kind="stable") if len(wanted) else ():
        best = int(wish[row].argmax())
        if wish[row, best] > 0:
            result[row] = _RIGHT if wanted.counted[best] else _LEFT_OUT
            wish[:, best] = 0.0
    return result


def curve(result: NDArray[np.int64], score: Array, counted: int) -> PrecisionRecall:
    """The curve of boxes (K,): 1 right, 0 false, -1 left out, with their scores (K,), against ``counted`` vehicles."""
    used = result != _LEFT_OUT
    order = np.argsort(-score[used], kind="stable")
    ordered, right = score[used][order], result[used][order] == _RIGHT
    hits = np.cumsum(right)
    # Boxes of the same score come in together: their order among themselves is nobody's merit.
    last = np.flatnonzero(np.append(np.diff(ordered) != 0, True)) if len(ordered) else np.zeros(0, np.int64)
    return PrecisionRecall(hits[last] / max(counted, 1), hits[last] / (last + 1.0), ordered[last], counted)
