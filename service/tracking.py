"""Tracking: identities, velocities and headings over time, one tracker a site.

A constant-velocity Kalman filter in x, y, z with real time steps; size and yaw are filtered beside it, yaw on the circle.
All tracks are advanced and updated at once as arrays.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from service.association import Index, gated_assignment, mahalanobis_cost
from service.fusion import FusedBoxes
from service.geometry.boxes import STATE_DIM, Boxes
from service.geometry.transforms import Array, wrap_angle

_POSITION, _VELOCITY = slice(0, 3), slice(3, 6)
_NS_PER_S = 1e9


@dataclass(frozen=True)
class TrackSettings:
    """Tuning of the tracker."""

    gate: float = 9.21
    """Largest squared Mahalanobis distance of a match: 99 % of a chi-square with 2 degrees of freedom."""
    max_distance_m: float = 4.0
    """Farthest that a box may lie from where its track was expected, metres."""
    lost_after_s: float = 1.0
    """A track that nothing matched for this long is dropped; until then it coasts, unreported."""
    acceleration_sigma: float = 3.0
    """Manoeuvres along the ground that the filter expects, m/s^2."""
    climb_sigma: float = 0.3
    """The same for the vertical, m/s^2."""
    birth_speed_sigma: float = 10.0
    """Speed that a new track may have, m/s (one sigma)."""
    size_drift_m: float = 0.05
    """Random walk of the size, metres after one second."""
    yaw_drift_rad: float = 0.5
    """Random walk of the yaw, radians after one second."""
    heading_speed_mps: float = 1.0
    """Above this speed a vehicle's heading follows its velocity; below, its past heading."""
    heading_sigmas: float = 4.0
    """The speed must also stand out from its own uncertainty by this factor: jitter of a new track is no motion."""
    max_flip_evidence: float = 6.0
    """Cap on the log-odds that a track gathers for its direction, so that it can change its mind."""


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


@dataclass(frozen=True, eq=False)
class _Tracks:
    """T tracks; every array has T rows."""

    number: Index
    state: Array
    """(T, 6) x y z vx vy vz."""
    covariance: Array
    """(T, 6, 6)."""
    dims: Array
    dims_covariance: Array
    yaw: Array
    yaw_variance: Array
    flip_evidence: Array
    """(T,) log-odds gathered for ``yaw`` against ``yaw + pi``; never negative."""
    unseen_s: Array

    def take(self, index: Index | NDArray[np.bool_]) -> _Tracks:
        return _Tracks(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def joined(self, other: _Tracks) -> _Tracks:
        return _Tracks(**{f.name: np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)})


class Tracker:
    """The tracks of one site. Not thread-safe: one caller, in the order of capture."""

    def __init__(self, settings: TrackSettings | None = None) -> None:
        self._settings = settings or TrackSettings()
        self._tracks = _born(Boxes.empty(), 1, self._settings)
        self._next_number = 1
        self._last_ns: int | None = None

    def update(self, fused: FusedBoxes, captured_at_ns: int) -> TrackedBoxes:
        """Take the boxes of one frame set captured at ``captured_at_ns`` (UTC) and give them back tracked.

        Every box comes back at once, new ones under a new id. A capture time before the last one counts as the same time.
        """
        elapsed_s = 0.0 if self._last_ns is None else max(0.0, (captured_at_ns - self._last_ns) / _NS_PER_S)
        self._last_ns = captured_at_ns
        tracks = _advance(self._tracks, elapsed_s, self._settings)
        tracks = tracks.take(tracks.unseen_s <= self._settings.lost_after_s)
        boxes = fused.boxes
        rows, columns = self._match(boxes, tracks)
        fresh = np.setdiff1d(np.arange(len(boxes)), rows)
        born = _born(boxes.take(fresh), self._next_number, self._settings)
        self._next_number += len(fresh)
        seen = _corrected(tracks.take(columns), boxes.take(rows), self._settings).joined(born)
        coasting = tracks.take(np.setdiff1d(np.arange(len(tracks.number)), columns))
        self._tracks = seen.joined(coasting)
        in_order = seen.take(np.argsort(np.concatenate([rows, fresh])))
        return TrackedBoxes(
            _filtered(boxes, in_order), fused.members, [str(number) for number in in_order.number], in_order.state[:, _VELOCITY]
        )

    def _match(self, boxes: Boxes, tracks: _Tracks) -> tuple[Index, Index]:
        distance_sq, cost, distance_m = mahalanobis_cost(
            boxes.center[:, :2], boxes.covariance[:, :2, :2], tracks.state[:, :2], tracks.covariance[:, :2, :2]
        )
        return gated_assignment(distance_sq, cost, distance_m, self._settings.gate, self._settings.max_distance_m)


def _born(boxes: Boxes, first_number: int, settings: TrackSettings) -> _Tracks:
    """New tracks, at rest but with a speed that nobody knows."""
    count = len(boxes)
    covariance = np.zeros((count, 6, 6))
    covariance[:, _POSITION, _POSITION] = boxes.covariance[:, :3, :3]
    covariance[:, _VELOCITY, _VELOCITY] = np.diag([settings.birth_speed_sigma**2] * 2 + [settings.climb_sigma**2])
    return _Tracks(
        number=first_number + np.arange(count),
        state=np.concatenate([boxes.center, np.zeros((count, 3))], 1),
        covariance=covariance,
        dims=boxes.dims_lwh,
        dims_covariance=boxes.covariance[:, 3:6, 3:6],
        yaw=wrap_angle(boxes.yaw + np.where(boxes.flip_log_odds < 0, np.pi, 0.0)),
        yaw_variance=boxes.covariance[:, 6, 6],
        flip_evidence=np.minimum(np.abs(boxes.flip_log_odds), settings.max_flip_evidence),
        unseen_s=np.zeros(count),
    )


def _advance(tracks: _Tracks, elapsed_s: float, settings: TrackSettings) -> _Tracks:
    """Tracks ``elapsed_s`` later: constant velocity, white acceleration."""
    F = np.eye(6)
    F[_POSITION, _VELOCITY] = elapsed_s * np.eye(3)
    sigma = np.array([settings.acceleration_sigma] * 2 + [settings.climb_sigma])
    reach = np.concatenate([np.diag(0.5 * elapsed_s**2 * sigma), np.diag(elapsed_s * sigma)])
    return _Tracks(
        number=tracks.number,
        state=tracks.state @ F.T,
        covariance=F @ tracks.covariance @ F.T + reach @ reach.T,
        dims=tracks.dims,
        dims_covariance=tracks.dims_covariance + settings.size_drift_m**2 * elapsed_s * np.eye(3),
        yaw=tracks.yaw,
        yaw_variance=tracks.yaw_variance + settings.yaw_drift_rad**2 * elapsed_s,
        flip_evidence=tracks.flip_evidence,
        unseen_s=tracks.unseen_s + elapsed_s,
    )


def _corrected(tracks: _Tracks, boxes: Boxes, settings: TrackSettings) -> _Tracks:
    """Tracks after their boxes, row by row."""
    state, covariance = _kalman(tracks.state, tracks.covariance, boxes.center, boxes.covariance[:, :3, :3])
    dims, dims_covariance = _kalman(tracks.dims, tracks.dims_covariance, boxes.dims_lwh, boxes.covariance[:, 3:6, 3:6])
    turn = wrap_angle(boxes.yaw - tracks.yaw)
    flipped = np.abs(turn) > np.pi / 2
    axis_turn = np.where(flipped, wrap_angle(turn + np.pi), turn)
    gain = tracks.yaw_variance / (tracks.yaw_variance + boxes.covariance[:, 6, 6])
    yaw = tracks.yaw + gain * axis_turn
    cap = settings.max_flip_evidence
    evidence = np.clip(tracks.flip_evidence + np.where(flipped, -1.0, 1.0) * boxes.flip_log_odds, -cap, cap)
    reverse = evidence < 0
    along = state[:, 3] * np.cos(yaw) + state[:, 4] * np.sin(yaw)
    drives = _drives(state, covariance, settings)
    reverse = np.where(drives, along < 0, reverse)
    return _Tracks(
        number=tracks.number,
        state=state,
        covariance=covariance,
        dims=dims,
        dims_covariance=dims_covariance,
        yaw=wrap_angle(yaw + np.where(reverse, np.pi, 0.0)),
        yaw_variance=(1.0 - gain) * tracks.yaw_variance,
        flip_evidence=np.where(drives, cap, np.abs(evidence)),
        unseen_s=np.zeros(len(boxes)),
    )


def _drives(state: Array, covariance: Array, settings: TrackSettings) -> NDArray[np.bool_]:
    """Which tracks (T,) move fast enough, beyond doubt, for their velocity to tell their heading."""
    speed = np.hypot(state[:, 3], state[:, 4])
    sigma = np.sqrt(0.5 * (covariance[:, 3, 3] + covariance[:, 4, 4]))
    return (speed > settings.heading_speed_mps) & (speed > settings.heading_sigmas * sigma)


def _kalman(state: Array, covariance: Array, measured: Array, measured_covariance: Array) -> tuple[Array, Array]:
    """Kalman update of states (T, D) by measurements (T, 3) of their first three components."""
    seen = measured.shape[1]
    gain = covariance[:, :, :seen] @ np.linalg.inv(covariance[:, :seen, :seen] + measured_covariance)
    moved = state + (gain @ (measured - state[:, :seen])[..., None])[..., 0]
    # Joseph's form: stays symmetric and positive definite for any gain.
    keep = np.eye(state.shape[1]) - np.pad(gain, ((0, 0), (0, 0), (0, state.shape[1] - seen)))
    left = keep @ covariance @ keep.transpose(0, 2, 1) + gain @ measured_covariance @ gain.transpose(0, 2, 1)
    return moved, left


def _filtered(boxes: Boxes, tracks: _Tracks) -> Boxes:
    """The boxes with their tracks' position, size and yaw."""
    covariance = np.zeros((len(boxes), STATE_DIM, STATE_DIM))
    covariance[:, :3, :3] = tracks.covariance[:, _POSITION, _POSITION]
    covariance[:, 3:6, 3:6] = tracks.dims_covariance
    covariance[:, 6, 6] = tracks.yaw_variance
    return Boxes(
        center=tracks.state[:, _POSITION],
        dims_lwh=tracks.dims,
        yaw=tracks.yaw,
        score=boxes.score,
        cls=boxes.cls,
        covariance=covariance,
        flip_log_odds=tracks.flip_evidence,
    )
