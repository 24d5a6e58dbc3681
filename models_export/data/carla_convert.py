"""CARLA's left-handed world to ENU and back: the one place where the y axis flips.

CARLA (Unreal): x forward, y right, z up; metres; degrees; yaw turns clockwise seen from above, pitch lifts the nose, roll
dips the right side. Its maps put East along +x and South along +y. ENU mirrors y: ``p_enu = F p`` with ``F = diag(1, -1, 1)``,
and a rotation ``R`` becomes ``F R F``. An actor's own axes turn from forward-right-up to forward-left-up by that.

This module knows numbers only, neither the `carla` package nor files.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from service.geometry.transforms import Array, invert_rigid, rigid, rotation_z, wrap_angle

_FLIP = np.array([1.0, -1.0, 1.0])
# Rows are the axes of a camera (right, down, forward) in an actor's forward-left-up axes: (x, y, z)_cam = (-Y, -Z, X).
# In CARLA's own forward-right-up axes that is (Y, -Z, X).
_R_CAM_ACTOR = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
_LOCKED_COS = 1e-9


@dataclass(frozen=True)
class CarlaPose:
    """Where an actor stands in CARLA's world: metres and degrees, left-handed."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    roll: float = 0.0


def flip_y(vectors: ArrayLike) -> Array:
    """Points or vectors (..., 3) from CARLA's world to ENU, or from ENU to CARLA's world: the same mirror."""
    flipped: Array = np.asarray(vectors, dtype=np.float64) * _FLIP
    return flipped


def rotation_enu(pitch_deg: float, yaw_deg: float, roll_deg: float) -> Array:
    """Rotation (3, 3) from an actor's forward-left-up axes to ENU, of Unreal's angles in degrees.

    Mirroring y reverses yaw and pitch and leaves roll: R = Rz(-yaw) Ry(-pitch) Rx(roll).
    """
    pitch, yaw, roll = np.deg2rad([pitch_deg, yaw_deg, roll_deg])
    cp, sp, cr, sr = np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    nose_up = np.array([[cp, 0.0, -sp], [0.0, 1.0, 0.0], [sp, 0.0, cp]])
    right_down = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    turned: Array = rotation_z(-yaw) @ nose_up @ right_down
    return turned


def pose_enu(pose: CarlaPose) -> Array:
    """``T_enu_actor`` (4, 4): from an actor's forward-left-up axes to ENU with its origin at the map's."""
    return rigid(rotation_enu(pose.pitch, pose.yaw, pose.roll), flip_y([pose.x, pose.y, pose.z]))


def pose_carla(T_enu_actor: ArrayLike) -> CarlaPose:
    """The inverse of :func:`pose_enu`. Where the nose points straight up or down, roll is 0 and yaw takes the whole turn."""
    T = np.asarray(T_enu_actor, dtype=np.float64)
    R = T[:3, :3]
    level = float(np.hypot(R[0, 0], R[1, 0]))
    pitch = np.arctan2(R[2, 0], level)
    if level > _LOCKED_COS:
        yaw, roll = -np.arctan2(R[1, 0], R[0, 0]), np.arctan2(R[2, 1], R[2, 2])
    else:
        yaw, roll = -np.arctan2(-R[0, 1], R[1, 1]), 0.0
    x, y, z = (float(v) for v in flip_y(T[:3, 3]))
    return CarlaPose(x, y, z, *(float(v) for v in np.rad2deg([pitch, yaw, roll])))


def camera_from_enu(pose: CarlaPose) -> Array:
    """``T_cam_enu`` (4, 4) of a camera sensor: (x right, y down, z forward) = (Y, -Z, X) of its left-handed axes."""
    return rigid(_R_CAM_ACTOR, np.zeros(3)) @ invert_rigid(pose_enu(pose))


def camera_pose(T_cam_enu: ArrayLike) -> CarlaPose:
    """The inverse of :func:`camera_from_enu`."""
    return pose_carla(invert_rigid(T_cam_enu) @ rigid(_R_CAM_ACTOR, np.zeros(3)))


def box_enu(pose: CarlaPose, offset: ArrayLike, turn: CarlaPose, extent: ArrayLike) -> tuple[Array, Array, float]:
    """A bounding box in ENU at the map's origin: centre (3,), sizes l, w, h (3,), yaw.

    pose: of the actor. offset (3,), turn (its angles) and extent (3,): CARLA's ``bounding_box`` in the actor's left-handed
    axes, half sizes, metres. The yaw is the heading of the box's forward vector about gravity, [-pi, pi); the tilt of a car
    on a slope is lost, for boxes of this project stand upright.
    """
    T_enu_actor = pose_enu(pose)
    center = T_enu_actor[:3, :3] @ flip_y(offset) + T_enu_actor[:3, 3]
    forward = T_enu_actor[:3, :3] @ rotation_enu(turn.pitch, turn.yaw, turn.roll)[:, 0]
    yaw = float(wrap_angle(np.arctan2(forward[1], forward[0])))
    return center, 2.0 * np.asarray(extent, dtype=np.float64), yaw
