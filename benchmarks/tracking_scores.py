"""Tracking scores: MOTA (Bernardin and Stiefelhagen 2008), IDF1 (Ristani et al. 2016), HOTA (Luiten et al. 2021).

Similarity of a box and a vehicle is their volume IoU. The matching and the averages are those of the `trackeval` package, whose
figures the tests pin; the package itself is no dependency because it brings a second OpenCV over the service's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from benchmarks.scored_sets import Found, Wanted
from service.geometry.iou import iou_3d
from service.geometry.transforms import Array

MIN_IOU = 0.5
"""Least similarity of a match for MOTA and IDF1; HOTA averages over 0.05, 0.1 .. 0.95."""
ALPHAS = np.arange(0.05, 0.99, 0.05)
_EPS = np.finfo(np.float64).eps
_KEEP = 1000.0


@dataclass(frozen=True, eq=False)
class Moment:
    """One frame set: identities of the vehicles (N,) and tracks (M,), numbered from 0, and similarity (N, M)."""

    vehicles: NDArray[np.int64]
    tracks: NDArray[np.int64]
    similarity: Array


@dataclass(frozen=True, eq=False)
class TrackingCounts:
    """Counts of one or more scenes; they add up."""

    vehicles: int
    """Vehicles that had to be found, over all frame sets."""
    boxes: int
    missed: int
    false: int
    switches: int
    """How often a vehicle's track changed."""
    id_matches: int
    """Matches under the best one-to-one assignment of whole tracks to whole vehicles."""
    hota_matches: Array
    """(A,) matches at each of ``ALPHAS``."""
    association: Array
    """(A,) association accuracy summed over those matches."""

    def __add__(self, other: TrackingCounts) -> TrackingCounts:
        mine, theirs = vars(self), vars(other)
        return TrackingCounts(**{name: mine[name] + theirs[name] for name in mine})

    def summary(self) -> dict[str, float | int | None]:
        """Scores in percent; None when there is nothing to track."""
        if not self.vehicles:
            return {"mota": None, "idf1": None, "hota": None, "switches": self.switches}
        detection = self.hota_matches / (self.vehicles + self.boxes - self.hota_matches)
        association = self.association / np.maximum(self.hota_matches, 1)
        return {
            "mota": round(100.0 * (1.0 - (self.missed + self.false + self.switches) / self.vehicles), 2),
            "idf1": round(100.0 * self.id_matches / (0.5 * (self.vehicles + self.boxes)), 2),
            "hota": round(100.0 * float(np.sqrt(detection * association).mean()), 2),
            "switches": self.switches,
        }


def no_counts() -> TrackingCounts:
    """Counts of no scene at all."""
    return TrackingCounts(0, 0, 0, 0, 0, 0, np.zeros(len(ALPHAS)), np.zeros(len(ALPHAS)))


def moments(found: Sequence[Found], wanted: Sequence[Wanted]) -> list[Moment]:
    """One scene's frame sets in order of time, cut to what counts.

    Left out are vehicles that are ignored, boxes matched to one of those, and boxes on nothing where no camera looks.
    """
    names = sorted({name for f in found for name in f.track_id})
    number = {name: k for k, name in enumerate(names)}
    vehicle = {int(v): k for k, v in enumerate(np.unique(np.concatenate([np.zeros(0, np.int64), *(w.ids for w in wanted)])))}
    result = []
    for f, w in zip(found, wanted, strict=True):
        similarity = iou_3d(w.states, f.states)
        rows, columns = linear_sum_assignment(-similarity)
        near = similarity[rows, columns] >= MIN_IOU
        keep = f.in_view.copy()
        keep[columns[near]] = w.counted[rows[near]]
        ids = np.array([vehicle[int(v)] for v in w.ids[w.counted]], dtype=np.int64)
        tracks = np.array([number[name] for name in f.track_id], dtype=np.int64)[keep]
        result.append(Moment(ids, tracks, similarity[np.ix_(w.counted, keep)]))
    return result


def count_scene(scene: Sequence[Moment]) -> TrackingCounts:
    """Counts of one scene, its frame sets in order of time."""
    missed, false, switches = _clear(scene)
    together, of_vehicle, of_track = _together(scene)
    matches, association = _hota(scene, of_vehicle, of_track)
    rows, columns = linear_sum_assignment(-together)
    id_matches = int(together[rows, columns].sum())
    vehicles, boxes = int(of_vehicle.sum()), int(of_track.sum())
    return TrackingCounts(vehicles, boxes, missed, false, switches, id_matches, matches, association)


def _clear(scene: Sequence[Moment]) -> tuple[int, int, int]:
    """Missed, false, switches: a vehicle keeps the track of the moment before if it still can, then most similarity wins."""
    missed = false = switches = 0
    last: dict[int, int] = {}
    before: dict[int, int] = {}
    for moment in scene:
        if not moment.similarity.size:
            missed, false = missed + len(moment.vehicles), false + len(moment.tracks)
            continue
        keeps = np.array([[before.get(int(v)) == int(t) for t in moment.tracks] for v in moment.vehicles], dtype=np.float64)
        reward = _KEEP * keeps + moment.similarity
        reward[moment.similarity < MIN_IOU - _EPS] = 0.0
        rows, columns = linear_sum_assignment(-reward)
        real = reward[rows, columns] > _EPS
        before = {int(v): int(t) for v, t in zip(moment.vehicles[rows[real]], moment.tracks[columns[real]], strict=True)}
        switches += sum(v in last and last[v] != t for v, t in before.items())
        last |= before
        missed += len(moment.vehicles) - len(before)
        false += len(moment.tracks) - len(before)
    return missed, false, switches


def _together(scene: Sequence[Moment]) -> tuple[Array, Array, Array]:
    """At how many moments each vehicle and track match (V, T), and how many each has (V,), (T,)."""
    vehicles = 1 + max((int(m.vehicles.max()) for m in scene if len(m.vehicles)), default=-1)
    tracks = 1 + max((int(m.tracks.max()) for m in scene if len(m.tracks)), default=-1)
    together, of_vehicle, of_track = np.zeros((vehicles, tracks)), np.zeros(vehicles), np.zeros(tracks)
    for moment in scene:
        rows, columns = np.nonzero(moment.similarity >= MIN_IOU)
        together[moment.vehicles[rows], moment.tracks[columns]] += 1
        of_vehicle[moment.vehicles] += 1
        of_track[moment.tracks] += 1
    return together, of_vehicle, of_track


def _hota(scene: Sequence[Moment], of_vehicle: Array, of_track: Array) -> tuple[Array, Array]:
    """Matches (A,) and summed association accuracy (A,) at each similarity of ``ALPHAS``."""
    shared = np.zeros((len(of_vehicle), len(of_track)))
    for moment in scene:
        s = moment.similarity
        either = s.sum(0)[None] + s.sum(1)[:, None] - s
        shared[np.ix_(moment.vehicles, moment.tracks)] += np.divide(s, either, out=np.zeros_like(s), where=either > _EPS)
    alignment = shared / np.maximum(of_vehicle[:, None] + of_track[None] - shared, _EPS)
    pairs = np.zeros((len(ALPHAS), len(of_vehicle), len(of_track)))
    for moment in scene:
        rows, columns = linear_sum_assignment(-alignment[np.ix_(moment.vehicles, moment.tracks)] * moment.similarity)
        near = moment.similarity[rows, columns] >= ALPHAS[:, None] - _EPS
        pairs[:, moment.vehicles[rows], moment.tracks[columns]] += near
    union = of_vehicle[None, :, None] + of_track[None, None] - pairs
    accuracy = pairs * pairs / np.maximum(union, 1)
    return pairs.sum((1, 2)), accuracy.sum((1, 2))
