"""Metric depth from an affine-invariant map: scale and shift per static camera, fitted on the road it looks at.

The road's depth at a pixel is known from the calibration, so ``1 / Z_ground = scale * d + shift`` can be fitted on road
pixels. Whatever stands on the road is nearer than the road behind it and looks like an outlier: a robust fit drops it.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from service.geometry.camera import Camera
from service.geometry.ground import Ground
from service.geometry.transforms import Array, between
from service.nets.depth import InverseDepth, ReadingError

NEAREST_M, FARTHEST_M = 4.0, 80.0
"""Road farther away covers too few pixels and bends too much to vouch for a scale."""
MIN_CELLS = 30
"""Fewer cells of visible road fit no scale; the camera then gets no depth readings."""
_ITERATIONS = 8
_TUKEY = 4.685
_MAD_TO_SIGMA = 1.4826
_MIDDLE_HALF = np.linspace(0.25, 0.75, 7)
REFIT_EVERY = 10
"""Frames of one camera between fits: the road does not move."""
SMOOTHING = 0.3
"""Weight of a new fit against the running one."""


@dataclass(frozen=True, eq=False)
class DepthScale:
    """``1 / Z = scale * d + shift`` for one camera, 1 / metres."""

    scale: float
    shift: float
    sigma_inverse: float
    """Standard deviation of 1 / Z on the road, 1 / metres."""


@dataclass(frozen=True, eq=False)
class DepthReadings:
    """Depth of the visible surface of N boxes."""

    depth_m: Array
    """(N,) along the optical axis; NaN where there is no reading."""
    sigma_m: Array
    """(N,) standard deviations; NaN where there is no reading."""

    @staticmethod
    def none(count: int) -> DepthReadings:
        """No readings for ``count`` boxes."""
        return DepthReadings(np.full(count, np.nan), np.full(count, np.nan))


def cell_pixels(shape: tuple[int, ...], stride: float) -> Array:
    """Pixel coordinates (h, w, 2) of the centres of a map's cells."""
    x = (np.arange(shape[1]) + 0.5) * stride - 0.5
    y = (np.arange(shape[0]) + 0.5) * stride - 0.5
    return np.stack(np.meshgrid(x, y), -1)


def ground_inverse_depth(camera: Camera, ground: Ground, shape: tuple[int, ...], stride: float) -> Array:
    """1 / Z of the road at each cell (h, w); NaN above the horizon and outside ``NEAREST_M``..``FARTHEST_M``."""
    rays = camera.rays_world(cell_pixels(shape, stride))
    road = ground.intersect(camera.position_m, rays)
    depth = (road - camera.position_m) @ camera.R_cam_world[2]
    usable = np.isfinite(depth) & (depth > NEAREST_M) & (depth < FARTHEST_M)
    return np.where(usable, 1.0 / np.where(usable, depth, 1.0), np.nan)


def fit_scale(values: NDArray[np.float32], ground_inverse: Array) -> DepthScale | None:
    """A robust line through (d, 1 / Z_ground) by iteratively reweighted least squares (Tukey's biweight).

    values and ground_inverse are (h, w); NaN cells of the latter are left out. None where too little road is in view or
    the map does not grow with nearness.
    """
    usable = np.isfinite(ground_inverse)
    if usable.sum() < MIN_CELLS:
        return None
    d, target = values[usable].astype(np.float64), ground_inverse[usable]
    weights = np.ones_like(d)
    scale = shift = spread = 0.0
    for _ in range(_ITERATIONS):
        mean_d, mean_t = np.average(d, weights=weights), np.average(target, weights=weights)
        variance = np.sum(weights * (d - mean_d) ** 2)
        if variance <= 1e-12:
            return None
        scale = float(np.sum(weights * (d - mean_d) * (target - mean_t)) / variance)
        shift = float(mean_t - scale * mean_d)
        residual = target - scale * d - shift
        spread = _MAD_TO_SIGMA * float(np.median(np.abs(residual))) + 1e-6
        reduced = np.clip(np.abs(residual) / (_TUKEY * spread), 0.0, 1.0)
        weights = (1 - reduced**2) ** 2 + 1e-9
    return DepthScale(scale, shift, spread) if scale > 0 else None


def read_boxes(inverse: InverseDepth, scale: DepthScale | None, xyxy_px: Array, error: ReadingError) -> DepthReadings:
    """Depth of the surface in the middle half of each box (N, 4), by the median of a grid of points, less the known bias."""
    if scale is None or len(xyxy_px) == 0:
        return DepthReadings.none(len(xyxy_px))
    rows, columns = inverse.values.shape
    # A grid of points over the middle half, the same number for every box, so that all medians are one operation.
    x = xyxy_px[:, None, 0] + (xyxy_px[:, None, 2] - xyxy_px[:, None, 0]) * _MIDDLE_HALF
    y = xyxy_px[:, None, 1] + (xyxy_px[:, None, 3] - xyxy_px[:, None, 1]) * _MIDDLE_HALF
    column = between(np.floor((x + 0.5) / inverse.stride), 0, columns - 1).astype(np.int64)
    row = between(np.floor((y + 0.5) / inverse.stride), 0, rows - 1).astype(np.int64)
    values = inverse.values[row[:, :, None], column[:, None, :]].reshape(len(xyxy_px), -1)
    # Their number is odd, so the median is one of them. NaN sorts last: where there is any, there is no reading.
    half = values.shape[1] // 2
    ordered = np.partition(values, (half, -1), axis=1)
    middle = np.where(np.isnan(ordered[:, -1]), np.nan, ordered[:, half])
    inverse_m = scale.scale * middle + scale.shift
    usable = inverse_m > 1.0 / FARTHEST_M
    depth = np.where(usable, 1.0 / np.where(usable, inverse_m, 1.0), np.nan) / (1.0 + error.bias)
    return DepthReadings(depth, depth * np.hypot(error.sigma, depth * scale.sigma_inverse))


class DepthScales:
    """The running scale of every camera. Safe to use from several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        # Weak keys: a camera that left, or was calibrated anew, takes its scale with it.
        self._known: WeakKeyDictionary[Camera, tuple[DepthScale | None, int]] = WeakKeyDictionary()

    def update(self, camera: Camera, scaled: Camera, ground: Ground, inverse: InverseDepth) -> DepthScale | None:
        """The scale of one camera, fitted anew every ``REFIT_EVERY`` frames and smoothed.

        camera: the site's camera, whose identity is the key. scaled: the same at the size of the image of ``inverse``.
        """
        with self._lock:
            current, frames = self._known.get(camera, (None, 0))
        if frames % REFIT_EVERY == 0:
            fresh = fit_scale(inverse.values, ground_inverse_depth(scaled, ground, inverse.values.shape, inverse.stride))
            current = _blend(current, fresh)
        with self._lock:
            self._known[camera] = (current, frames + 1)
        return current


def _blend(old: DepthScale | None, new: DepthScale | None) -> DepthScale | None:
    if old is None or new is None:
        return new or old
    mix = np.array([old.scale, old.shift, old.sigma_inverse]) * (1 - SMOOTHING)
    mix += np.array([new.scale, new.shift, new.sigma_inverse]) * SMOOTHING
    return DepthScale(*(float(v) for v in mix))
