"""Pictures of CARLA's camera sensors: raw BGRA bytes made into RGB, depth and instance ids; field of view and focal length.

Sources: CARLA's sensor reference (depth encoding, instance segmentation) and its change log of 0.9.16 (actor ids in the
instance picture).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models_export.data.dataset import DEPTH_UNITS_PER_M, MAX_DEPTH_M
from service.errors import FrameError
from service.geometry.transforms import Array

FAR_M = 1000.0
"""Depth that CARLA encodes as all ones: the sky, or anything beyond."""
ID_MASK = 0xFFFF
"""The instance picture holds the lower sixteen bits of an actor's id."""


def bgra(raw: bytes, width: int, height: int) -> NDArray[np.uint8]:
    """A sensor's bytes as (H, W, 4) BGRA. Raises FrameError when their number does not fit the size."""
    pixels = np.frombuffer(raw, dtype=np.uint8)
    if pixels.size != width * height * 4:
        raise FrameError(
            f"{pixels.size} bytes for {width} x {height} px.", field="raw_data", remedy="A sensor sends four bytes a pixel."
        )
    return pixels.reshape(height, width, 4)


def rgb_of(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """RGB (H, W, 3), contiguous, of a BGRA picture."""
    return np.ascontiguousarray(picture[..., 2::-1])


def depth_m_of(picture: NDArray[np.uint8]) -> Array:
    """Depth (H, W) in metres of a BGRA depth picture: (R + 256 G + 65536 B) / (2^24 - 1) * 1000.

    CARLA encodes its depth buffer, so this is depth along the optical axis already, not the length of the ray.
    """
    b, g, r = (picture[..., channel].astype(np.float64) for channel in range(3))
    depth: Array = (r + 256.0 * g + 65536.0 * b) * (FAR_M / (2**24 - 1))
    return depth


def stored_depth(depth_m: ArrayLike) -> NDArray[np.uint16]:
    """Depth (H, W) in the units of a scene's PNG; 0, for none, beyond ``MAX_DEPTH_M``."""
    depth = np.asarray(depth_m, dtype=np.float64)
    return np.where(depth <= MAX_DEPTH_M, np.round(depth * DEPTH_UNITS_PER_M), 0).astype(np.uint16)


def instance_ids_of(picture: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Lower sixteen bits (H, W) of the ids in a BGRA instance picture: G is the low byte, B the high one.

    R, the semantic tag, is left aside: between two objects CARLA may blend it.
    """
    return picture[..., 1].astype(np.uint16) | (picture[..., 0].astype(np.uint16) << np.uint16(8))


def intrinsics(width: int, height: int, fov_deg: float) -> Array:
    """K (3, 3) of a sensor with a horizontal field of view: f = w / (2 tan(fov / 2)), square pixels.

    Unreal's optical axis meets the middle of the picture, which spans [0, w] there. With pixel centres at integers the
    picture spans [-0.5, w - 0.5], so cx = (w - 1) / 2.
    """
    focal = width / (2.0 * np.tan(np.deg2rad(fov_deg) / 2.0))
    return np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])


def field_of_view_deg(width: int, focal_px: float) -> float:
    """Horizontal field of view in degrees of a focal length; the inverse of :func:`intrinsics`."""
    return float(np.rad2deg(2.0 * np.arctan(width / (2.0 * focal_px))))
