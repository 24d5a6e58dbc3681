"""Real recordings beside the checkout: where they lie, and the roadside clip as a site.

The recordings are not part of the project. ``QUADLIFT_DATA`` names their folder; the default is ``shared/data`` beside the
checkout.
"""

from __future__ import annotations

import json
import os
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import NotFoundError
from service.geometry.boxes import clip_extents, project_extents
from service.geometry.camera import Camera
from service.geometry.transforms import Array, invert_rigid, rigid, transform_points, wrap_angle
from service.site import Site, parse_site

DEFAULT_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
ROADSIDE_CLIP = "tumtraf_clip.zip"
PANDASET_CLIP = "pandaset_clip.zip"
ROADSIDE_STEPS = tuple(range(5, 78, 6))
"""Steps of the roadside protocol: 5, 11, ... 77."""
NOT_VEHICLES = frozenset({"PEDESTRIAN", "BICYCLE", "MOTORCYCLE"})
MIN_INSIDE, MIN_HEIGHT_PX = 0.4, 15.0


def recording(name: str) -> Path:
    """The path of a recording. Raises NotFoundError that says where it was looked for."""
    path = Path(os.environ.get("QUADLIFT_DATA", DEFAULT_DATA)) / name
    if not path.is_file():
        raise NotFoundError("no such recording.", field=str(path), remedy="Set QUADLIFT_DATA to the folder that holds it.")
    return path


@dataclass(frozen=True, eq=False)
class RoadsideClip:
    """Three real roadside cameras, 78 steps at 10 Hz, with the tracks of a LiDAR and camera system as reference."""

    site: Site
    tracks: list[list[dict[str, Any]]]
    """Reference tracks a step, in the LiDAR's frame."""
    T_world_lidar: Array
    """(4, 4); the world has its origin on the road below the LiDAR and z up."""
    path: Path

    def frame(self, camera_id: str, step: int) -> bytes:
        """The JPEG of a camera at a step."""
        with zipfile.ZipFile(self.path) as archive:
            return archive.read(f"tumtraf_clip/{camera_id}/{step:06d}.jpg")

    def reference(self, step: int) -> tuple[Array, Array, Array]:
        """Vehicles of a step in the world: centres (N, 3), length width height (N, 3), yaw (N,)."""
        rows = [t for t in self.tracks[step] if t["class_name"] not in NOT_VEHICLES]
        dims = np.array([[t["l"], t["w"], t["h"]] for t in rows], dtype=np.float64).reshape(-1, 3)
        bottom = np.array([[t["x"], t["y"], t["z"]] for t in rows], dtype=np.float64).reshape(-1, 3)
        center = transform_points(self.T_world_lidar, bottom + dims * [0.0, 0.0, 0.5])
        # The recording turns its boxes clockwise; the LiDAR stands level, so yaw keeps its meaning in the world.
        return center, dims, wrap_angle([-t["yaw"] for t in rows])

    def reference_classes(self, step: int) -> tuple[str, ...]:
        """The recording's class of each vehicle of :meth:`reference`, in its order."""
        return tuple(t["class_name"] for t in self.tracks[step] if t["class_name"] not in NOT_VEHICLES)

    def reference_2d(self, camera_id: str, step: int) -> Array:
        """Image boxes (N, 4) of the reference vehicles that the protocol counts in a camera."""
        camera = self.site.camera(camera_id)
        shown, is_inside = shown_extents(camera, *self.reference(step))
        tall = shown[:, 3] - shown[:, 1] >= MIN_HEIGHT_PX
        return shown[is_inside & tall]


def shown_extents(camera: Camera, center: Array, dims_lwh: Array, yaw: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Image boxes (N, 4) of boxes in the world, clipped to the image, px; and which (N,) the protocol takes as shown.

    These lie before the camera with all corners, and with more than ``MIN_INSIDE`` of their area in the image.
    """
    extents, in_front = project_extents(camera, center, dims_lwh, yaw)
    clipped = clip_extents(camera, extents)
    area = np.prod(clipped[:, 2:] - clipped[:, :2], axis=1)
    full = np.maximum(np.prod(extents[:, 2:] - extents[:, :2], axis=1), 1e-9)
    return clipped, in_front & (area / full > MIN_INSIDE)


def open_roadside_clip() -> RoadsideClip:
    """The roadside clip with its calibration as a site. Raises NotFoundError when it is not there."""
    path = recording(ROADSIDE_CLIP)
    with zipfile.ZipFile(path) as archive:
        calibration = json.loads(archive.read("tumtraf_clip/calibration.json"))
        frames = json.loads(archive.read("tumtraf_clip/tracks.json"))["frames"]
    tracks = [frame["tracks"] for frame in frames]
    road = _road_height(tracks)
    T_world_lidar = rigid(np.eye(3), [0.0, 0.0, -road])
    return RoadsideClip(parse_site(site_from_calibration(calibration, T_world_lidar)), tracks, T_world_lidar, path)


def site_from_calibration(calibration: dict[str, Any], T_world_lidar: Array) -> dict[str, Any]:
    """The site document of the clip's calibration: K, and R, t from the LiDAR, which becomes the world's frame."""
    cameras = []
    for camera_id, entry in calibration.items():
        T_cam_lidar = rigid(entry["R"], entry["t"])
        width, height = entry["image_size"]
        T_cam_world = T_cam_lidar @ invert_rigid(T_world_lidar)
        cameras.append(
            {"id": camera_id, "width": width, "height": height, "K": entry["K"], "T_cam_world": T_cam_world.tolist()}
        )
    return {"id": "tumtraf", "cameras": cameras}


def _road_height(tracks: list[list[dict[str, Any]]]) -> float:
    """Median height of the vehicles' bottoms: the recording names no ground."""
    bottoms = [t["z"] for step in tracks for t in step if t["class_name"] not in NOT_VEHICLES]
    return float(np.median(bottoms))
