"""Lens distortion: scenes are drawn as a pinhole camera sees them, then bent as OpenCV's lens model says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from models_export.scenes.mesh import Array
from models_export.scenes.renderer import Shot
from service.geometry.camera import Camera

_STEP_PX = 12
"""The lens model and its inverse are taken on a grid this coarse; splines fill the rest to better than 0.01 px."""


class Lens:
    """The way from a pinhole picture to a camera's own. Without distortion it does nothing.

    ``source`` is the pinhole camera to draw with: same place and focal length, a canvas that holds all the lens sees.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.source = camera
        self._maps: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
        self._inside: NDArray[np.bool_] | None = None
        if not camera.has_distortion:
            return
        u, v = _sampled(camera, lambda xy: camera.normalised_from_pixels(xy) @ camera.K[:2, :2].T + camera.K[:2, 2])
        margin = 1.0
        low = np.floor([u.min() - margin, v.min() - margin])
        size = np.ceil([u.max() + margin, v.max() + margin]) - low + 1
        K = camera.K.copy()
        K[:2, 2] -= low
        self.source = replace(camera, width=int(size[0]), height=int(size[1]), K=K, distortion=np.zeros(0))
        self._maps = (u - low[0]).astype(np.float32), (v - low[1]).astype(np.float32)
        seen_u, seen_v = _sampled(self.source, lambda xy: camera.pixels_from_normalised(self.source.normalised_from_pixels(xy)))
        self._inside = (seen_u > -0.5) & (seen_u < camera.width - 0.5) & (seen_v > -0.5) & (seen_v < camera.height - 0.5)

    def bend(self, shot: Shot) -> Shot:
        """The shot of ``source`` as the camera's lens shows it."""
        if self._maps is None:
            return shot
        nearest = [cv2.remap(layer, *self._maps, cv2.INTER_NEAREST) for layer in (shot.instance, shot.depth)]
        image = cv2.remap(shot.image, *self._maps, cv2.INTER_LINEAR)
        return Shot(image.astype(np.uint8, copy=False), *(n.astype(np.uint16, copy=False) for n in nearest))

    def pixel_counts(self, shot: Shot, count: int) -> NDArray[np.int64]:
        """Pixels of each of ``count`` road users in a shot of ``source``, as far as they are in the picture: (count,)."""
        instance = shot.instance if self._inside is None else shot.instance[self._inside]
        return np.bincount(instance.ravel(), minlength=count + 1)[1:]

    def contains(self, pixels: Array) -> NDArray[np.bool_]:
        """Whether pixels (..., 2) of ``source`` are in the camera's picture."""
        limits = np.array([self.source.width - 0.5, self.source.height - 0.5])
        on_canvas = np.all((pixels > -0.5) & (pixels < limits), axis=-1)
        if self._inside is None:
            return np.asarray(on_canvas)
        nearest = np.clip(np.rint(pixels), 0, limits - 0.5).astype(np.int64)
        return np.asarray(on_canvas & self._inside[nearest[..., 1], nearest[..., 0]])


def _sampled(camera: Camera, mapping: Callable[[Array], Array]) -> tuple[Array, Array]:
    """Where a smooth mapping (..., 2) -> (..., 2) takes each pixel of a camera: u and v, (H, W) each."""
    columns = np.linspace(0, camera.width - 1, camera.width // _STEP_PX + 2)
    rows = np.linspace(0, camera.height - 1, camera.height // _STEP_PX + 2)
    values = mapping(np.stack(np.meshgrid(columns, rows), -1))
    fine = np.arange(camera.height), np.arange(camera.width)
    u, v = (RectBivariateSpline(rows, columns, values[..., k])(*fine) for k in range(2))
    return u, v
