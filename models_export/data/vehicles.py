"""Single vehicles out of images: what the multi-bin head trains on, kept as small pictures around each vehicle."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from models_export.data.dataset import UNKNOWN_CONDITION
from models_export.data.detection import VehicleSample
from service.geometry.boxes import TANGENT_DIRECTIONS, clip_extents, scaled_extents, scaled_points, tangents_of
from service.geometry.camera import Camera, ray_azimuth
from service.geometry.transforms import Array, wrap_angle
from service.nets.multibin import CONTEXT, crop_vehicles, crop_windows

_ROOM = 1.7
"""Side of the kept picture over that of an exact crop: what jitter of the box may reach."""
_MOST_OVER_CROP = 1.84
"""Longest side of a kept picture over that of a head's crops, px; longer ones are reduced. With ``_ROOM`` around it, an exact
crop loses nothing."""


@dataclass(frozen=True, eq=False)
class Vehicle:
    """One vehicle in one camera's image."""

    patch: NDArray[np.uint8]
    """(h, w, 3) RGB, a part of the image around the vehicle, perhaps reduced."""
    patch_origin_px: Array
    """(2,) image coordinates of the patch's upper left corner (not of its first pixel's centre)."""
    patch_scale: Array
    """(2,) pixels of the patch a pixel of the image, across and down."""
    xyxy_px: Array
    """(4,) extents of the projected box, clipped to the image, px of the image."""
    tangents_px: Array
    """(8,) reach of the projected box, not clipped, in ``TANGENT_DIRECTIONS``, px of the image."""
    alpha: float
    """Heading relative to the ray through the 2D box's centre, radians."""
    dims_lwh: Array
    """(3,) metres."""
    cls: int
    """Class index."""
    camera: Camera
    """The camera at the image's size."""
    weather: str = UNKNOWN_CONDITION
    """Light and weather of the scene: day, night, fog, ..."""

    @property
    def labels(self) -> dict[str, str]:
        """What validation tells vehicles apart by."""
        return {"camera": self.camera.id, "weather": self.weather}

    def within(self, border_px: Array) -> Vehicle:
        """The same vehicle in a picture that ends at a border (4,), left top right bottom: of its pixels' outer edges, px."""
        low, high = self.patch_origin_px, self.patch_origin_px + np.array(self.patch.shape[1::-1]) / self.patch_scale
        kept = np.concatenate([np.maximum(border_px[:2], low), np.minimum(border_px[2:], high)])
        x0, y0, x1, y1 = np.rint((kept - np.tile(low, 2)) * np.tile(self.patch_scale, 2)).astype(int)
        origin = low + np.array([x0, y0]) / self.patch_scale
        end = low + np.array([x1, y1]) / self.patch_scale
        # Pixel centres lie at integers: the last one lies half a pixel before the end.
        xyxy = np.clip(self.xyxy_px, np.tile(origin + 0.5, 2), np.tile(end - 0.5, 2))
        patch = self.patch[y0:y1, x0:x1]
        return replace(self, patch=patch, patch_origin_px=origin, xyxy_px=xyxy, alpha=self._alpha_about(xyxy))

    def crop(self, xyxy_px: Array, crop_px: int) -> tuple[NDArray[np.uint8], float, Array]:
        """What the head would see and should say of a box (4,) that is not exact.

        Returns the crop (S, S, 3), alpha about that box's centre, and the true edges and tangents (12,), in sides of the crop
        from its middle.
        """
        alpha = self._alpha_about(xyxy_px)
        origin = np.tile(self.patch_origin_px, 2)
        in_patch = (np.stack([xyxy_px, self.xyxy_px]) - origin) * np.tile(self.patch_scale, 2) - 0.5
        crop = crop_vehicles(self.patch, in_patch[:1], crop_px)[0]
        left, top, side = crop_windows(in_patch[:1])[0].astype(np.float64)
        edges = (in_patch[1] + 0.5 - np.array([left, top] * 2)) / side - 0.5
        # The crop's middle in the image; a patch is scaled alike across and down, up to rounding.
        middle = (np.array([left, top]) + 0.5 * side) / self.patch_scale + self.patch_origin_px
        tangents = (self.tangents_px - TANGENT_DIRECTIONS @ middle) / (side / self.patch_scale.mean())
        return crop, alpha, np.concatenate([edges, tangents])

    def _alpha_about(self, xyxy_px: Array) -> float:
        """The heading relative to the ray through another box's centre."""
        azimuth = ray_azimuth(self.camera, np.stack([_middle(self.xyxy_px), _middle(xyxy_px)]))
        return float(wrap_angle(self.alpha + azimuth[0] - azimuth[1]))


def _middle(xyxy_px: Array) -> Array:
    middle: Array = (xyxy_px[:2] + xyxy_px[2:]) / 2
    return middle


def vehicles_of(sample: VehicleSample, crop_px: int, max_width: int | None = None) -> list[Vehicle]:
    """The vehicles of a sample that a detector is asked for and whose class is known.

    crop_px: side of the crops that a head reads. max_width: width to which the sample's frame is decoded for them, px; None, or
    a sample without a frame: out of its canvas, no larger than the detector sees them.
    """
    width, height = sample.image_size
    image, camera = sample.canvas[:height, :width], sample.camera
    if max_width is not None and sample.still is not None:
        image, camera = sample.still.at(max_width)
    factor = np.array([image.shape[1] / width, image.shape[0] / height])
    boxes = clip_extents(camera, scaled_extents(sample.xyxy_px, factor))
    tangents = tangents_of(scaled_points(sample.corners_px, factor))
    weather = sample.labels.get("weather", UNKNOWN_CONDITION)
    rows = np.flatnonzero(~sample.ignore & sample.class_known)
    most_px = int(_MOST_OVER_CROP * crop_px)
    return [_cut(image, camera, boxes[row], tangents[row], sample, row, weather, most_px) for row in rows]


def _cut(
    image: NDArray[np.uint8],
    camera: Camera,
    xyxy_px: Array,
    tangents_px: Array,
    sample: VehicleSample,
    row: int,
    weather: str,
    most_px: int,
) -> Vehicle:
    """The vehicle in a row of a sample, whose box (4,) and tangents (8,) are those in an image of the camera's size."""
    half = 0.5 * _ROOM * CONTEXT * float((xyxy_px[2:] - xyxy_px[:2]).max())
    center = _middle(xyxy_px)
    x0, y0 = np.maximum(np.floor(center - half), 0).astype(int)
    x1, y1 = np.minimum(np.ceil(center + half), image.shape[1::-1]).astype(int)
    patch = image[y0:y1, x0:x1]
    reduction = most_px / max(patch.shape)
    if reduction < 1:
        patch = cv2.resize(patch, None, fx=reduction, fy=reduction, interpolation=cv2.INTER_AREA)
    return Vehicle(
        patch=np.ascontiguousarray(patch),
        patch_origin_px=np.array([x0, y0]) - 0.5,
        patch_scale=np.array([patch.shape[1] / (x1 - x0), patch.shape[0] / (y1 - y0)]),
        xyxy_px=xyxy_px,
        tangents_px=tangents_px,
        alpha=float(sample.alpha[row]),
        dims_lwh=sample.dims_lwh[row],
        cls=int(sample.cls[row]),
        camera=camera,
        weather=weather,
    )
