"""How vehicles move, and how a measured box corrects what is known of one: an extended Kalman filter on arrays of tracks.

State (T, 9): x y z l w h yaw as in a box, then speed along the heading (m/s; negative: backwards) and yaw rate (rad/s).
Speed and yaw rate stay what they are but for white acceleration (CTRV: constant turn rate and velocity). A vehicle turns
only while it rolls: towards a stand the yaw rate, and the doubt about the yaw, fade with the speed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.geometry.boxes import STATE_DIM, YAW
from service.geometry.transforms import Array, wrap_angle

MOTION_DIM = STATE_DIM + 2
"""x, y, z, l, w, h, yaw, speed, yaw rate."""
SPEED, YAW_RATE = 7, 8
_DIMS = np.arange(3, 6)
_BOX = slice(0, STATE_DIM)
_DIAGONAL = np.arange(MOTION_DIM)


@dataclass(frozen=True)
class MotionSettings:
    """What vehicles are expected to do."""

    acceleration_sigma: float = 3.0
    """Braking and speeding up, m/s^2 (one sigma)."""
    yaw_acceleration_sigma: float = 0.8
    """Steering, rad/s^2."""
    slip_sigma: float = 0.2
    """Random walk across the heading, metres after one second: lanes are not arcs."""
    climb_sigma: float = 0.3
    """Random walk of the height, metres after one second."""
    size_drift_m: float = 0.05
    """Random walk of the size, metres after one second."""
    yaw_drift_rad: float = 0.02
    """Random walk of the yaw even at a stand, radians after one second."""
    rolling_mps: float = 1.0
    """Speed from which a vehicle turns freely, m/s."""
    birth_speed_sigma: float = 10.0
    """Speed that a new track may have, m/s."""
    birth_yaw_rate_sigma: float = 0.3
    """Yaw rate that a new track may have, rad/s."""


def newborn(box_state: Array, box_covariance: Array, age_s: float, settings: MotionSettings) -> tuple[Array, Array]:
    """States (T, 9) and covariances (T, 9, 9) of boxes (T, 7), (T, 7, 7) seen for the first time, ``age_s`` seconds ago.

    They count as at rest, with a speed that nobody knows.
    """
    count = len(box_state)
    state, covariance = np.zeros((count, MOTION_DIM)), np.zeros((count, MOTION_DIM, MOTION_DIM))
    state[:, _BOX], covariance[:, _BOX, _BOX] = box_state, box_covariance
    covariance[:, SPEED, SPEED] = settings.birth_speed_sigma**2
    covariance[:, YAW_RATE, YAW_RATE] = settings.birth_yaw_rate_sigma**2
    way = np.full(count, settings.birth_speed_sigma * age_s)
    _add_along(covariance, np.cos(state[:, YAW]), np.sin(state[:, YAW]), way * way)
    return state, covariance


def predicted(state: Array, covariance: Array, elapsed_s: float, settings: MotionSettings) -> tuple[Array, Array]:
    """States (T, 9) and covariances (T, 9, 9) ``elapsed_s`` >= 0 seconds later."""
    if elapsed_s == 0.0 or len(state) == 0:
        return state, covariance
    speed, rate = state[:, SPEED], state[:, YAW_RATE]
    speed_variance = covariance[:, SPEED, SPEED]
    rolling = np.minimum((speed * speed + speed_variance) / settings.rolling_mps**2, 1.0)
    # The heading half-way: exact for a straight line, and to second order in the turn.
    middle = state[:, YAW] + 0.5 * elapsed_s * rate
    c, s = np.cos(middle), np.sin(middle)
    way = elapsed_s * speed
    F = np.zeros((len(state), MOTION_DIM, MOTION_DIM))
    F[:, _DIAGONAL, _DIAGONAL] = 1.0
    F[:, 0, YAW], F[:, 1, YAW] = -way * s, way * c
    F[:, 0, SPEED], F[:, 1, SPEED] = elapsed_s * c, elapsed_s * s
    F[:, 0, YAW_RATE], F[:, 1, YAW_RATE] = -0.5 * elapsed_s * way * s, 0.5 * elapsed_s * way * c
    F[:, YAW, YAW_RATE] = elapsed_s
    F[:, YAW_RATE, YAW_RATE] = rolling
    later = state.copy()
    later[:, 0] += way * c
    later[:, 1] += way * s
    later[:, YAW] = wrap_angle(state[:, YAW] + elapsed_s * rate)
    later[:, YAW_RATE] = rolling * rate
    noise = _noise(c, s, rolling, elapsed_s, settings)
    # Second order: an unknown speed along an uncertain heading. Linearised at a stand the filter would not see it.
    _add_along(noise, -s, c, elapsed_s**2 * speed_variance * np.minimum(covariance[:, YAW, YAW], 1.0))
    return later, F @ covariance @ F.transpose(0, 2, 1) + noise


def _noise(c: Array, s: Array, rolling: Array, elapsed_s: float, settings: MotionSettings) -> Array:
    """Covariances (T, 9, 9) of what vehicles with headings of cosine c and sine s (T,) do by themselves in ``elapsed_s``."""
    push = np.zeros((len(c), MOTION_DIM))
    reach = settings.acceleration_sigma * elapsed_s
    push[:, 0], push[:, 1], push[:, SPEED] = 0.5 * elapsed_s * reach * c, 0.5 * elapsed_s * reach * s, reach
    noise = push[:, :, None] * push[:, None, :]
    turn = settings.yaw_acceleration_sigma * elapsed_s * rolling
    noise[:, YAW, YAW] = 0.25 * elapsed_s**2 * turn**2 + settings.yaw_drift_rad**2 * elapsed_s
    noise[:, YAW, YAW_RATE] = noise[:, YAW_RATE, YAW] = 0.5 * elapsed_s * turn**2
    noise[:, YAW_RATE, YAW_RATE] = turn**2
    noise[:, 2, 2] = settings.climb_sigma**2 * elapsed_s
    noise[:, _DIMS, _DIMS] = settings.size_drift_m**2 * elapsed_s
    _add_along(noise, -s, c, settings.slip_sigma**2 * elapsed_s * rolling)
    return noise


def _add_along(noise: Array, x: Array, y: Array, variance: Array) -> None:
    """Add variance (T,) of the position along directions (x, y), in place."""
    noise[:, 0, 0] += variance * x * x
    noise[:, 1, 1] += variance * y * y
    noise[:, 0, 1] += variance * x * y
    noise[:, 1, 0] += variance * x * y


def corrected(
    state: Array, covariance: Array, measured: Array, measured_covariance: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Tracks after measured boxes (T, 7), (T, 7, 7), row by row.

    Returns states (T, 9), covariances (T, 9, 9), and whether the measured heading was opposite (T,). A measured yaw counts as
    an axis; which of its ends is the front is settled elsewhere.
    """
    innovation = measured - state[:, _BOX]
    turn = wrap_angle(innovation[:, YAW])
    opposite: NDArray[np.bool_] = np.abs(turn) > 0.5 * np.pi
    innovation[:, YAW] = np.where(opposite, wrap_angle(turn + np.pi), turn)
    cross = covariance[:, :, _BOX]
    gain = cross @ np.linalg.inv(covariance[:, _BOX, _BOX] + measured_covariance)
    moved = state + (gain @ innovation[..., None])[..., 0]
    moved[:, YAW] = wrap_angle(moved[:, YAW])
    left = covariance - gain @ cross.transpose(0, 2, 1)
    return moved, 0.5 * (left + left.transpose(0, 2, 1)), opposite


def turned_about(state: Array, covariance: Array, turns: NDArray[np.bool_]) -> tuple[Array, Array]:
    """The same motion seen from the other end where ``turns`` (T,) is True: yaw by pi, and the speed's sign."""
    sign = np.where(turns, -1.0, 1.0)
    about = state.copy()
    about[:, YAW] = wrap_angle(state[:, YAW] + np.where(turns, np.pi, 0.0))
    about[:, SPEED] *= sign
    swapped = covariance.copy()
    swapped[:, SPEED, :] *= sign[:, None]
    swapped[:, :, SPEED] *= sign[:, None]
    return about, swapped


def blurred(state: Array, covariance: Array, spread_s: float) -> Array:
    """Covariances (T, 9, 9) of where vehicles were at times that vary by ``spread_s`` (one sigma), seconds."""
    wider = covariance.copy()
    way = spread_s * state[:, SPEED]
    _add_along(wider, np.cos(state[:, YAW]), np.sin(state[:, YAW]), way * way)
    return wider


def velocity(state: Array) -> Array:
    """World velocities (T, 3) of states (T, 9), m/s; along the ground."""
    return np.stack([state[:, SPEED] * np.cos(state[:, YAW]), state[:, SPEED] * np.sin(state[:, YAW]), np.zeros(len(state))], 1)
