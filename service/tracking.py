"""Tracking: identities, speeds and headings over time, one tracker a site.

Boxes are assigned to tracks in bird's-eye view, and an extended Kalman filter (:mod:`service.motion`) with real time steps
follows each. What feeds it is each camera's own measurement with its own covariance: cameras of one capture time together,
which is what :func:`service.fusion.fuse` adds up, and cameras of different times one after another. All tracks move at
once, as arrays.

Sets that arrive late are put in their place: the tracker goes back to where it stood before them, and repeats what came
since.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

from service.association import Index, gated_assignment, mahalanobis_cost
from service.fusion import CameraParts, FusedBoxes
from service.geometry.boxes import STATE_DIM, YAW, Boxes, box_states
from service.geometry.transforms import Array, wrap_angle
from service.motion import SPEED, MotionSettings, blurred, corrected, newborn, predicted, turned_about, velocity
from service.odds import log_odds, probability

_BOX = slice(0, STATE_DIM)
_NS_PER_S = 1e9
_MAX_SCORE = 0.99


@dataclass(frozen=True)
class TrackSettings:
    """Tuning of the tracker."""

    gate: float = 18.4
    """Largest squared Mahalanobis distance of a match: 99.99 % of a chi-square with 2 degrees of freedom. Wider than that of
    fusion, for a vehicle passes it hundreds of times."""
    max_distance_m: float = 4.0
    """Farthest that a box may lie from where its track was expected, metres."""
    hit_log_odds: float = 1.0
    """What a box adds to the log-odds that its vehicle exists, beside the log-odds of its own score."""
    fade_per_s: float = 2.5
    """What each second unseen takes from them. A track whose existence is less likely than not is dropped; until then it
    coasts, unreported."""
    max_log_odds: float = 8.0
    """Cap on them, so that a vehicle that left is dropped in a few seconds."""
    heading_speed_mps: float = 1.0
    """Above this speed a vehicle's heading follows its motion; below, its past heading."""
    heading_sigmas: float = 4.0
    """The speed must also stand out from its own uncertainty by this factor: jitter of a new track is no motion."""
    max_flip_evidence: float = 6.0
    """Cap on the log-odds that a track gathers for its direction, so that it can change its mind."""
    late_s: float = 1.0
    """Sets that arrive later than this behind the newest one count as of the newest one's time."""
    same_time_s: float = 0.001
    """Cameras less apart in time than this count as simultaneous."""
    motion: MotionSettings = field(default_factory=MotionSettings)


@dataclass(frozen=True, eq=False)
class TrackedBoxes:
    """M boxes with identities, in the order of the fused boxes that they came from."""

    boxes: Boxes
    """(M) filtered boxes; score and class are those of the fused box."""
    members: NDArray[np.bool_]
    """(M, C) which cameras contributed."""
    track_id: list[str]
    """M ids, unique for the life of the tracker: "1", "2", ..."""
    velocity: Array
    """(M, 3) world, m/s; zero for a vehicle seen for the first time."""
    speed_sigma: Array | None = None
    """(M,) standard deviation of the speed, m/s."""
    existence: Array | None = None
    """(M,) probability that the vehicle exists, by all that was seen of it."""


@dataclass(frozen=True, eq=False)
class _Tracks:
    """T tracks; every array has T rows."""

    number: Index
    state: Array
    """(T, 9) x y z l w h yaw speed yaw rate."""
    covariance: Array
    """(T, 9, 9)."""
    flip_evidence: Array
    """(T,) log-odds gathered for the yaw against its opposite; never negative."""
    existence: Array
    """(T,) log-odds that the vehicle exists."""

    def take(self, index: Index | NDArray[np.bool_]) -> _Tracks:
        return _Tracks(
            self.number[index],
            self.state[index],
            self.covariance[index],
            self.flip_evidence[index],
            self.existence[index],
        )

    def joined(self, other: _Tracks) -> _Tracks:
        return _Tracks(**{f.name: np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)})


@dataclass(frozen=True, eq=False)
class _Past:
    """A set that was tracked, and what it takes to do so again."""

    at_ns: int
    fused: FusedBoxes
    before: _Tracks
    """The tracks as they stood at ``before_ns``."""
    before_ns: int
    number: Index
    """(M,) the identities that were given."""


class Tracker:
    """The tracks of one site. Not thread-safe: one caller. Sets may come out of the order of capture."""

    def __init__(self, settings: TrackSettings | None = None) -> None:
        self._settings = settings or TrackSettings()
        self._tracks = _born(Boxes.empty(), np.zeros(0, np.int64), 0.0, self._settings)
        self._now_ns: int | None = None
        self._next_number = 1
        self._past: deque[_Past] = deque()

    def update(self, fused: FusedBoxes, captured_at_ns: int) -> TrackedBoxes:
        """Take the boxes of one frame set captured at ``captured_at_ns`` (UTC) and give them back tracked.

        Every box comes back at once, new ones under a new id. Where ``fused.parts`` has the cameras' own boxes and times, those
        feed the filter. A set captured before the last one is put in its place if that is less than ``late_s`` ago.
        """
        oldest_ns = self._past[0].at_ns if self._past else captured_at_ns
        if self._now_ns is None or captured_at_ns >= self._now_ns or captured_at_ns < oldest_ns:
            at_ns = captured_at_ns if self._now_ns is None else max(captured_at_ns, self._now_ns)
            return self._result(fused, self._step(fused, at_ns))
        later = [past for past in self._past if past.at_ns > captured_at_ns]
        self._past = deque(past for past in self._past if past.at_ns <= captured_at_ns)
        self._tracks, self._now_ns = later[0].before, later[0].before_ns
        first_new = self._next_number
        seen = self._step(fused, captured_at_ns)
        for past in later:
            again = self._step(past.fused, past.at_ns)
            seen = self._renamed(seen, again.number, past.number, first_new)
        return self._result(fused, seen)

    def _step(self, fused: FusedBoxes, at_ns: int) -> _Tracks:
        """One set in order of time; its tracks (M) in the order of the boxes."""
        before, before_ns = self._tracks, at_ns if self._now_ns is None else self._now_ns
        boxes, settings = fused.boxes, self._settings
        tracks = _advanced(before, (at_ns - before_ns) / _NS_PER_S, settings)
        age_s, spread_s = _ages(fused.parts, at_ns, settings)
        then_s = max((at_ns - before_ns) / _NS_PER_S - age_s, 0.0)
        rows, columns = self._match(boxes, self._expected(before, tracks, then_s, spread_s) if age_s + spread_s else tracks)
        seen = _fed(before, tracks, fused, (rows, columns), (before_ns, at_ns), age_s + spread_s > 0, settings)
        if len(rows) < len(boxes):
            is_new = _others(rows, len(boxes))
            born = _born(boxes.take(is_new), self._next_number + np.arange(len(is_new)), age_s, settings)
            self._next_number += len(is_new)
            seen, rows = seen.joined(born), np.concatenate([rows, is_new])
        seen = seen.take(np.argsort(rows))
        unseen = _others(columns, len(tracks.number))
        self._tracks, self._now_ns = seen.joined(tracks.take(unseen)) if len(unseen) else seen, at_ns
        self._remember(_Past(at_ns, fused, before, before_ns, seen.number))
        return seen

    def _match(self, boxes: Boxes, tracks: _Tracks) -> tuple[Index, Index]:
        distance_sq, cost, distance_m = mahalanobis_cost(
            boxes.center[:, :2], boxes.covariance[:, :2, :2], tracks.state[:, :2], tracks.covariance[:, :2, :2]
        )
        return gated_assignment(distance_sq, cost, distance_m, self._settings.gate, self._settings.max_distance_m)

    def _expected(self, before: _Tracks, tracks: _Tracks, elapsed_s: float, spread_s: float) -> _Tracks:
        """``tracks`` at the cameras' mean time, as vague as those differ: what fused boxes are to be compared with."""
        then = _of_numbers(before, tracks.number)
        state, covariance = predicted(then.state, then.covariance, elapsed_s, self._settings.motion)
        return replace(tracks, state=state, covariance=blurred(state, covariance, spread_s))

    def _renamed(self, seen: _Tracks, now: Index, published: Index, first_new: int) -> _Tracks:
        """``seen`` after tracks that a late set brought about took the identities published for them before, where free."""
        changed = (now >= first_new) & (now != published) & ~np.isin(published, self._tracks.number)
        names = dict(zip(now[changed].tolist(), published[changed].tolist(), strict=True))
        if names:
            self._tracks, seen = _with_names(self._tracks, names), _with_names(seen, names)
            last = self._past.pop()
            self._past.append(replace(last, number=np.array([names.get(n, n) for n in last.number.tolist()], np.int64)))
        return seen

    def _remember(self, past: _Past) -> None:
        self._past.append(past)
        while past.at_ns - self._past[0].at_ns > self._settings.late_s * _NS_PER_S:
            self._past.popleft()

    def _result(self, fused: FusedBoxes, seen: _Tracks) -> TrackedBoxes:
        boxes = Boxes(
            center=seen.state[:, :3],
            dims_lwh=seen.state[:, 3:6],
            yaw=seen.state[:, YAW],
            score=fused.boxes.score,
            cls=fused.boxes.cls,
            covariance=seen.covariance[:, _BOX, _BOX],
            flip_log_odds=seen.flip_evidence,
        )
        return TrackedBoxes(
            boxes,
            fused.members,
            [str(number) for number in seen.number],
            velocity(seen.state),
            np.sqrt(seen.covariance[:, SPEED, SPEED]),
            probability(seen.existence),
        )


def _others(rows: Index, count: int) -> Index:
    """Those of 0 .. count - 1 that are not among ``rows``."""
    free = np.ones(count, dtype=bool)
    free[rows] = False
    return np.flatnonzero(free)


def _born(boxes: Boxes, number: Index, age_s: float, settings: TrackSettings) -> _Tracks:
    state, covariance = newborn(box_states(boxes), boxes.covariance, age_s, settings.motion)
    state[:, YAW] = wrap_angle(boxes.yaw + np.where(boxes.flip_log_odds < 0, np.pi, 0.0))
    evidence = np.minimum(np.abs(boxes.flip_log_odds), settings.max_flip_evidence)
    return _Tracks(number, state, covariance, evidence, _seen_more(np.zeros(len(boxes)), boxes.score, settings))


def _of_numbers(tracks: _Tracks, number: Index) -> _Tracks:
    """The tracks with the given identities, in their order; all must be there."""
    by_number = np.argsort(tracks.number)
    return tracks.take(by_number[np.searchsorted(tracks.number, number, sorter=by_number)])


def _with_names(tracks: _Tracks, names: dict[int, int]) -> _Tracks:
    return replace(tracks, number=np.array([names.get(n, n) for n in tracks.number.tolist()], np.int64))


def _advanced(tracks: _Tracks, elapsed_s: float, settings: TrackSettings) -> _Tracks:
    """Tracks ``elapsed_s`` later, without those that have faded."""
    existence = tracks.existence - settings.fade_per_s * elapsed_s
    alive = existence > 0
    if not alive.all():
        tracks, existence = tracks.take(alive), existence[alive]
    state, covariance = predicted(tracks.state, tracks.covariance, elapsed_s, settings.motion)
    return _Tracks(tracks.number, state, covariance, tracks.flip_evidence, existence)


def _seen_more(existence: Array, score: Array, settings: TrackSettings) -> Array:
    """Log-odds (T,) of existence after a box of ``score`` (T,) more; a box never makes its vehicle less likely."""
    gained = np.maximum(settings.hit_log_odds + log_odds(score, 1.0 - _MAX_SCORE), 0.2 * settings.hit_log_odds)
    return np.minimum(existence + gained, settings.max_log_odds)


def _fed(
    before: _Tracks, tracks: _Tracks, fused: FusedBoxes, pairs: tuple[Index, Index], span_ns: tuple[int, int],
    skewed: bool, settings: TrackSettings,
) -> _Tracks:  # fmt: skip
    """The tracks of ``pairs`` (rows of the boxes, rows of the tracks) after their boxes.

    ``before`` are all tracks at the begin of the span, ``tracks`` those that live at its end. ``skewed``: cameras looked at
    times of their own.
    """
    rows, columns = pairs
    boxes, mine = fused.boxes.take(rows), tracks.take(columns)
    if fused.parts is None or not skewed:
        state, covariance, opposite = corrected(mine.state, mine.covariance, box_states(boxes), boxes.covariance)
    else:
        start = _of_numbers(before, mine.number)
        position = np.full(len(fused.boxes), -1)
        position[rows] = np.arange(len(rows))
        state, covariance = _fed_in_turn(start, fused.parts, position, span_ns, settings)
        opposite = np.cos(boxes.yaw - state[:, YAW]) < 0
    existence = _seen_more(mine.existence, boxes.score, settings)
    return _headed(_Tracks(mine.number, state, covariance, mine.flip_evidence, existence), opposite, boxes, settings)


def _ages(parts: CameraParts | None, at_ns: int, settings: TrackSettings) -> tuple[float, float]:
    """Mean age of the cameras' boxes and its spread, seconds; zero where all count as of the set's own time."""
    times = None if parts is None else parts.captured_at_ns
    if times is None or not len(times):
        return 0.0, 0.0
    ages_s = (at_ns - times) / _NS_PER_S
    if np.abs(ages_s).max() <= settings.same_time_s:
        return 0.0, 0.0
    return max(float(ages_s.mean()), 0.0), float(ages_s.std())


def _fed_in_turn(
    start: _Tracks, parts: CameraParts, position: Index, span_ns: tuple[int, int], settings: TrackSettings
) -> tuple[Array, Array]:
    """States (T, 9) and covariances at the end of a span, after each camera's boxes at their own times within it.

    ``position`` (M,) is the track of each fused box, -1 for none.
    """
    state, covariance, (now_ns, end_ns) = start.state.copy(), start.covariance.copy(), span_ns
    times = np.full(len(parts.row), end_ns) if parts.captured_at_ns is None else parts.captured_at_ns
    cameras, first = np.unique(parts.camera, return_index=True)
    for row in np.argsort(times[first], kind="stable"):
        at_ns = min(max(int(times[first[row]]), now_ns), end_ns)
        state, covariance = predicted(state, covariance, (at_ns - now_ns) / _NS_PER_S, settings.motion)
        now_ns = at_ns
        own = np.flatnonzero((parts.camera == cameras[row]) & (position[parts.row] >= 0))
        measured, at = parts.boxes.take(own), position[parts.row[own]]
        state[at], covariance[at], _ = corrected(state[at], covariance[at], box_states(measured), measured.covariance)
    return predicted(state, covariance, (end_ns - now_ns) / _NS_PER_S, settings.motion)


def _headed(tracks: _Tracks, opposite: NDArray[np.bool_], boxes: Boxes, settings: TrackSettings) -> _Tracks:
    """Tracks with their front settled: by the motion of those that drive, by the evidence gathered for the others."""
    cap = settings.max_flip_evidence
    evidence = np.clip(tracks.flip_evidence + np.where(opposite, -1.0, 1.0) * boxes.flip_log_odds, -cap, cap)
    speed = tracks.state[:, SPEED]
    sigma = np.sqrt(tracks.covariance[:, SPEED, SPEED])
    drives = np.abs(speed) > np.maximum(settings.heading_speed_mps, settings.heading_sigmas * sigma)
    turns = np.where(drives, speed < 0, evidence < 0)
    state, covariance = turned_about(tracks.state, tracks.covariance, turns)
    kept = np.where(drives, cap, np.abs(evidence))
    return replace(tracks, state=state, covariance=covariance, flip_evidence=kept)
