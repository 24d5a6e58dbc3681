"""From decoded frames and what the networks read in them to the measurements that lifting takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from service.depth_scale import DepthReadings
from service.geometry.boxes import clip_extents, cut_edges
from service.geometry.camera import Camera, UInt8Image, yaw_from_alpha
from service.geometry.transforms import Array
from service.measurements import Measurements
from service.nets.detections import Detections
from service.nets.detector import edge_sigma
from service.nets.detector_spec import DetectorSpec
from service.nets.multibin import UNCERTAIN, Crops, Multibin, MultibinEstimates, MultibinSpec, cut_crops

ERR_TOGETHER = 1.5
"""What a head's sigmas of edges and tangents are multiplied by: each is honest for itself, but twelve readings of one look at a
vehicle err together, and do not tell as much as twelve looks (validation scenes; docs: lifting)."""
_MOST_SHIFT = 0.5
"""Beyond this share of its side an outline is of another vehicle, or of none."""
_UNKNOWN_YAW_SIGMA = np.pi / np.sqrt(3.0)
"""Standard deviation of an angle that may be any, radians."""


@dataclass(frozen=True, eq=False)
class Still:
    """One camera's decoded frame, at up to three sizes, of which several may be one: detector and depth net see the smallest,
    crops are cut from ``image``, and ``whole`` is for a depth-guided detector that wants more."""

    site_camera: Camera
    """The site's camera, at the size of its frames."""
    image: UInt8Image
    """(H, W, 3) RGB."""
    small: UInt8Image
    """(h, w, 3) RGB; the same picture, or the same array."""
    whole: UInt8Image
    """The same picture as it was decoded."""

    @cached_property
    def camera(self) -> Camera:
        """The camera at the size of ``image``."""
        return self.site_camera.scaled(self.image.shape[1], self.image.shape[0])

    @cached_property
    def small_camera(self) -> Camera:
        """The camera at the size of ``small``."""
        return self.site_camera.scaled(self.small.shape[1], self.small.shape[0])

    @cached_property
    def whole_camera(self) -> Camera:
        """The camera at the size of ``whole``."""
        return self.site_camera.scaled(self.whole.shape[1], self.whole.shape[0])

    @property
    def scale(self) -> tuple[float, float]:
        """Pixels of ``image`` a pixel of ``small``, across and down."""
        return self.image.shape[1] / self.small.shape[1], self.image.shape[0] / self.small.shape[0]


def cut_detected(stills: Sequence[Still], found: Sequence[Detections], crop_px: int) -> Crops:
    """Crops of all detections (in px of ``small``), a still after the other."""
    pairs = zip(stills, _in_image(stills, found), strict=True)
    return Crops.concatenate([cut_crops(still.image, xyxy, crop_px) for still, xyxy in pairs])


def _in_image(stills: Sequence[Still], found: Sequence[Detections]) -> list[Array]:
    """Each still's detected boxes (n, 4), which are in px of ``small``, in px of ``image``."""
    return [own.scaled(still.scale).xyxy_px for still, own in zip(stills, found, strict=True)]


def refined(
    stills: Sequence[Still], found: Sequence[Detections], estimates: MultibinEstimates, head: Multibin, least_shift: float
) -> MultibinEstimates:
    """Estimates of which those are read again whose outlines and detected boxes disagree."""
    again, crops = second_looks(stills, found, estimates, head.spec.crop_px, least_shift)
    if not len(again):
        return estimates
    cls = np.concatenate([own.cls for own in found])
    return estimates.with_rows(again, head.estimate(crops, cls[again]))


def second_looks(
    stills: Sequence[Still], found: Sequence[Detections], estimates: MultibinEstimates, crop_px: int, least_shift: float
) -> tuple[NDArray[np.int64], Crops]:
    """Which vehicles (M,) are to be read again, and their crops (M).

    A head reads best what its crop shows in the middle. Where an edge that it read lies farther from the detector's than
    ``least_shift`` of the box's longer side, a second crop is cut around the outline.
    """
    index = np.repeat(np.arange(len(stills)), [len(own) for own in found])
    boxes = np.concatenate(_in_image(stills, found))
    # A head that reads no outline has nothing against the detector's box.
    outlines = boxes if estimates.xyxy_px is None else estimates.xyxy_px
    side = (boxes[:, 2:] - boxes[:, :2]).max(1)
    shift = np.abs(outlines - boxes).max(1) / np.maximum(side, 1.0)
    again = np.flatnonzero((shift > least_shift) & (shift < _MOST_SHIFT))
    crops = [cut_crops(still.image, outlines[again[index[again] == row]], crop_px) for row, still in enumerate(stills)]
    return again, Crops.concatenate(crops)


def measure(
    stills: Sequence[Still],
    found: Sequence[Detections],
    estimates: MultibinEstimates,
    readings: DepthReadings,
    detector: DetectorSpec,
    multibin: MultibinSpec,
) -> Measurements:
    """What the networks say of all detections, in px of ``image``, each reading with its standard deviation."""
    index = np.repeat(np.arange(len(stills)), [len(own) for own in found])
    pairs = zip(stills, _in_image(stills, found), strict=True)
    seen = np.concatenate([clip_extents(still.camera, xyxy) for still, xyxy in pairs])
    cut = np.concatenate([cut_edges(still.camera, seen[index == row]) for row, still in enumerate(stills)])
    score = np.concatenate([own.score for own in found])
    scale = np.tile(np.array([still.scale for still in stills]).reshape(-1, 2), 2)[index]
    xyxy, sigma_px = _edges(seen, cut, score, scale, estimates, detector)
    tangents_px, sigma_tangents_px = _tangents(estimates)
    headed = np.isfinite(estimates.alpha)
    alpha, yaw = np.where(headed, estimates.alpha, 0.0), np.zeros(len(index))
    for row, still in enumerate(stills):
        own_rows = index == row
        yaw[own_rows] = yaw_from_alpha(still.camera, alpha[own_rows], estimates.center_px[own_rows])
    sigma_yaw, sigma_dims = multibin.sigmas(estimates, score, cut.any(1))
    return Measurements(
        camera_index=index,
        xyxy_px=xyxy,
        sigma_px=sigma_px,
        dims_lwh=estimates.dims_lwh,
        sigma_dims=sigma_dims,
        yaw=yaw,
        sigma_yaw=np.where(headed, sigma_yaw, _UNKNOWN_YAW_SIGMA),
        flip_log_odds=np.where(headed, estimates.flip_log_odds, 0.0),
        score=score,
        cls=np.concatenate([own.cls for own in found]),
        depth_m=readings.depth_m,
        sigma_depth_m=readings.sigma_m,
        tangents_px=tangents_px,
        sigma_tangents_px=sigma_tangents_px,
    )


def _tangents(estimates: MultibinEstimates) -> tuple[Array, Array]:
    """Tangents (N, K) and their standard deviations (N, K), px; K is 0 where the head reads none."""
    if estimates.tangents_px is None or estimates.sigma is None:
        return np.zeros((len(estimates.alpha), 0)), np.zeros((len(estimates.alpha), 0))
    return estimates.tangents_px, ERR_TOGETHER * estimates.sigma[:, len(UNCERTAIN) :]


def _edges(
    seen: Array, cut: NDArray[np.bool_], score: Array, scale: Array, estimates: MultibinEstimates, detector: DetectorSpec
) -> tuple[Array, Array]:
    """Edges (N, 4) and their standard deviations (N, 4), px: the head's own where it reads any, else the detector's ``seen``.

    scale: (N, 4) pixels of the large image a pixel that the detector saw. An edge that the image border cuts stays at the
    border, whatever the head makes of it.
    """
    if estimates.xyxy_px is None or estimates.sigma is None:
        small = (seen + 0.5) / scale - 0.5
        return seen, edge_sigma(detector, small, score, cut.any(1)) * scale
    return np.where(cut, seen, estimates.xyxy_px), ERR_TOGETHER * estimates.sigma[:, 4 : len(UNCERTAIN)]
