"""KITTI's object files at the boundary: labels, results and calibrations, and the way between them and world boxes.

KITTI gives a box in the camera's frame: location is the *bottom* centre, sizes run height, width, length, ``rotation_y``
turns about the camera's y axis and is 0 along +x. Inside the project boxes live in the world, with yaw about gravity. On a
pitched camera those are different axes: KITTI is an export form here, never the internal one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from service.errors import InputError
from service.geometry.camera import Camera
from service.geometry.transforms import Array, transform_points, wrap_angle

_LABEL_FIELDS = 15
_CALIB_SHAPES = {
    "P0": (3, 4),
    "P1": (3, 4),
    "P2": (3, 4),
    "P3": (3, 4),
    "R0_rect": (3, 3),
    "Tr_velo_to_cam": (3, 4),
    "Tr_imu_to_velo": (3, 4),
}


@dataclass(frozen=True)
class KittiObject:
    """One line of a label or result file, in KITTI's own terms."""

    type: str
    truncated: float
    """Part of the object outside the image, 0..1; -1 where unknown (results)."""
    occluded: int
    """0 visible, 1 partly, 2 largely occluded, 3 unknown; -1 in results."""
    alpha: float
    """Observation angle, radians."""
    bbox_xyxy: tuple[float, float, float, float]
    """2D box in px."""
    dims_hwl: tuple[float, float, float]
    """Height, width, length, metres."""
    location: tuple[float, float, float]
    """Bottom centre in the camera's frame, metres."""
    rotation_y: float
    """Heading about the camera's y axis, radians."""
    score: float | None = None
    """Confidence; results only."""


@dataclass(frozen=True, eq=False)
class KittiCalib:
    """A calibration file. ``P0``..``P3`` (3, 4) project points of the rectified camera frame to px."""

    P0: Array
    P1: Array
    P2: Array
    P3: Array
    R0_rect: Array
    """(3, 3)."""
    Tr_velo_to_cam: Array
    """(3, 4). Scenes of this project have no LiDAR; they put the world in its place: it maps world points to the camera."""
    Tr_imu_to_velo: Array
    """(3, 4)."""


# ------------------------------------------------------------------ boxes


def box_to_kitti(camera: Camera, center: ArrayLike, yaw: ArrayLike, height_m: ArrayLike) -> tuple[Array, Array, Array]:
    """World boxes in KITTI's terms: location (N, 3), rotation_y (N,), alpha (N,).

    center: (N, 3) world, geometric centres, metres. yaw: (N,) radians. height_m: (N,). The heading d in the camera's
    frame gives ``rotation_y = -atan2(d_z, d_x)``; its tilt against the camera's x-z plane is lost.
    """
    center = np.asarray(center, dtype=np.float64).reshape(-1, 3)
    yaw = np.asarray(yaw, dtype=np.float64).reshape(-1)
    bottom = center - 0.5 * np.asarray(height_m, dtype=np.float64).reshape(-1, 1) * [0.0, 0.0, 1.0]
    location = transform_points(camera.T_cam_world, bottom)
    heading = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], -1) @ camera.R_cam_world.T
    rotation_y = -np.arctan2(heading[:, 2], heading[:, 0])
    alpha = wrap_angle(rotation_y - np.arctan2(location[:, 0], location[:, 2]))
    return location, rotation_y, alpha


def kitti_to_box(camera: Camera, location: ArrayLike, rotation_y: ArrayLike, height_m: ArrayLike) -> tuple[Array, Array]:
    """World centres (N, 3) and yaw (N,) of KITTI boxes seen by a camera whose pose is known.

    The inverse of :func:`box_to_kitti` for boxes that stand upright: the heading that KITTI gives within the camera's
    x-z plane is tilted back until it is level in the world. On a level camera that tilt is zero and, looking East,
    ``yaw = -pi/2 - rotation_y``.
    """
    location = np.asarray(location, dtype=np.float64).reshape(-1, 3)
    rotation_y = np.asarray(rotation_y, dtype=np.float64).reshape(-1)
    x, z = np.cos(rotation_y), -np.sin(rotation_y)
    up = camera.R_cam_world[:, 2]
    heading = np.stack([x, -(x * up[0] + z * up[2]) / up[1], z], -1) @ camera.R_cam_world
    yaw = wrap_angle(np.arctan2(heading[:, 1], heading[:, 0]))
    bottom = transform_points(camera.T_world_cam, location)
    return bottom + 0.5 * np.asarray(height_m, dtype=np.float64).reshape(-1, 1) * [0.0, 0.0, 1.0], yaw


def occlusion_level(visible: float) -> int:
    """KITTI's occlusion level of a visible fraction: 0 from 0.85, 1 from 0.5, 2 from 0.15, else 3."""
    return int(np.searchsorted([-0.85, -0.5, -0.15], -visible, side="left"))


# ------------------------------------------------------------------ labels


def write_labels(path: Path, objects: Sequence[KittiObject]) -> None:
    """Write a label file, or a result file when objects have scores."""
    path.write_text("".join(format_object(o) + "\n" for o in objects), "ascii")


def format_object(o: KittiObject) -> str:
    """One object as a line. Angles and metres keep six decimals, finer than KITTI's two, so that reading loses nothing."""
    numbers = (*o.bbox_xyxy, *o.dims_hwl, *o.location, o.rotation_y)
    score = "" if o.score is None else f" {o.score:.6f}"
    return f"{o.type} {o.truncated:.2f} {o.occluded} {o.alpha:.6f} " + " ".join(f"{v:.6f}" for v in numbers) + score


def read_labels(path: Path) -> list[KittiObject]:
    """Objects of a label file (15 columns) or a result file (16, the last being the score).

    Raises InputError naming file and line when a line cannot be an object.
    """
    return [_object(line, f"{path}:{number}") for number, line in enumerate(_text(path).splitlines(), 1) if line.strip()]


def _object(line: str, where: str) -> KittiObject:
    words = line.split()
    if len(words) not in (_LABEL_FIELDS, _LABEL_FIELDS + 1):
        raise InputError(f"{len(words)} columns.", field=where, remedy="A label has 15 columns, a result 16 (score last).")
    values = _floats(words[1:], where)
    if values[1] != int(values[1]) or not -1 <= values[1] <= 3:
        raise InputError(f"occluded is {words[2]}.", field=where, remedy="It is 0, 1, 2 or 3; -1 where unknown.")
    t, o, alpha, x1, y1, x2, y2, h, w, length, x, y, z, rotation_y = values[:14]
    score = values[14] if len(values) == _LABEL_FIELDS else None
    return KittiObject(words[0], t, int(o), alpha, (x1, y1, x2, y2), (h, w, length), (x, y, z), rotation_y, score)


# ------------------------------------------------------------------ calibration


def calib_of(camera: Camera) -> KittiCalib:
    """The calibration of a camera without distortion: P0..P3 = K [I | 0], its pose in ``Tr_velo_to_cam``."""
    if camera.has_distortion:
        raise InputError(
            "KITTI's calibration has no lens distortion.", field=camera.id, remedy="Undistort the images, then export."
        )
    P = np.column_stack([camera.K, np.zeros(3)])
    return KittiCalib(P, P, P, P, np.eye(3), camera.T_cam_world[:3], np.eye(4)[:3])


def write_calib(path: Path, calib: KittiCalib) -> None:
    """Write a calibration file in KITTI's layout."""
    rows = (f"{name}: " + " ".join(f"{v:.12e}" for v in getattr(calib, name).ravel()) for name in _CALIB_SHAPES)
    path.write_text("\n".join(rows) + "\n", "ascii")


def read_calib(path: Path) -> KittiCalib:
    """A calibration file. Raises InputError naming file, line and what is wrong."""
    found: dict[str, NDArray[np.float64]] = {}
    for number, line in enumerate(_text(path).splitlines(), 1):
        name, _, rest = line.partition(":")
        if name.strip() not in _CALIB_SHAPES:
            continue
        where, shape = f"{path}:{number}", _CALIB_SHAPES[name.strip()]
        values = _floats(rest.split(), where)
        if len(values) != shape[0] * shape[1]:
            raise InputError(
                f"{name.strip()} has {len(values)} numbers.", field=where, remedy=f"It has {shape[0]} x {shape[1]}, row by row."
            )
        found[name.strip()] = np.array(values).reshape(shape)
    missing = [name for name in _CALIB_SHAPES if name not in found]
    if missing:
        raise InputError(
            f"no line for {', '.join(missing)}.", field=str(path), remedy="A calibration file gives all seven matrices."
        )
    return KittiCalib(**found)


def _text(path: Path) -> str:
    try:
        return path.read_text("ascii")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read: {error}.", field=str(path), remedy="Give a KITTI text file.") from error


def _floats(words: Sequence[str], where: str) -> list[float]:
    values = []
    for word in words:
        try:
            value = float(word)
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            raise InputError(f"'{word[:40]}' is not a finite number.", field=where, remedy="Mend the line.") from None
        values.append(value)
    return values
