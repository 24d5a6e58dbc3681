"""The recorded intersection: 3840 labelled LiDAR scans and two pitched roadside cameras, as sites and true boxes.

Each of the two LiDARs has its own calibration of the cameras and its own labels, so each is a site of its own, whose world
is the LiDAR's frame. Labels give the box's centre, height, width and length, and yaw counter-clockwise about z.
"""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import rq

from benchmarks.recordings import recording
from service.geometry.boxes import project_extents
from service.geometry.camera import Camera
from service.geometry.transforms import Array, rigid, wrap_angle

ARCHIVE = "tumtraf_intersection.zip"
LIDARS = ("north", "south")
CAMERAS = ("south1", "south2")
CLASSES = ("CAR", "VAN")
_SEQUENCE_GAP_S = 1.0
_TYPE, _HEIGHT, _WIDTH, _LENGTH, _X, _YAW = 0, 8, 9, 10, 11, 14


@dataclass(frozen=True, eq=False)
class Scan:
    """The cars and vans of one scan."""

    time_s: float
    truth: Array
    """(N, 7) x y z l w h yaw in the LiDAR's frame."""
    cls: NDArray[np.int64]
    """(N,) into ``CLASSES``."""


@dataclass(frozen=True, eq=False)
class Intersection:
    """One LiDAR's scans in order of time, and the cameras in its frame."""

    lidar: str
    cameras: list[Camera]
    scans: list[Scan]


def sequences_of(scans: list[Scan]) -> list[list[Scan]]:
    """Scans in order of time, parted at their gaps."""
    times = np.array([scan.time_s for scan in scans])
    cuts = np.flatnonzero(np.diff(times) > _SEQUENCE_GAP_S) + 1
    return [scans[a:b] for a, b in zip([0, *cuts], [*cuts, len(times)], strict=True)]


def load_intersection(lidar: str) -> Intersection:
    """The recording as seen by one of ``LIDARS``. Raises NotFoundError when it is not there."""
    with zipfile.ZipFile(recording(ARCHIVE)) as archive:
        cameras = [_camera(json.loads(archive.read(_calibration_name(camera))), camera, lidar) for camera in CAMERAS]
        names = sorted(name for name in archive.namelist() if name.endswith(f"_s110_lidar_ouster_{lidar}.txt"))
        return Intersection(lidar, cameras, [_scan(name, archive.read(name).decode("ascii")) for name in names])


def _calibration_name(camera: str) -> str:
    return f"tumtraf_intersection/calib/s110_camera_basler_{camera}_8mm.json"


def _camera(calibration: dict[str, object], name: str, lidar: str) -> Camera:
    """A camera from its projection matrix K [R | t], by RQ decomposition."""
    P = np.array(calibration[f"projection_from_s110_lidar_ouster_{lidar}"])
    K, R = rq(P[:, :3])
    signs = np.sign(np.diag(K))
    K, R = K * signs, signs[:, None] * R
    T = rigid(R, np.linalg.solve(K, P[:, 3]))
    return Camera(name, int(str(calibration["image_width"])), int(str(calibration["image_height"])), K / K[2, 2], T)


def _scan(name: str, text: str) -> Scan:
    seconds, nanoseconds = name.rsplit("/", 1)[1].split("_")[:2]
    rows = [words for words in map(str.split, text.splitlines()) if words and words[_TYPE] in CLASSES]
    numbers = np.array([[float(word) for word in words[_HEIGHT : _YAW + 1]] for words in rows]).reshape(-1, 7)
    dims = numbers[:, [_LENGTH - _HEIGHT, _WIDTH - _HEIGHT, 0]]
    truth = np.concatenate([numbers[:, _X - _HEIGHT : _YAW - _HEIGHT], dims, wrap_angle(numbers[:, 6:])], 1)
    cls = np.array([CLASSES.index(words[_TYPE]) for words in rows], dtype=np.int64)
    return Scan(int(seconds) + 1e-9 * int(nanoseconds), truth, cls)


def wholly_inside(camera: Camera, truth: Array, margin_px: float) -> tuple[Array, NDArray[np.bool_]]:
    """Projected 2D boxes (N, 4) of states (N, 7), and which (N,) lie wholly in the image, ``margin_px`` from its border."""
    xyxy, in_front = project_extents(camera, truth[:, :3], truth[:, 3:6], truth[:, 6])
    limits = np.array([camera.width - 1.0, camera.height - 1.0])
    inside = (xyxy[:, :2] > margin_px).all(1) & (xyxy[:, 2:] < limits - margin_px).all(1)
    return xyxy, in_front & inside
