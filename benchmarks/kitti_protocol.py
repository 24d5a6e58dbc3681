"""KITTI's object evaluation, as its own C++ evaluator does it, for all frames at once.

What the evaluator does, and what this follows to the letter:

- Truth of the class counts when it is visible, whole and tall enough for the difficulty; otherwise it is *ignored*: it may
  take a detection, and is then neither found nor missed. Van (for Car) and Person_sitting (for Pedestrian) are ignored.
- A detection less tall than the difficulty asks is ignored whatever its class; the height is cut to whole pixels first. This
  is the *2D* height in bird's-eye view and 3D too.
- A truth takes a detection that overlaps it by strictly more than the limit. Truths choose one after another in the order of
  the file; a taken detection is gone.
- Pass one finds the scores: each truth takes the detection of the highest score, and of the true positives' scores those
  are kept that come nearest to the recalls 0, 1/40 .. 1. Pass two counts at each of those scores: now a truth takes the
  detection of the largest overlap, an ignored one only where there is no other.
- A detection that no truth took is false, unless more than the limit of its own 2D box lies in a DontCare region (2D only).
- Precision at recall r is the largest at r or beyond; a recall that is not reached has precision 0. R11 averages every
  fourth of the 41 points, R40 all but the first. So a set of fewer than 41 counted objects cannot score 100.
- Orientation similarity sums (1 + cos(difference of alpha)) / 2 over the true positives of the 2D pass, in place of their
  number. It is left out for a class when any of its results gives alpha -10 (KITTI's evaluator then leaves it out for all).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from benchmarks.kitti_folders import KittiPair, KittiSet
from service.geometry.iou import iou_2d, iou_3d, iou_bev
from service.geometry.transforms import Array

RECALL_POINTS = 41
CLASSES = ("Car", "Pedestrian", "Cyclist")
NEIGHBOURS = {"Car": "van", "Pedestrian": "person_sitting", "Cyclist": ""}
DEFAULT_OVERLAPS = {"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5}
METRICS = ("2d", "bev", "3d")
NO_ALPHA, NO_LOCATION = -10.0, -1000.0


@dataclass(frozen=True)
class Difficulty:
    """What truth has to be in order to count."""

    name: str
    min_height_px: float
    """Truth has to be taller than this; a detection this tall, cut to whole pixels, is no longer ignored."""
    max_occluded: int
    max_truncated: float


DIFFICULTIES = (Difficulty("easy", 40, 0, 0.15), Difficulty("moderate", 25, 1, 0.3), Difficulty("hard", 25, 2, 0.5))


@dataclass(frozen=True, eq=False)
class Candidates:
    """P pairs of a truth and a detection of the same frame that overlap at all; sorted by truth, then detection."""

    truth: NDArray[np.int64]
    """(P,) rows of the truth."""
    found: NDArray[np.int64]
    """(P,) rows of the results."""
    overlap: Array
    """(P,) intersection over union."""


@dataclass(frozen=True, eq=False)
class Curve:
    """Precision and orientation similarity at the 41 recalls, both already the largest at that recall or beyond."""

    precision: Array
    """(41,) in 0..1; 0 where the recall is not reached."""
    similarity: Array
    """(41,) in 0..1."""
    counted: int
    """How many truths count."""


@dataclass(frozen=True, eq=False)
class Matches:
    """What M truths took at T score thresholds."""

    true_positives: NDArray[np.int64]
    """(T,)."""
    taken: NDArray[np.bool_]
    """(D, T) which detections were taken."""
    scores: Array
    """Scores of the true positives of the first threshold, in no order."""
    similarity: Array
    """(T,) summed orientation similarity of the true positives."""


def average_precision(precision: Array) -> tuple[float, float]:
    """AP at 11 and at 40 recalls, in percent, of the values at the 41 recalls."""
    return 100.0 * float(precision[::4].mean()), 100.0 * float(precision[1:].mean())


def as_percent(scores: dict[str, dict[str, list[Curve] | None]]) -> dict[str, dict[str, dict[str, list[float]] | None]]:
    """AP by class, metric, and "R11" or "R40": [easy, moderate, hard] in percent, of the curves that `evaluate` gives."""

    def averages(curves: list[Curve], metric: str) -> dict[str, list[float]]:
        pairs = [average_precision(c.similarity if metric == "aos" else c.precision) for c in curves]
        return {"R11": [r11 for r11, _ in pairs], "R40": [r40 for _, r40 in pairs]}

    return {
        name: {metric: None if curves is None else averages(curves, metric) for metric, curves in metrics.items()}
        for name, metrics in scores.items()
    }


def evaluate(pair: KittiPair, overlaps: dict[str, float] | None = None) -> dict[str, dict[str, list[Curve] | None]]:
    """Curves by class, then metric ("2d", "aos", "bev", "3d"), for easy, moderate and hard.

    overlaps: the least overlap of each class. The value is None where the results do not give the quantity: "aos" without
    the alpha of every result of the class, "bev" and "3d" when no result has a location.
    """
    overlaps = DEFAULT_OVERLAPS | (overlaps or {})
    candidates = {metric: find_candidates(pair, metric) for metric in METRICS}
    results = pair.results
    has_place = not len(results) or bool(np.any(results.states[:, :2] != NO_LOCATION))
    scores: dict[str, dict[str, list[Curve] | None]] = {}
    for name in CLASSES:
        curves = {
            metric: [score_class(pair, candidates[metric], name, metric, overlaps[name], d) for d in DIFFICULTIES]
            for metric in METRICS
        }
        scores[name] = {
            "2d": curves["2d"],
            "aos": None if np.any(results.alpha[results.type == name.lower()] == NO_ALPHA) else curves["2d"],
            "bev": curves["bev"] if has_place else None,
            "3d": curves["3d"] if has_place else None,
        }
    return scores


def find_candidates(pair: KittiPair, metric: str) -> Candidates:
    """All overlapping pairs by a metric, over the types that can be truth of a class; DontCare is none."""
    overlap_of: Callable[[Array, Array], Array] = {"2d": iou_2d, "bev": iou_bev, "3d": iou_3d}[metric]
    classes = [name.lower() for name in CLASSES] + [name for name in NEIGHBOURS.values() if name]
    rows = np.flatnonzero(np.isin(pair.truth.type, classes))
    truths = _by_frame(pair.truth.frame[rows], pair.frames)
    found = _by_frame(pair.results.frame, pair.frames)
    a, b, overlap = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros(0)]
    for mine, theirs in zip(truths, found, strict=True):
        if mine.start == mine.stop or theirs.start == theirs.stop:
            continue
        block = overlap_of(_geometry(pair.truth, metric)[rows[mine]], _geometry(pair.results, metric)[theirs])
        i, j = np.nonzero(block > 0)
        a.append(rows[mine][i])
        b.append(j + theirs.start)
        overlap.append(block[i, j])
    return Candidates(np.concatenate(a), np.concatenate(b), np.concatenate(overlap))


def score_class(
    pair: KittiPair, candidates: Candidates, name: str, metric: str, min_overlap: float, difficulty: Difficulty
) -> Curve:
    """The curve of a class by a metric at a difficulty."""
    counts, may_take = truth_roles(pair.truth, name, difficulty)
    valid, ignored = result_roles(pair.results, name, difficulty)
    usable = (candidates.overlap > min_overlap) & may_take[candidates.truth] & (valid | ignored)[candidates.found]
    near = Candidates(candidates.truth[usable], candidates.found[usable], candidates.overlap[usable])
    everything = np.full(1, -np.inf)
    first = _match(pair, near, counts, ignored, everything, by_overlap=False)
    thresholds = recall_thresholds(first.scores, int(counts.sum()))
    second = _match(pair, near, counts, ignored, thresholds, by_overlap=True)
    forgiven = _in_dontcare(pair, min_overlap) if metric == "2d" else np.zeros(len(pair.results), dtype=bool)
    false_candidates = (valid & ~forgiven)[:, None] & (pair.results.score[:, None] >= thresholds)
    reported = second.true_positives + (false_candidates & ~second.taken).sum(0)
    precision, similarity = np.zeros(RECALL_POINTS), np.zeros(RECALL_POINTS)
    precision[: len(thresholds)] = second.true_positives / np.maximum(reported, 1)
    similarity[: len(thresholds)] = second.similarity / np.maximum(reported, 1)
    return Curve(_from_here_on(precision), _from_here_on(similarity), int(counts.sum()))


def truth_roles(truth: KittiSet, name: str, difficulty: Difficulty) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which truths (N,) count, and which may take a detection (those, and the ignored ones)."""
    own = truth.type == name.lower()
    fit = (
        (truth.occluded <= difficulty.max_occluded)
        & (truth.truncated <= difficulty.max_truncated)
        & (truth.height_px > difficulty.min_height_px)
    )
    return own & fit, own | (truth.type == NEIGHBOURS[name])


def result_roles(results: KittiSet, name: str, difficulty: Difficulty) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which detections (D,) are valid for the class, and which are ignored because they are low, of whatever class."""
    low = np.trunc(np.abs(results.height_px)) < difficulty.min_height_px
    return (results.type == name.lower()) & ~low, low


def recall_thresholds(scores: Array, counted: int) -> Array:
    """Of the true positives' scores (K,) those (T,) nearest to the recalls 0, 1/40 .. 1 of ``counted`` truths, descending."""
    ordered = np.sort(scores)[::-1]
    kept, recall = [], 0.0
    for k, score in enumerate(ordered):
        last = k == len(ordered) - 1
        if not last and (k + 2) / counted - recall < recall - (k + 1) / counted:
            continue
        kept.append(score)
        recall += 1.0 / (RECALL_POINTS - 1)
    return np.array(kept, dtype=np.float64)


def _match(
    pair: KittiPair,
    near: Candidates,
    counts: NDArray[np.bool_],
    ignored: NDArray[np.bool_],
    thresholds: Array,
    *,
    by_overlap: bool,
) -> Matches:
    """Truths take detections, the first of every frame at once, then the second, and so on; all thresholds at once."""
    results = pair.results
    live = results.score[:, None] >= thresholds
    wish = np.where(ignored[near.found], 0.0, near.overlap) if by_overlap else results.score[near.found]
    taken = np.zeros((len(results), len(thresholds)), dtype=bool)
    hits = np.zeros((len(pair.truth), len(thresholds)), dtype=bool)
    similarity = np.zeros(len(thresholds))
    scores: list[Array] = [np.zeros(0)]
    for rows in _rounds(pair.truth.frame, near.truth):
        truth, found = near.truth[rows], near.found[rows]
        starts = np.flatnonzero(np.diff(truth, prepend=-1))
        free = live[found] & ~taken[found]
        key = np.where(free, wish[rows, None], -np.inf)
        best = np.maximum.reduceat(key, starts, axis=0)
        group = np.cumsum(np.diff(truth, prepend=-1) != 0) - 1
        # Of equal wishes the first in the file wins: the lowest row among the best.
        order = np.where(free & (key == best[group]), np.arange(len(rows))[:, None], len(rows))
        chosen = np.minimum.reduceat(order, starts, axis=0)
        which, t = np.nonzero(chosen < len(rows))
        detection, owner = found[chosen[which, t]], truth[starts][which]
        taken[detection, t] = True
        hit = counts[owner] & ~ignored[detection]
        hits[owner, t] = hit
        turn = np.cos(pair.truth.alpha[owner] - results.alpha[detection])
        similarity += np.bincount(t[hit], (1.0 + turn[hit]) / 2.0, len(thresholds))
        scores.append(results.score[detection[hit & (t == 0)]])
    return Matches(hits.sum(0), taken, np.concatenate(scores), similarity)


def _rounds(frame: NDArray[np.int64], truth: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Rows of the pairs whose truth is the first of its frame to choose, then of the second, and so on."""
    choosers, position = np.unique(truth, return_inverse=True)
    first = np.searchsorted(frame[choosers], frame[choosers], side="left")
    turn = (np.arange(len(choosers)) - first)[position]
    return [np.flatnonzero(turn == k) for k in range(int(turn.max()) + 1 if len(turn) else 0)]


def _in_dontcare(pair: KittiPair, min_overlap: float) -> NDArray[np.bool_]:
    """Which detections (D,) have more than the limit of their own 2D box inside one DontCare region."""
    regions = np.flatnonzero(pair.truth.type == "dontcare")
    forgiven = np.zeros(len(pair.results), dtype=bool)
    found = _by_frame(pair.results.frame, pair.frames)
    for row in regions:
        own = found[int(pair.truth.frame[row])]
        box, region = pair.results.bbox[own], pair.truth.bbox[row]
        sides = np.minimum(box[:, 2:], region[2:]) - np.maximum(box[:, :2], region[:2])
        inside = np.prod(np.maximum(sides, 0.0), axis=1)
        forgiven[own] |= inside > min_overlap * np.prod(box[:, 2:] - box[:, :2], axis=1)
    return forgiven


def _by_frame(frame: NDArray[np.int64], frames: int) -> list[slice]:
    """Rows of each frame, given the ascending frame numbers of the rows."""
    edges = np.searchsorted(frame, np.arange(frames + 1))
    return [slice(int(a), int(b)) for a, b in pairwise(edges)]


def _geometry(objects: KittiSet, metric: str) -> Array:
    return objects.bbox if metric == "2d" else objects.states


def _from_here_on(values: Array) -> Array:
    """The largest value at each place or after it."""
    largest: Array = np.maximum.accumulate(values[::-1])[::-1]
    return largest
