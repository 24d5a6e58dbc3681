"""The depth-guided detector: an image and a depth map in, 2D and 3D boxes out, from anchors that know both.

Every anchor is a 2D box at a cell of the grid and, with it, the mean depth, size and heading of the training vehicles that
overlap it. The network gives what must be added to both, in standard deviations. This module knows the anchors, what the raw
outputs mean and how depth maps are handed in; training encodes its targets with the inverse of :func:`decode_guided`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import PackError
from service.geometry.transforms import Array, wrap_angle
from service.nets.canvas import PADDED, InputFit, Placement
from service.nets.decoding import MAX_CANDIDATES
from service.nets.depth import InverseDepth
from service.nets.detections import unsuppressed
from service.nets.pack import Network

MAX_INVERSE_DEPTH = 0.5
"""Guides are cut here, 1 / metres: nothing stands nearer than 2 m to a pole camera, but a map can say so."""
GUIDES = ("depth", "ground")
"""Maps that can guide: the depth net's, made metric, and the road's own, which the calibration gives."""
_MAX_LOG = 3.0
"""Logarithms of ratios are cut here, so that no output overflows."""
_MIN_DEPTH_M, _MAX_DEPTH_M = 1.0, 300.0


@dataclass(frozen=True, eq=False)
class GuidedSpec:
    """What the ONNX metadata says of a depth-guided detector."""

    classes: tuple[str, ...]
    stride: int
    """Canvas pixels a cell of the anchors' grid."""
    anchors_px: Array
    """(A, 2) width and height, px."""
    priors: Array
    """(A, 5) mean depth, length, width, height (metres) and alpha (radians) of the vehicles that overlap each anchor."""
    mean: Array
    """(11,) of the training targets: x y w h of the 2D box, then u v depth l w h alpha."""
    std: Array
    """(11,) their standard deviations."""
    focal_px: float
    """Depths are those of a camera of this focal length, whatever the real one's: an anchor's height then fixes its depth.
    0: depths as they are."""
    log_depth: bool
    """Whether depth is a ratio to the anchor's, as the sizes are, or a difference."""
    bin_centers_rad: Array
    """(K,) centres of the heading's bins; none: the heading is a difference to the anchor's mean alpha."""
    guides: tuple[str, ...]
    """Which of ``GUIDES`` the network takes, in the order of its second input's channels."""
    guide_stride: int
    """Canvas pixels a cell of the guides."""
    sigma_scale: Array
    """(7,) real errors of u v depth l w h alpha over the sigmas that the network gives (1 where it gives none)."""
    fit: InputFit = PADDED
    """How images become canvases. One of fixed size is for frames of its width; any other takes what the 2D detector sees."""

    @staticmethod
    def from_metadata(metadata: dict[str, Any]) -> GuidedSpec:
        """Read the metadata of an ONNX file. Raises PackError naming what is missing."""
        try:
            spec = GuidedSpec(
                classes=tuple(metadata["classes"]),
                stride=int(metadata["stride"]),
                anchors_px=np.array(metadata["anchors_px"], dtype=np.float64).reshape(-1, 2),
                priors=np.array(metadata["priors"], dtype=np.float64).reshape(-1, 5),
                mean=np.array(metadata["mean"], dtype=np.float64).reshape(11),
                std=np.array(metadata["std"], dtype=np.float64).reshape(11),
                focal_px=float(metadata["focal_px"]),
                log_depth=bool(metadata["log_depth"]),
                bin_centers_rad=np.array(metadata["bin_centers_rad"], dtype=np.float64),
                guides=tuple(metadata["guides"]),
                guide_stride=int(metadata["guide_stride"]),
                sigma_scale=np.array(metadata["sigma_scale"], dtype=np.float64).reshape(7),
                fit=InputFit.from_metadata(metadata.get("fit")),
            )
            if len(spec.priors) != len(spec.anchors_px) or not (spec.std > 0).all() or not (spec.anchors_px > 0).all():
                raise ValueError("anchors, priors and deviations do not fit each other")
            if not spec.guides or not set(spec.guides) <= set(GUIDES):
                raise ValueError(f"guides {spec.guides!r}: one or both of {GUIDES}")
            if spec.fit.place != "corner":
                # The cells of a centred image would begin within a cell.
                raise ValueError("the image lies in the corner of its canvas")
        except (KeyError, TypeError, ValueError) as error:
            raise PackError(f"metadata is incomplete: {error!r}.", field="guided", remedy="Export the pack again.") from error
        return spec

    def to_metadata(self) -> dict[str, Any]:
        """The inverse of :meth:`from_metadata`."""
        values = {f.name: getattr(self, f.name) for f in fields(self)} | {"fit": self.fit.to_metadata()}
        return {
            k: v.tolist() if isinstance(v, np.ndarray) else list(v) if isinstance(v, tuple) else v for k, v in values.items()
        }

    def depth_factor(self, focal_px: float) -> float:
        """What turns depths of a camera of focal length ``focal_px``, canvas px, into the spec's."""
        return self.focal_px / focal_px if self.focal_px else 1.0

    def guide_grid(self, image_size: tuple[int, int]) -> tuple[tuple[int, int], float]:
        """Rows and columns of the guides' cells that an image of this width and height covers, and image pixels a cell."""
        placement = self.fit.placement(*image_size)
        width, height = placement.size_px
        return (-(-height // self.guide_stride), -(-width // self.guide_stride)), self.guide_stride / placement.scale


@dataclass(frozen=True, eq=False)
class GuidedDetections:
    """What the network says of N vehicles of one image, best first."""

    xyxy_px: Array
    """(N, 4) 2D boxes in the image's pixels, not clipped."""
    score: Array
    """(N,) in 0..1."""
    cls: NDArray[np.int64]
    """(N,) indices into the spec's classes."""
    center_px: Array
    """(N, 2) where the 3D box's centre projects to."""
    depth_m: Array
    """(N,) of the 3D box's centre along the optical axis."""
    dims_lwh: Array
    """(N, 3) metres."""
    alpha: Array
    """(N,) heading relative to the azimuth of the ray through ``center_px``, radians in [-pi, pi)."""
    flip_log_odds: Array
    """(N,) log-odds of alpha against alpha + pi; 0 where the network does not say."""
    sigma: Array
    """(N, 7) standard deviations of u, v (px), depth, l, w, h (metres), alpha (radians)."""

    def __len__(self) -> int:
        return len(self.score)

    def placed(self, placement: Placement) -> GuidedDetections:
        """Detections on a canvas as they are in the image that lies on it."""
        sigma = self.sigma / np.array([placement.scale, placement.scale, 1.0, 1.0, 1.0, 1.0, 1.0])
        boxes, centers = placement.to_image(self.xyxy_px), placement.to_image(self.center_px)
        return replace(self, xyxy_px=boxes, center_px=centers, sigma=sigma)

    def take(self, index: NDArray[np.int64]) -> GuidedDetections:
        """The detections at an index."""
        return GuidedDetections(**{f.name: getattr(self, f.name)[index] for f in fields(self)})


class GuidedDetector:
    """The depth-guided detector of a pack."""

    def __init__(self, network: Network) -> None:
        self.spec = GuidedSpec.from_metadata(network.metadata)
        self.network = network

    def detect(
        self,
        images: Sequence[NDArray[np.uint8]],
        guides: Sequence[NDArray[np.float32]],
        focal_px: Sequence[float],
        *,
        score_threshold: float = 0.3,
        nms_iou: float = 0.4,
    ) -> list[GuidedDetections]:
        """Vehicles in images (H, W, 3) RGB uint8, one result an image.

        guides: (G, h, w) an image, from :func:`guide_maps`. focal_px: vertical focal length of each image's camera.
        """
        results: dict[int, GuidedDetections] = {}
        for batch in self.spec.fit.batches(images):
            outputs = self.network.run(batch.pixels, np.stack([guides[member] for member in batch.members]))
            for row, (member, placement) in enumerate(zip(batch.members, batch.placements, strict=True)):
                focal = focal_px[member] * placement.scale
                raw = decode_guided([out[row] for out in outputs], self.spec, focal, score_threshold)
                results[member] = suppress_guided(raw, nms_iou).placed(placement)
        return [results[member] for member in range(len(images))]


def guide_maps(
    spec: GuidedSpec, image_size: tuple[int, int], focal_px: float, metric: Array | None, ground: Array
) -> NDArray[np.float32]:
    """The network's second input (G, H / s, W / s) for one canvas: inverse depths in the spec's camera, 1 / metres.

    image_size: width and height, px. focal_px: the image's. metric: (h, w) the depth net's map made metric, or None where it
    fits no scale: the road then stands in for it. ground: (h, w) inverse depth of the road; NaN where there is none. Both on
    the cells of ``guide_grid``; cells of the padding are 0, which is infinitely far.
    """
    width, height = spec.fit.canvas_size(*image_size)
    maps = np.zeros((len(spec.guides), height // spec.guide_stride, width // spec.guide_stride), np.float32)
    road = np.nan_to_num(ground)
    for channel, name in enumerate(spec.guides):
        values = road if name == "ground" or metric is None else metric
        maps[channel, : values.shape[0], : values.shape[1]] = np.clip(values, 0.0, MAX_INVERSE_DEPTH)
    return maps / np.float32(spec.depth_factor(focal_px * spec.fit.placement(*image_size).scale))


def metric_map(inverse: InverseDepth, scale: float, shift: float) -> Array:
    """A depth net's map (h, w) in 1 / metres."""
    values: Array = scale * inverse.values.astype(np.float64) + shift
    return values


def anchor_boxes(spec: GuidedSpec, anchor: NDArray[np.int64], row: NDArray[np.int64], column: NDArray[np.int64]) -> Array:
    """Anchors (N, 4) as centre x, y, width, height in canvas px, by their number and cell. Pixel centres lie at integers."""
    center = np.stack([column, row], -1) * spec.stride + 0.5 * (spec.stride - 1)
    return np.concatenate([center, spec.anchors_px[anchor]], -1)


def decode_guided(
    outputs: Sequence[NDArray[np.float32]], spec: GuidedSpec, focal_px: float, score_threshold: float
) -> GuidedDetections:
    """Vehicles of one image above a score, best first, before suppression.

    outputs, each (A * F, h, w): class logits, background first (F = 1 + C, softmax); the 2D box (4: x, y, log w, log h); the
    3D box (6: u, v, depth, l, w, h); the heading (1, or 3 K: cosines and sines of K bins, then their logits); log variances of
    u v depth l w h alpha (7), if the network learned them.
    """
    count = len(spec.anchors_px)
    grids = [out.reshape(count, -1, *out.shape[-2:]) for out in outputs]
    logits = grids[0]
    # A vehicle's probability is at most that against the background alone: compare logits first, decode few.
    against = np.log(score_threshold / (1 - score_threshold))
    anchor, row, column = np.nonzero(logits[:, 1:].max(1) - logits[:, 0] > against)
    probability = _softmax(logits[anchor, :, row, column].astype(np.float64))[:, 1:]
    score = probability.max(1, initial=0.0)
    order = np.argsort(-score, kind="stable")
    order = order[score[order] > score_threshold][:MAX_CANDIDATES]
    anchor, row, column = anchor[order], row[order], column[order]
    picked = [grid[anchor, :, row, column].astype(np.float64) for grid in grids[1:]]
    variances = np.exp(np.clip(picked[3], -20.0, 20.0)) if len(picked) > 3 else np.ones((len(anchor), 7))
    decoded = decode_boxes(spec, anchor, anchor_boxes(spec, anchor, row, column), picked[0], picked[1], picked[2])
    sigma = decoded_sigma(spec, anchor, decoded, np.sqrt(variances) * spec.sigma_scale)
    to_camera = 1.0 / spec.depth_factor(focal_px)
    sigma[:, 2] *= to_camera
    return GuidedDetections(
        xyxy_px=decoded.xyxy_px,
        score=score[order],
        cls=probability[order].argmax(1) if len(order) else np.zeros(0, np.int64),
        center_px=decoded.center_px,
        depth_m=np.clip(decoded.depth_m * to_camera, _MIN_DEPTH_M, _MAX_DEPTH_M),
        dims_lwh=decoded.dims_lwh,
        alpha=decoded.alpha,
        flip_log_odds=decoded.flip_log_odds,
        sigma=sigma,
    )


@dataclass(frozen=True, eq=False)
class DecodedBoxes:
    """N boxes in the spec's camera."""

    xyxy_px: Array
    center_px: Array
    depth_m: Array
    dims_lwh: Array
    alpha: Array
    flip_log_odds: Array


def decode_boxes(
    spec: GuidedSpec, anchor: NDArray[np.int64], boxes: Array, box_2d: Array, box_3d: Array, heading: Array
) -> DecodedBoxes:
    """Boxes from standardised outputs (N, 4), (N, 6) and (N, 1 or 3 K) at anchors of numbers (N,) and places (N, 4)."""
    values = np.concatenate([box_2d, box_3d], 1) * spec.std[:10] + spec.mean[:10]
    prior = spec.priors[anchor]
    size = boxes[:, 2:]
    center = boxes[:, :2] + values[:, :2] * size
    half = 0.5 * size * np.exp(np.clip(values[:, 2:4], -_MAX_LOG, _MAX_LOG))
    shift = np.clip(values[:, 6], -_MAX_LOG, _MAX_LOG) if spec.log_depth else values[:, 6]
    alpha, odds = _heading(spec, prior[:, 4], heading)
    return DecodedBoxes(
        xyxy_px=np.concatenate([center - half, center + half], 1),
        center_px=boxes[:, :2] + values[:, 4:6] * size,
        depth_m=prior[:, 0] * np.exp(shift) if spec.log_depth else prior[:, 0] + shift,
        dims_lwh=prior[:, 1:4] * np.exp(np.clip(values[:, 7:10], -_MAX_LOG, _MAX_LOG)),
        alpha=alpha,
        flip_log_odds=odds,
    )


def decoded_sigma(spec: GuidedSpec, anchor: NDArray[np.int64], decoded: DecodedBoxes, sigma: Array) -> Array:
    """Sigmas (N, 7) of u v (px), depth, l w h (metres), alpha from those of the standardised outputs (N, 7)."""
    spread = spec.std[4:].copy()
    if len(spec.bin_centers_rad):
        spread[6] = 1.0
    unit = np.ones_like(sigma)
    unit[:, :2] = spec.anchors_px[anchor]
    unit[:, 2] = decoded.depth_m if spec.log_depth else 1.0
    unit[:, 3:6] = decoded.dims_lwh
    scaled: Array = sigma * spread * unit
    return scaled


def suppress_guided(detections: GuidedDetections, nms_iou: float) -> GuidedDetections:
    """Greedy non-maximum suppression of the 2D boxes over all classes together."""
    return detections.take(unsuppressed(detections.xyxy_px, detections.score, nms_iou))


def _heading(spec: GuidedSpec, prior_alpha: Array, heading: Array) -> tuple[Array, Array]:
    """Alpha (N,) and its log-odds against alpha + pi (N,)."""
    bins = len(spec.bin_centers_rad)
    if not bins:
        return wrap_angle(prior_alpha + heading[:, 0] * spec.std[10] + spec.mean[10]), np.zeros(len(heading))
    cosine, sine, logits = heading[:, :bins], heading[:, bins : 2 * bins], heading[:, 2 * bins :]
    rows = np.arange(len(heading))
    best = logits.argmax(1)
    ordered = np.sort(logits, axis=1)
    angle = np.arctan2(sine[rows, best], cosine[rows, best]) + spec.bin_centers_rad[best]
    return wrap_angle(angle), ordered[:, -1] - ordered[:, -2]


def _softmax(logits: Array) -> Array:
    shifted = np.exp(logits - logits.max(1, keepdims=True, initial=-np.inf))
    normalised: Array = shifted / shifted.sum(1, keepdims=True)
    return normalised
