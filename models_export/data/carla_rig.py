"""A rig: where to put cameras in a CARLA map. Read from a file in the form of ``site.json`` with a few additions.

A camera is given either as in a site, by ``K`` and ``T_cam_world``, with "world" standing for the anchor's frame (x forward,
y left, z up); or as CARLA has it, by ``fov_deg``, ``location`` (x, y, z) and ``rotation`` (pitch, yaw, roll) in the map. The
anchor, a point on the ground given in the map's coordinates with a yaw, becomes the origin of the written site. The site's
axes are East, North and up whatever the anchor's yaw is, which only turns the cameras that are given relative to it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from models_export.data.carla_convert import CarlaPose, camera_from_enu, camera_pose, flip_y, pose_enu
from models_export.data.carla_images import field_of_view_deg, intrinsics
from service.errors import CalibrationError
from service.geometry.camera import Camera
from service.geometry.transforms import Array, rigid
from service.site import (
    ID_PATTERN,
    MAX_SIDE_PX,
    AccuracyModel,
    CameraModel,
    Finite,
    GroundModel,
    OriginModel,
    Site,
    parse_site,
    site_document,
)

_K_TOLERANCE_PX = 1e-3
_REMEDY = "See docs/carla.md for the form of a rig."

Model = TypeVar("Model", bound=BaseModel)


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")


class AnchorModel(_Strict):
    """The rig's origin in the map: metres and degrees, CARLA's axes."""

    x: Finite = 0.0
    y: Finite = 0.0
    z: Finite = 0.0
    yaw: Finite = 0.0


class LocationModel(_Strict):
    """A point of the map, metres."""

    x: Finite
    y: Finite
    z: Finite


class RotationModel(_Strict):
    """Unreal's angles, degrees."""

    pitch: Finite = 0.0
    yaw: Finite = 0.0
    roll: Finite = 0.0


class MapCameraModel(_Strict):
    """A camera in the map's coordinates."""

    id: Annotated[str, Field(pattern=ID_PATTERN)]
    width: Annotated[int, Field(ge=16, le=MAX_SIDE_PX)]
    height: Annotated[int, Field(ge=16, le=MAX_SIDE_PX)]
    fov_deg: Annotated[float, Field(gt=1, lt=170)]
    location: LocationModel
    rotation: RotationModel = Field(default_factory=RotationModel)


class RigModel(_Strict):
    """The form of a rig's file."""

    id: Annotated[str, Field(pattern=ID_PATTERN)]
    map: str | None = None
    anchor: AnchorModel = Field(default_factory=AnchorModel)
    ground: GroundModel = Field(default_factory=GroundModel)
    origin: OriginModel | None = None
    accuracy: AccuracyModel = Field(default_factory=AccuracyModel)
    cameras: Annotated[list[dict[str, Any]], Field(min_length=1, max_length=64)]


@dataclass(frozen=True, eq=False)
class Mount:
    """One camera as CARLA gets it."""

    camera: Camera
    """In the site's frame."""
    pose: CarlaPose
    """In the map."""
    fov_deg: float
    """Horizontal field of view."""


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras to put into a map, and the site that they make."""

    site: Site
    """World: East, North, up at the anchor."""
    mounts: tuple[Mount, ...]
    """In the order of the site's cameras."""
    anchor: CarlaPose
    """Origin of the site in the map; only its position matters to the site."""
    map: str | None
    """Name of the map that the rig was made for, such as ``Town05``."""
    has_origin: bool
    """Whether the file gave the site's position on the globe."""

    def to_site(self, points_enu: Array) -> Array:
        """Points (..., 3) in ENU at the map's origin, moved into the site's world."""
        return points_enu - flip_y([self.anchor.x, self.anchor.y, self.anchor.z])


def load_rig(path: Path) -> Rig:
    """Read a rig. Raises CalibrationError naming the file or the field."""
    try:
        document = json.loads(path.read_text("utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise CalibrationError(f"cannot be read: {error}.", field=str(path), remedy="Check the file.") from error
    return parse_rig(document)


def parse_rig(document: Any) -> Rig:
    """A rig from parsed JSON. Raises CalibrationError naming the field, its value and a remedy."""
    model = _validated(RigModel, document, "")
    anchor = CarlaPose(model.anchor.x, model.anchor.y, model.anchor.z, yaw=model.anchor.yaw)
    mounts = [_mount(camera, anchor, f"cameras.{index}") for index, camera in enumerate(model.cameras)]
    # Through the site's own reader, which looks at ids, matrices and the ground.
    draft = site_document(Site(model.id, tuple(mount.camera for mount in mounts)))
    draft["ground"] = model.ground.model_dump()
    draft["origin"] = (model.origin or OriginModel()).model_dump()
    draft["accuracy"] = model.accuracy.model_dump()
    site = parse_site(draft)
    pairs = zip(site.cameras, mounts, strict=True)
    mounted = tuple(Mount(camera, mount.pose, mount.fov_deg) for camera, mount in pairs)
    return Rig(site, mounted, anchor, model.map, model.origin is not None)


def _mount(document: dict[str, Any], anchor: CarlaPose, where: str) -> Mount:
    origin = rigid(np.eye(3), flip_y([anchor.x, anchor.y, anchor.z]))
    if "T_cam_world" in document:
        model = _validated(CameraModel, document, where)
        # The site's reader refuses matrices that are no camera's before anything is computed from them.
        given = _site_camera(document, where)
        pose = camera_pose(given.T_cam_world @ np.linalg.inv(pose_enu(anchor)))
        fov_deg = _fov_of(model, where)
        width, height = model.width, model.height
    else:
        seen = _validated(MapCameraModel, document, where)
        at, turn = seen.location, seen.rotation
        pose = CarlaPose(at.x, at.y, at.z, turn.pitch, turn.yaw, turn.roll)
        fov_deg, width, height = seen.fov_deg, seen.width, seen.height
    K = intrinsics(width, height, fov_deg)
    return Mount(Camera(document["id"], width, height, K, camera_from_enu(pose) @ origin), pose, fov_deg)


def _site_camera(document: dict[str, Any], where: str) -> Camera:
    try:
        return parse_site({"id": "rig", "cameras": [document]}).cameras[0]
    except CalibrationError as error:
        field = (error.field or "").replace("cameras.0", where, 1)
        raise CalibrationError(error.message, field=field, remedy=error.remedy) from None


def _fov_of(model: CameraModel, where: str) -> float:
    """The field of view that gives a camera's K. Raises CalibrationError where CARLA has no such camera."""
    fov_deg = field_of_view_deg(model.width, model.K[0][0])
    expected = intrinsics(model.width, model.height, fov_deg)
    if np.abs(np.array(model.K) - expected).max() > _K_TOLERANCE_PX:
        raise CalibrationError(
            f"{model.K} is not a camera that CARLA has: it draws square pixels about the middle of the picture.",
            field=f"{where}.K",
            remedy=f"For this focal length it is {expected.tolist()}.",
        )
    if any(model.distortion):
        raise CalibrationError(
            f"{model.distortion}: cameras here have no lens distortion.", field=f"{where}.distortion", remedy="Leave it empty."
        )
    return fov_deg


def _validated(kind: type[Model], document: Any, where: str) -> Model:
    try:
        return kind.model_validate(document)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join([*([where] if where else []), *(str(part) for part in first["loc"])]) or "rig"
        raise CalibrationError(f"{first['msg']} (got {repr(first.get('input'))[:80]}).", field=field, remedy=_REMEDY) from None
