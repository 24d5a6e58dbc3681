"""A PandaSet drive in one zip: frames of several moving cameras, their poses, cuboids as boxes of our convention.

A cuboid's ``dimensions_xyz`` are width, length and height, and its yaw is 0 where its front points along +y of the world: our
yaw is a quarter turn more. A camera's pose (position, quaternion w x y z) maps the camera to the world.

Cuboids are of the LiDAR's sweep, frames of the camera's own shutter, up to 50 ms apart: at 10 m/s that is half a metre.
"""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import InputError, NotFoundError
from service.geometry.camera import Camera
from service.geometry.transforms import Array, invert_rigid, rigid, wrap_angle

VEHICLE_CLASSES = {
    "Car": "car",
    "Pickup Truck": "car",
    "Medium-sized Truck": "truck",
    "Semi-truck": "truck",
    "Bus": "bus",
}
"""Our class of each label that is a vehicle. PandaSet calls vans cars, and a pickup is built and driven like one."""
VEHICLE_LIKE = frozenset(
    {
        "Emergency Vehicle",
        "Other Vehicle - Construction Vehicle",
        "Other Vehicle - Uncommon",
        "Towed Object",
        "Train",
        "Trolley",
        "Tram / Subway",
    }
)
"""Labels that resemble vehicles too much to call a box on one false, and too little to ask for one."""
_NO_SIBLING = "-"


@dataclass(frozen=True, eq=False)
class PandasetBoxes:
    """The cuboids of one step, each object once; every array has N rows."""

    center: Array
    """(N, 3) geometric centres in the drive's world, metres."""
    dims_lwh: Array
    """(N, 3) length, width, height, metres."""
    yaw: Array
    """(N,) heading, radians counter-clockwise about +z from +x, in [-pi, pi)."""
    labels: tuple[str, ...]
    """PandaSet's own labels."""
    ids: tuple[str, ...]
    """Identities over the steps."""

    def __len__(self) -> int:
        return len(self.yaw)

    def take(self, rows: NDArray[np.bool_]) -> PandasetBoxes:
        """The boxes where ``rows`` (N,) is true."""
        chosen = np.flatnonzero(rows).tolist()
        labels, ids = (tuple(names[row] for row in chosen) for names in (self.labels, self.ids))
        return PandasetBoxes(self.center[rows], self.dims_lwh[rows], self.yaw[rows], labels, ids)


@dataclass(frozen=True, eq=False)
class PandasetClip:
    """One drive."""

    path: Path
    root: str
    """The folder inside the zip."""
    calibration: dict[str, dict[str, Any]]
    """``cameras.json``: intrinsics, poses and capture times (seconds since 1970) by camera."""

    @property
    def camera_ids(self) -> tuple[str, ...]:
        """The cameras, in alphabetical order."""
        return tuple(sorted(self.calibration))

    @property
    def steps(self) -> int:
        """How many steps every camera has."""
        return min(len(entry["poses_world_camera"]) for entry in self.calibration.values())

    def camera(self, camera_id: str, step: int) -> Camera:
        """A camera as it stood at a step: the vehicle that carries it moves."""
        entry = self.calibration[camera_id]
        pose = entry["poses_world_camera"][step]
        K = np.array([[entry["fx"], 0.0, entry["cx"]], [0.0, entry["fy"], entry["cy"]], [0.0, 0.0, 1.0]])
        position = [pose["position"][axis] for axis in "xyz"]
        T_world_cam = rigid(rotation_of([pose["heading"][part] for part in "wxyz"]), position)
        return Camera(camera_id, entry["width"], entry["height"], K, invert_rigid(T_world_cam))

    def frame_bytes(self, camera_id: str, step: int) -> bytes:
        """The JPEG of a camera at a step."""
        return self._read(f"images/{camera_id}/{step:02d}.jpg")

    def boxes(self, step: int) -> PandasetBoxes:
        """All objects of a step, of every label, each once."""
        return boxes_of(json.loads(self._read(f"cuboids/{step:02d}.json")))

    def _read(self, name: str) -> bytes:
        with zipfile.ZipFile(self.path) as archive:
            return archive.read(f"{self.root}/{name}")


def open_pandaset(path: Path) -> PandasetClip:
    """A drive's zip. Raises NotFoundError when there is none, InputError when it is not a PandaSet drive."""
    if not path.is_file():
        raise NotFoundError("no such recording.", field=str(path), remedy="Give the zip of a PandaSet drive.")
    try:
        with zipfile.ZipFile(path) as archive:
            (name,) = (name for name in archive.namelist() if name.endswith("cameras.json"))
            calibration = json.loads(archive.read(name))
    except (zipfile.BadZipFile, ValueError) as error:
        raise InputError(f"{error}.", field=str(path), remedy="Give a zip with one cameras.json.") from error
    return PandasetClip(path, name.removesuffix("/cameras.json"), calibration)


def boxes_of(cuboids: list[dict[str, Any]]) -> PandasetBoxes:
    """The boxes of a step's cuboids. Where both LiDARs have an object, the first one's cuboid stands for it."""
    rank = {cuboid["uuid"]: (cuboid["sensor_id"], cuboid["uuid"]) for cuboid in cuboids}
    rows = [c for c in cuboids if c["sibling_id"] == _NO_SIBLING or rank[c["uuid"]] < rank.get(c["sibling_id"], (np.inf, ""))]
    dims_wlh = np.array([c["dimensions_xyz"] for c in rows], dtype=np.float64).reshape(-1, 3)
    return PandasetBoxes(
        center=np.array([c["center_xyz"] for c in rows], dtype=np.float64).reshape(-1, 3),
        dims_lwh=dims_wlh[:, [1, 0, 2]],
        yaw=wrap_angle(np.array([c["yaw"] for c in rows], dtype=np.float64) + np.pi / 2),
        labels=tuple(c["label"] for c in rows),
        ids=tuple(c["uuid"] for c in rows),
    )


def rotation_of(quaternion_wxyz: list[float]) -> Array:
    """The rotation matrix (3, 3) of a quaternion w, x, y, z, which need not have length one."""
    w, x, y, z = np.asarray(quaternion_wxyz, dtype=np.float64) / np.linalg.norm(quaternion_wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
