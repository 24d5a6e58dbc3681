"""Training frames of the depth-guided detector: images, guide maps and what the boxes are in the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from models_export.data.augment import AugmentConfig, photometric
from models_export.data.samples import MIN_SIDE_PX, Sample
from service.depth_scale import fit_scale, ground_inverse_depth
from service.geometry.camera import ray_azimuth
from service.geometry.transforms import Array, wrap_angle
from service.nets.canvas import PAD_VALUE
from service.nets.depth import DepthNet
from service.nets.guided import GuidedSpec, guide_maps, metric_map

MIN_KEPT = 0.3
"""Vehicles of which augmentation leaves less in the picture are neither positives nor negatives."""
Map = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class GuidedFrame:
    """One camera's frame: N vehicles."""

    canvas: NDArray[np.uint8]
    """(H, W, 3) RGB."""
    labels: dict[str, str]
    """Camera and weather, for validation."""
    image_size: tuple[int, int]
    """Width and height of the image inside the canvas, px."""
    K: Array
    """(3, 3) intrinsics, px; the focal length along u is negative in a mirrored frame."""
    R_cam_world: Array
    """(3, 3) rotation, world to camera, mirrored or not."""
    xyxy_px: Array
    """(N, 4) 2D boxes."""
    ignore: NDArray[np.bool_]
    """(N,) vehicles that a detector is neither asked for nor blamed for."""
    cls: NDArray[np.int64]
    """(N,) class indices."""
    center_px: Array
    """(N, 2) projections of the 3D centres."""
    depth_m: Array
    """(N,) of the 3D centres along the optical axis."""
    dims_lwh: Array
    """(N, 3) metres."""
    alpha: Array
    """(N,) heading relative to the ray through ``center_px``, radians; of the other sign in a mirrored frame."""
    metric: Map
    """(h, w) the depth net's map in 1 / metres, as the service would have it."""
    truth: Map
    """(h, w) the same from the renderer; 0 where it is unknown."""
    ground: Map
    """(h, w) the road's inverse depth, 1 / metres; 0 where there is none."""


@dataclass(frozen=True)
class GuideNoise:
    """What makes training's maps as unreliable as real ones."""

    truth: float = 0.3
    """Share of the frames whose map is the renderer's, disturbed, so that the detector does not lean on one depth net."""
    waves: float = 0.12
    """Relative error of a disturbed map, in waves a few cells long (one sigma)."""
    scale: float = 0.03
    """Relative error of a map's scale (one sigma)."""


NO_GUIDE_NOISE = GuideNoise(0.0, 0.0, 0.0)


def guided_frames(samples: Sequence[Sample], depth: DepthNet) -> list[GuidedFrame]:
    """Frames of samples, with the maps of a pack's depth net, scaled on the road as the service scales them.

    All maps are at the stride of the samples' inverse depth.
    """
    return [_frame(sample, depth) for sample in samples]


def _frame(sample: Sample, depth: DepthNet) -> GuidedFrame:
    camera = sample.camera
    width, height = sample.image_size
    center_px, depth_m = camera.project(sample.center)
    yaw = sample.alpha + ray_azimuth(camera, (sample.xyxy_px[:, :2] + sample.xyxy_px[:, 2:]) / 2)
    (inverse,) = depth.infer([np.ascontiguousarray(sample.canvas[:height, :width])])
    scale = fit_scale(inverse.values, ground_inverse_depth(camera, sample.ground, inverse.values.shape, inverse.stride))
    shape = sample.inverse_depth.shape
    stride = sample.canvas.shape[0] // shape[0]
    seen = -(-height // stride), -(-width // stride)
    inverse = inverse.on_cells(seen, stride)
    ground = np.nan_to_num(ground_inverse_depth(camera, sample.ground, seen, stride)).astype(np.float32)
    return GuidedFrame(
        canvas=sample.canvas,
        labels=sample.labels,
        image_size=sample.image_size,
        K=camera.K,
        R_cam_world=camera.R_cam_world,
        xyxy_px=sample.xyxy_px,
        ignore=sample.ignore,
        cls=sample.cls,
        center_px=center_px,
        depth_m=depth_m,
        dims_lwh=sample.dims_lwh,
        alpha=wrap_angle(yaw - ray_azimuth(camera, center_px)),
        metric=_padded(ground if scale is None else metric_map(inverse, scale.scale, scale.shift), shape),
        truth=sample.inverse_depth,
        ground=_padded(ground, shape),
    )


def frame_maps(spec: GuidedSpec, frame: GuidedFrame) -> Map:
    """The network's second input (G, h, w) for a frame, as the service makes it."""
    return guide_maps(spec, frame.image_size, abs(float(frame.K[1, 1])), frame.metric, frame.ground)


def _padded(values: Array | Map, shape: tuple[int, ...]) -> Map:
    whole = np.zeros(shape, np.float32)
    whole[: values.shape[0], : values.shape[1]] = values
    return whole


def augmented(frame: GuidedFrame, rng: np.random.Generator, config: AugmentConfig, noise: GuideNoise) -> GuidedFrame:
    """The frame through another lens, mirrored or not, in other light, with a less reliable map.

    One affine map M moves the image, the maps, the boxes and the intrinsics together, so depths stay true.
    """
    M = _affine(frame, rng, config)
    height, width = frame.canvas.shape[:2]
    image = cv2.warpAffine(frame.canvas, M[:2], (width, height), flags=cv2.INTER_LINEAR, borderValue=(PAD_VALUE,) * 3)
    corners = frame.xyxy_px.reshape(-1, 2, 2) @ M[:2, :2].T + M[:2, 2]
    xyxy = np.concatenate([corners.min(1), corners.max(1)], 1)
    clipped = np.clip(xyxy, 0, np.array([width - 1, height - 1] * 2))
    sides, full = clipped[:, 2:] - clipped[:, :2], np.maximum(xyxy[:, 2:] - xyxy[:, :2], 1e-6)
    lost = (np.prod(sides, 1) / np.prod(full, 1) < MIN_KEPT) | (sides.min(1, initial=np.inf) < MIN_SIDE_PX)
    metric, ground = (_warped_map(values, frame, M) for values in (_noisy(frame, rng, noise), frame.ground))
    return replace(
        frame,
        canvas=photometric(np.asarray(image, dtype=np.uint8), rng, config),
        K=M @ frame.K,
        xyxy_px=clipped,
        ignore=frame.ignore | lost,
        center_px=frame.center_px @ M[:2, :2].T + M[:2, 2],
        alpha=wrap_angle(np.sign(M[0, 0]) * frame.alpha),
        metric=metric,
        ground=ground,
    )


def _affine(frame: GuidedFrame, rng: np.random.Generator, config: AugmentConfig) -> Array:
    """(3, 3) mirror, scale and shift of canvas pixels."""
    M = np.eye(3)
    if rng.random() < config.flip:
        M[0] = [-1.0, 0.0, frame.image_size[0] - 1.0]
    if rng.random() < config.geometric:
        size = np.array(frame.canvas.shape[1::-1], dtype=np.float64)
        scale = rng.uniform(*config.scale)
        offset = (0.5 + rng.uniform(-config.shift, config.shift, 2) - 0.5 * scale) * size
        M = np.array([[scale, 0.0, offset[0]], [0.0, scale, offset[1]], [0.0, 0.0, 1.0]]) @ M
    return M


def _warped_map(values: Map, frame: GuidedFrame, M: Array) -> Map:
    """A map (h, w) whose cells follow the canvas pixels that M moves."""
    stride = frame.canvas.shape[0] / values.shape[0]
    # Cell j lies at pixel (j + 0.5) * stride - 0.5.
    S = np.array([[stride, 0.0, 0.5 * stride - 0.5], [0.0, stride, 0.5 * stride - 0.5], [0.0, 0.0, 1.0]])
    moved = np.linalg.inv(S) @ M @ S
    return np.asarray(cv2.warpAffine(values, moved[:2], values.shape[::-1], flags=cv2.INTER_LINEAR), dtype=np.float32)


def _noisy(frame: GuidedFrame, rng: np.random.Generator, noise: GuideNoise) -> Map:
    """The depth net's map, or the renderer's with errors in its place; either with an error of scale."""
    values = frame.metric
    if rng.random() < noise.truth:
        coarse = rng.standard_normal((values.shape[0] // 4 + 1, values.shape[1] // 4 + 1)).astype(np.float32)
        waves = cv2.resize(coarse, values.shape[::-1], interpolation=cv2.INTER_CUBIC)
        blurred = cv2.GaussianBlur(frame.truth, (0, 0), rng.uniform(0.3, 1.2))
        values = np.asarray(blurred * np.exp(noise.waves * waves), dtype=np.float32)
    return values * np.float32(np.exp(noise.scale * rng.standard_normal()))
