"""A site: its cameras, its ground, its origin on the globe; read from and written to ``site.json``."""

from __future__ import annotations

import json
import logging
import os
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from service.errors import CalibrationError, NotFoundError
from service.geometry.camera import Camera
from service.geometry.ground import MAX_NODES, Ground, GroundGrid, GroundPlane

logger = logging.getLogger(__name__)

ID_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$"
"""Ids of sites and cameras: safe in URLs, file names and form fields."""

MAX_SIDE_PX = 16384
_ROTATION_TOLERANCE = 1e-3
_ROTATION_ROUNDING = 1e-12
_MIN_FOCAL_PX = 1.0
_DISTORTION_LENGTHS = (0, 4, 5, 8, 12, 14)

_MAX_NUMBER = 1e8
"""Above any projected map coordinate in metres; larger numbers are mistakes, and their products overflow."""

Finite = Annotated[float, Field(allow_inf_nan=False, ge=-_MAX_NUMBER, le=_MAX_NUMBER)]
Row3 = Annotated[list[Finite], Field(min_length=3, max_length=3)]
Row4 = Annotated[list[Finite], Field(min_length=4, max_length=4)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")


class OriginModel(_Strict):
    """WGS84 position of the world frame's origin: degrees and metres."""

    lat: Annotated[float, Field(ge=-90, le=90)] = 0.0
    lon: Annotated[float, Field(ge=-180, le=180)] = 0.0
    alt: Finite = 0.0


class GridModel(_Strict):
    """Heights of the road on a regular grid: rows along y, columns along x, from ``origin_xy`` on, metres."""

    origin_xy: Annotated[list[Finite], Field(min_length=2, max_length=2)]
    cell_m: Annotated[float, Field(ge=0.1, le=1000.0, allow_inf_nan=False)]
    heights: Annotated[list[Annotated[list[Finite], Field(min_length=2)]], Field(min_length=2)]


class GroundModel(_Strict):
    """The ground plane ``normal . p = offset`` in the world, metres; a grid, where given, takes its place."""

    normal: Row3 = Field(default_factory=lambda: [0.0, 0.0, 1.0])
    offset: Finite = 0.0
    grid: GridModel | None = None


class CameraModel(_Strict):
    """One camera: size in px, K in px, OpenCV distortion, ``T_cam_world`` (4x4, metres)."""

    id: Annotated[str, Field(pattern=ID_PATTERN)]
    width: Annotated[int, Field(ge=16, le=MAX_SIDE_PX)]
    height: Annotated[int, Field(ge=16, le=MAX_SIDE_PX)]
    K: Annotated[list[Row3], Field(min_length=3, max_length=3)]
    distortion: Annotated[list[Finite], Field(max_length=14)] = Field(default_factory=list)
    T_cam_world: Annotated[list[Row4], Field(min_length=4, max_length=4)]


class AccuracyModel(_Strict):
    """How exact the site's own numbers are, one sigma: what a survey promises. The defaults are those of ordinary roads.

    Exact numbers that are called vague cost accuracy, vague ones that are called exact cost more: boxes that belong together
    then look apart.
    """

    ground_m: Annotated[float, Field(ge=0.001, le=10.0, allow_inf_nan=False)] = 0.05
    """How far a wheel may stand above or below the ground, metres."""
    ground_per_m: Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)] = 0.003
    """What a metre of distance from the camera adds to it: roads are not planes."""
    camera_m: Annotated[float, Field(ge=0.0, le=10.0, allow_inf_nan=False)] = 0.05
    """Of a camera's position, metres."""
    camera_rad: Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)] = 0.003
    """Of a camera's rotation, radians: wind and warmth move masts, too."""


class SiteModel(_Strict):
    """The form of ``site.json``, also the body of ``PUT /sites/{id}``."""

    id: Annotated[str, Field(pattern=ID_PATTERN)]
    origin: OriginModel = Field(default_factory=OriginModel)
    ground: GroundModel = Field(default_factory=GroundModel)
    accuracy: AccuracyModel = Field(default_factory=AccuracyModel)
    cameras: Annotated[list[CameraModel], Field(max_length=64)] = Field(default_factory=list)


@dataclass(frozen=True, eq=False)
class Site:
    """A validated site. Immutable: a change makes a new one."""

    id: str
    cameras: tuple[Camera, ...] = ()
    ground: Ground = field(default_factory=GroundPlane)
    origin: OriginModel = field(default_factory=OriginModel)
    accuracy: AccuracyModel = field(default_factory=AccuracyModel)

    def camera(self, camera_id: str) -> Camera:
        """The camera with an id. Raises NotFoundError."""
        for camera in self.cameras:
            if camera.id == camera_id:
                return camera
        known = ", ".join(c.id for c in self.cameras) or "none"
        raise NotFoundError(
            f"site '{self.id}' has no camera '{camera_id[:80]}'.", field=camera_id[:80], remedy=f"Its cameras are: {known}."
        )

    def with_camera(self, camera: Camera) -> Site:
        """The site with a camera added, or replaced if its id is known."""
        others = tuple(c for c in self.cameras if c.id != camera.id)
        return replace(self, cameras=(*others, camera))

    def without_camera(self, camera_id: str) -> Site:
        """The site with a camera dropped. Raises NotFoundError."""
        self.camera(camera_id)
        return replace(self, cameras=tuple(c for c in self.cameras if c.id != camera_id))


def parse_site(document: Any) -> Site:
    """A site from parsed JSON (the form of :class:`SiteModel`).

    Raises CalibrationError naming the field, its value and a remedy when it is malformed, not finite, or a camera's
    matrices cannot be those of a camera.
    """
    try:
        model = SiteModel.model_validate(document)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        location = ".".join(str(part) for part in first["loc"]) or "site"
        shown = repr(first.get("input"))[:80]
        raise CalibrationError(
            f"{first['msg']} (got {shown}).", field=location, remedy="See the site file in the README."
        ) from None
    cameras = tuple(_camera(camera, f"cameras.{index}") for index, camera in enumerate(model.cameras))
    ids = [camera.id for camera in cameras]
    for index, camera_id in enumerate(ids):
        if camera_id in ids[:index]:
            raise CalibrationError(
                f"'{camera_id}' stands twice.", field=f"cameras.{index}.id", remedy="Give each camera its own id."
            )
    return Site(model.id, cameras, _ground(model.ground), model.origin, model.accuracy)


def _ground(model: GroundModel) -> Ground:
    if model.grid is not None:
        return _grid(model.grid)
    normal = np.array(model.normal)
    length = float(np.linalg.norm(normal))
    if length < 1e-6 or normal[2] / length < 0.5:
        raise CalibrationError(
            f"{model.normal} is not a direction that points up (within 60 degrees of +z).",
            field="ground.normal",
            remedy="World is East, North, up; a level road has normal [0, 0, 1].",
        )
    return GroundPlane(normal / length, model.offset / length)


def _grid(model: GridModel) -> GroundGrid:
    lengths = {len(row) for row in model.heights}
    if len(lengths) > 1 or len(model.heights) * max(lengths) > MAX_NODES:
        raise CalibrationError(
            f"{len(model.heights)} rows of {min(lengths)} to {max(lengths)} heights.",
            field="ground.grid.heights",
            remedy=f"All rows have the same length, and there are at most {MAX_NODES} heights.",
        )
    return GroundGrid(np.array(model.origin_xy), model.cell_m, np.array(model.heights))


def _camera(model: CameraModel, where: str) -> Camera:
    K = np.array(model.K)
    focal_ok = K[0, 0] >= _MIN_FOCAL_PX and K[1, 1] >= _MIN_FOCAL_PX
    if not focal_ok or K[1, 0] != 0 or np.any(np.abs(K[2] - [0, 0, 1]) > 1e-9):
        raise CalibrationError(
            f"{model.K} is singular or not of the form [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with positive focal lengths.",
            field=f"{where}.K",
            remedy="Give the intrinsic matrix in pixels, as OpenCV's calibrateCamera returns it.",
        )
    T = np.array(model.T_cam_world)
    R = T[:3, :3]
    rigid = (
        np.abs(R @ R.T - np.eye(3)).max() < _ROTATION_TOLERANCE
        and np.linalg.det(R) > 0
        and np.abs(T[3] - [0, 0, 0, 1]).max() < 1e-9
    )
    if not rigid:
        raise CalibrationError(
            f"{model.T_cam_world} is singular or not a rigid transform (rotation, translation, last row 0 0 0 1).",
            field=f"{where}.T_cam_world",
            remedy="Give the pose that maps world points to the camera: p_cam = T_cam_world @ p_world, without scale.",
        )
    if len(model.distortion) not in _DISTORTION_LENGTHS:
        raise CalibrationError(
            f"{len(model.distortion)} coefficients.",
            field=f"{where}.distortion",
            remedy=f"OpenCV's model has one of {_DISTORTION_LENGTHS} coefficients.",
        )
    # Only where digits were lost: a saved site then reads back bit by bit.
    if np.abs(R @ R.T - np.eye(3)).max() > _ROTATION_ROUNDING:
        U, _, Vt = np.linalg.svd(R)
        T[:3, :3] = U @ Vt
    return Camera(model.id, model.width, model.height, K, T, np.array(model.distortion, dtype=np.float64))


def site_document(site: Site) -> dict[str, Any]:
    """A site as JSON-ready data; the inverse of :func:`parse_site`."""
    return {
        "id": site.id,
        "origin": site.origin.model_dump(),
        "ground": _ground_document(site.ground),
        "accuracy": site.accuracy.model_dump(),
        "cameras": [
            {
                "id": c.id,
                "width": c.width,
                "height": c.height,
                "K": c.K.tolist(),
                "distortion": c.distortion.tolist(),
                "T_cam_world": c.T_cam_world.tolist(),
            }
            for c in site.cameras
        ],
    }


def _ground_document(ground: Ground) -> dict[str, Any]:
    if isinstance(ground, GroundPlane):
        return {"normal": ground.normal.tolist(), "offset": ground.offset}
    grid = {"origin_xy": ground.origin_xy.tolist(), "cell_m": ground.cell_m, "heights": ground.heights.tolist()}
    return {"grid": grid}


def load_site(path: Path) -> Site:
    """Read ``site.json``. Raises CalibrationError naming the file when it is missing, not JSON or not a site."""
    try:
        document = json.loads(path.read_text("utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise CalibrationError(f"cannot be read: {error}.", field=str(path), remedy="Check the file.") from error
    return parse_site(document)


def save_site(site: Site, path: Path) -> None:
    """Write ``site.json`` atomically: a crash leaves the old file or the new one, never half of one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            json.dump(site_document(site), stream, indent=1)
            stream.flush()
            os.fsync(stream.fileno())
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Let the names in a folder outlive a loss of power, where the system can do that."""
    try:
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        # Windows and some network file systems know no such thing; the change itself is made already.
        logger.debug("The folder %s cannot be synchronised: %s", folder, error)
