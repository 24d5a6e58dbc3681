"""A static, calibrated camera: pinhole with OpenCV lens distortion. Pixel centres lie at integer coordinates."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from service.geometry.transforms import Array, invert_rigid, transform_points, wrap_angle

_ZERO = np.zeros(3)
_NEWTON_STEPS = 4
_MIN_SLOPE = 1e-3

MIN_DEPTH_M = 0.1
"""Points nearer to the image plane than this count as not visible."""


@dataclass(frozen=True, eq=False)
class Camera:
    """One camera of a site.

    Use :func:`service.site.load_site` or :class:`service.site.CameraModel` for data from outside: they validate.
    """

    id: str
    width: int
    """Image width, px."""
    height: int
    """Image height, px."""
    K: Array
    """Intrinsics (3, 3), px."""
    T_cam_world: Array
    """Rigid transform (4, 4): ``p_cam = T_cam_world @ p_world``, metres."""
    distortion: Array = field(default_factory=lambda: np.zeros(0))
    """OpenCV distortion coefficients (k1 k2 p1 p2 [k3 [k4 k5 k6 ...]]), or empty for none."""

    @cached_property
    def T_world_cam(self) -> Array:
        """Inverse of ``T_cam_world``, (4, 4)."""
        return invert_rigid(self.T_cam_world)

    @property
    def position_m(self) -> Array:
        """The camera's centre in the world, (3,)."""
        return self.T_world_cam[:3, 3]

    @property
    def R_cam_world(self) -> Array:
        """Rotation (3, 3), world to camera."""
        return self.T_cam_world[:3, :3]

    @cached_property
    def has_distortion(self) -> bool:
        """Whether any distortion coefficient is non-zero."""
        return bool(np.any(self.distortion))

    def project_cam(self, points_cam: ArrayLike) -> Array:
        """Pixels (..., 2) of points (..., 3) in the camera frame (metres).

        Points behind ``MIN_DEPTH_M`` are projected as if at that depth; check z before use.
        """
        points = np.asarray(points_cam, dtype=np.float64)
        z = np.maximum(points[..., 2:3], MIN_DEPTH_M)
        normalised = points[..., :2] / z
        return self.pixels_from_normalised(normalised)

    def pixels_from_normalised(self, xy: ArrayLike) -> Array:
        """Pixels (..., 2) of undistorted normalised image coordinates x/z, y/z of shape (..., 2)."""
        xy = np.asarray(xy, dtype=np.float64)
        if self.has_distortion:
            homogeneous = np.concatenate([xy, np.ones_like(xy[..., :1])], -1).reshape(-1, 1, 3)
            if homogeneous.size == 0:
                return np.zeros_like(xy)
            pixels, _ = cv2.projectPoints(homogeneous, np.zeros(3), np.zeros(3), self.K, self.distortion)
            return np.asarray(pixels, dtype=np.float64).reshape(xy.shape)
        return xy @ self.K[:2, :2].T + self.K[:2, 2]

    def project(self, points_world: ArrayLike) -> tuple[Array, Array]:
        """Pixels (..., 2) and depths along the optical axis (...) of world points (..., 3), metres."""
        points_cam = transform_points(self.T_cam_world, points_world)
        return self.project_cam(points_cam), points_cam[..., 2]

    def normalised_from_pixels(self, pixels: ArrayLike) -> Array:
        """Undistorted normalised coordinates (x/z, y/z) of pixels; both (..., 2)."""
        pixels = np.asarray(pixels, dtype=np.float64)
        if self.has_distortion:
            return self._undistorted(pixels.reshape(-1, 2)).reshape(pixels.shape)
        return (pixels - self.K[:2, 2]) @ np.linalg.inv(self.K[:2, :2]).T

    def _undistorted(self, pixels: Array) -> Array:
        """Inverse of the lens model for pixels (P, 2): OpenCV's start, then Newton on its projection.

        OpenCV's own fixed-point iteration stops early on strong lenses, and its argument for more differs by version.
        """
        if len(pixels) == 0:
            return np.zeros_like(pixels)
        xy = cv2.undistortPoints(pixels[:, None], self.K, self.distortion).reshape(-1, 2).astype(np.float64)
        for _ in range(_NEWTON_STEPS):
            seen, jacobian = cv2.projectPoints(np.c_[xy, np.ones(len(xy))][:, None], _ZERO, _ZERO, self.K, self.distortion)
            # Columns 3 and 4 are over the translation's x and y: at depth 1 those move x/z and y/z one to one.
            slope = np.asarray(jacobian, dtype=np.float64)[:, 3:5].reshape(-1, 2, 2)
            miss = pixels - np.asarray(seen, dtype=np.float64).reshape(-1, 2)
            # Where the lens model folds back (far outside of the picture) it has no inverse: such points stay as they are.
            invertible = np.isfinite(miss).all(1) & (np.linalg.det(slope) > _MIN_SLOPE * np.prod(np.diag(self.K)))
            xy[invertible] += np.linalg.solve(slope[invertible], miss[invertible, :, None])[..., 0]
        return xy

    def rays_world(self, pixels: ArrayLike) -> Array:
        """World directions (..., 3) through pixels (..., 2), scaled so that their depth in the camera is 1."""
        xy = self.normalised_from_pixels(pixels)
        rays_cam = np.concatenate([xy, np.ones_like(xy[..., :1])], -1)
        return rays_cam @ self.R_cam_world

    def unproject(self, pixels: ArrayLike, depth_m: ArrayLike) -> Array:
        """World points (..., 3) seen at pixels (..., 2) at depths (...) along the optical axis."""
        return self.position_m + self.rays_world(pixels) * np.asarray(depth_m, dtype=np.float64)[..., None]

    def scaled(self, width: int, height: int) -> Camera:
        """The same camera with its picture resized to ``width`` x ``height`` px (pixel centres at integers)."""
        sx, sy = width / self.width, height / self.height
        S = np.array([[sx, 0.0, 0.5 * sx - 0.5], [0.0, sy, 0.5 * sy - 0.5], [0.0, 0.0, 1.0]])
        return replace(self, width=width, height=height, K=S @ self.K)


def yaw_from_alpha(camera: Camera, alpha_rad: ArrayLike, pixels: ArrayLike) -> Array:
    """World yaw (N,) from observation angles alpha (N,) along the rays through pixels (N, 2), radians.

    Here alpha is the heading relative to the *horizontal* direction of the viewing ray: ``yaw = alpha + azimuth(ray)``,
    counter-clockwise about gravity. On a level camera it is KITTI's alpha up to the sign and a quarter turn:
    ``alpha_kitti = -alpha - pi/2``. Taking both about gravity is what makes it right on pitched cameras
    (docs/conventions.md).
    """
    return wrap_angle(np.asarray(alpha_rad, dtype=np.float64) + ray_azimuth(camera, pixels))


def ray_azimuth(camera: Camera, pixels: ArrayLike) -> Array:
    """Azimuth (...) of viewing rays through pixels (..., 2): counter-clockwise from East, radians."""
    rays = camera.rays_world(pixels)
    return np.arctan2(rays[..., 1], rays[..., 0])


UInt8Image = NDArray[np.uint8]
"""An image (H, W, 3) in RGB, 0..255."""
