"""The multi-bin head: a crop of one vehicle in, observation angle and size out (the paper's equations 2 and 3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from service.errors import PackError
from service.geometry.boxes import TANGENT_DEGREES, TANGENT_DIRECTIONS
from service.geometry.transforms import Array, wrap_angle
from service.nets.canvas import PAD_VALUE
from service.nets.error_model import ErrorModel
from service.nets.pack import Network

CONTEXT = 1.3
"""Side of the square crop over the longer side of the 2D box: a margin, and the box's shape kept."""

UNCERTAIN = ("alpha", "length", "width", "height", "left", "top", "right", "bottom")
"""Order of the standard deviations that a head may predict: radians, metres, and sides of the crop. Those of the tangents, if
it reads them too, come after, one for each of ``TANGENT_DEGREES``."""
OUTLINE = slice(4, None)
"""Of these, the edges and tangents: lengths in the image."""
EDGES = 4
"""The first readings of the outline are the edges."""
_MIN_WINDOW_PX = 4.0
_MAX_SHRINK = 4
_MIN_LENGTH = 0.1


@dataclass(frozen=True, eq=False)
class MultibinSpec:
    """What the ONNX metadata says of a multi-bin head."""

    crop_px: int
    bin_centers_rad: Array
    """(B,) centres of the overlapping bins of alpha."""
    mean_dims_lwh: Array
    """(C, 3) mean length, width, height a class, metres: the size priors."""
    sigma_dims_lwh: tuple[ErrorModel, ...]
    """Of length, width and height, metres; for heads that do not predict their own."""
    sigma_alpha_rad: ErrorModel
    """Of the angle, flips aside, radians; for heads that do not predict their own."""
    max_width: int | None = None
    """Crops are cut from images of at most this width, px; None: from those that the detector sees."""
    sigma_scale: Array | None = None
    """(8 or 16,) what predicted standard deviations of ``UNCERTAIN`` and tangents are multiplied by, measured on validation
    scenes; None: the head predicts none, and no outline."""

    def sigmas(self, estimates: MultibinEstimates, score: ArrayLike, is_cut: ArrayLike) -> tuple[Array, Array]:
        """Standard deviations of alpha (N,), radians, and of length, width and height (N, 3), metres.

        The head's own where it predicts any; else by the detections' scores (N,) and whether the border cuts them (N,).
        """
        if estimates.sigma is not None:
            return estimates.sigma[:, 0], estimates.sigma[:, 1:4]
        sigma_dims = np.stack([model.sigma(score, is_cut) for model in self.sigma_dims_lwh], 1)
        return self.sigma_alpha_rad.sigma(score, is_cut), sigma_dims

    @staticmethod
    def from_metadata(metadata: dict[str, object]) -> MultibinSpec:
        """Read the metadata of an ONNX file. Raises PackError naming what is missing."""
        try:
            return MultibinSpec(
                crop_px=int(metadata["crop_px"]),  # type: ignore[call-overload]
                bin_centers_rad=np.array(metadata["bin_centers_rad"], dtype=np.float64),
                mean_dims_lwh=np.array(metadata["mean_dims_lwh"], dtype=np.float64).reshape(-1, 3),
                sigma_dims_lwh=tuple(ErrorModel.from_metadata(row) for row in metadata["sigma_dims_lwh"]),  # type: ignore[attr-defined]
                sigma_alpha_rad=ErrorModel.from_metadata(metadata["sigma_alpha_rad"]),
                max_width=int(metadata["max_width"]) if "max_width" in metadata else None,  # type: ignore[call-overload]
                sigma_scale=_sigma_scale(metadata.get("sigma_scale"), metadata.get("tangents_deg", ())),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise PackError(f"metadata is incomplete: {error!r}.", field="multibin", remedy="Export the pack again.") from error


def _sigma_scale(values: object, tangents_deg: Any) -> Array | None:
    """Factors (8,) or (16,) from metadata.

    Raises ValueError when they are not positive numbers, one for each standard deviation, or when the tangents' directions are
    others than the service's.
    """
    tangents = tuple(tangents_deg)
    if tangents and tangents != TANGENT_DEGREES:
        raise ValueError(f"tangents_deg {tangents_deg!r}: {TANGENT_DEGREES} are expected")
    if values is None:
        return None
    scale = np.asarray(values, dtype=np.float64)
    count = len(UNCERTAIN) + len(tangents)
    if scale.shape != (count,) or not (np.isfinite(scale).all() and (scale > 0).all()):
        raise ValueError(f"sigma_scale {values!r}: {count} positive numbers are expected")
    return scale


@dataclass(frozen=True, eq=False)
class Crops:
    """Vehicles cut out of images."""

    pixels: NDArray[np.uint8]
    """(N, S, S, 3) RGB."""
    window: NDArray[np.int64]
    """(N, 3) left, top, side of each in its image, px."""

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def center_px(self) -> Array:
        """(N, 2) middles, px of the image."""
        return window_middles(self.window)

    @staticmethod
    def concatenate(parts: Sequence[Crops]) -> Crops:
        """All crops of several images, in order."""
        return Crops(np.concatenate([p.pixels for p in parts]), np.concatenate([p.window for p in parts]))


@dataclass(frozen=True, eq=False)
class MultibinEstimates:
    """Angles and sizes of N vehicles; of heads that predict more, also outlines and uncertainties."""

    alpha: Array
    """(N,) heading relative to the azimuth of the ray through the crop's centre, radians in [-pi, pi); NaN: no heading."""
    flip_log_odds: Array
    """(N,) log-odds of alpha against alpha + pi."""
    dims_lwh: Array
    """(N, 3) metres."""
    center_px: Array
    """(N, 2) middles of the crops, px: alpha is relative to the rays through them."""
    xyxy_px: Array | None = None
    """(N, 4) extents of the vehicle in the image of the crops, px."""
    sigma: Array | None = None
    """(N, 8 or 16) standard deviations of ``UNCERTAIN`` and of the tangents: radians, metres, px."""
    tangents_px: Array | None = None
    """(N, 8) reach of the vehicle in ``TANGENT_DIRECTIONS``, px of the image of the crops; None: not read."""

    def with_rows(self, rows: NDArray[np.int64], better: MultibinEstimates) -> MultibinEstimates:
        """These with those of ``better`` in the rows (M,)."""
        merged: dict[str, Array | None] = {}
        for f in fields(self):
            own, new = getattr(self, f.name), getattr(better, f.name)
            if own is not None:
                own = own.copy()
                own[rows] = new
            merged[f.name] = own
        return MultibinEstimates(**merged)  # type: ignore[arg-type]


class Multibin:
    """The multi-bin head of a pack."""

    def __init__(self, network: Network) -> None:
        self.spec = MultibinSpec.from_metadata(network.metadata)
        self.network = network

    def estimate(self, crops: Crops, cls: NDArray[np.int64]) -> MultibinEstimates:
        """Estimates for crops of vehicles of classes (N,). N may be 0."""
        scale = self.spec.sigma_scale
        if len(crops) == 0:
            nothing = MultibinEstimates(np.zeros(0), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 2)))
            if scale is None:
                return nothing
            outline, sigma = np.zeros((0, len(scale) - len(UNCERTAIN) + EDGES)), np.zeros((0, len(scale)))
            return _with_outline(nothing, outline, sigma, crops.window)
        vectors, confidence, residual, *more = self.network.run(crops.pixels)
        estimates = decode_multibin(vectors, confidence, residual, cls, crops.center_px, self.spec)
        if scale is None:
            return estimates
        raw, log_sigma = more
        return _with_outline(estimates, raw, np.exp(log_sigma.astype(np.float64)) * scale, crops.window)


def _with_outline(
    estimates: MultibinEstimates, outline: ArrayLike, sigma: Array, window: NDArray[np.int64]
) -> MultibinEstimates:
    """Estimates with the edges and tangents (N, 4 or 12) and standard deviations (N, 8 or 16) of crops at windows (N, 3)."""
    outline = np.asarray(outline, dtype=np.float64)
    sigma[:, OUTLINE] *= window[:, 2:]
    tangents = tangents_in_image(outline[:, EDGES:], window) if outline.shape[1] > EDGES else None
    return replace(estimates, xyxy_px=edges_in_image(outline[:, :EDGES], window), sigma=sigma, tangents_px=tangents)


def window_middles(window: NDArray[np.int64]) -> Array:
    """Middles (N, 2), px, of windows (N, 3). Pixel centres lie at integers: a window begins half a pixel before the first."""
    middles: Array = window[:, :2] - 0.5 + 0.5 * window[:, 2:]
    return middles


def edges_in_image(edges: ArrayLike, window: NDArray[np.int64]) -> Array:
    """Boxes (N, 4) in px of edges (N, 4) given in sides of their crops' windows (N, 3) from the middle."""
    corner, side = window[:, [0, 1, 0, 1]], window[:, 2:]
    # Pixel centres lie at integers: a window begins half a pixel before its first one.
    boxes: Array = corner - 0.5 + (np.asarray(edges, dtype=np.float64) + 0.5) * side
    return boxes


def tangents_in_image(tangents: Array, window: NDArray[np.int64]) -> Array:
    """Reaches (N, 8) in px of tangents (N, 8) given in sides of their crops' windows (N, 3) from the middle."""
    reach: Array = window_middles(window) @ TANGENT_DIRECTIONS.T + tangents * window[:, 2:]
    return reach


def decode_multibin(
    vectors: NDArray[np.float32],
    confidence: NDArray[np.float32],
    residual: NDArray[np.float32],
    cls: NDArray[np.int64],
    center_px: Array,
    spec: MultibinSpec,
) -> MultibinEstimates:
    """Angles and sizes from raw outputs: bin (cos, sin) pairs (N, B, 2), bin logits (N, B), size residuals (N, 3), metres.

    center_px: (N, 2) middles of the crops.
    """
    rows = np.arange(len(confidence))
    logits = confidence.astype(np.float64)
    best = logits.argmax(1)
    cosine, sine = vectors[rows, best].T
    alpha = wrap_angle(np.arctan2(sine, cosine) + spec.bin_centers_rad[best])
    # The other bin whose centre is nearest to alpha + pi answers for the flip; of two bins it is the other one.
    from_flip = np.abs(wrap_angle(spec.bin_centers_rad - alpha[:, None] - np.pi))
    from_flip[rows, best] = np.inf
    return MultibinEstimates(
        # The graph makes vectors one long; a quantised one can be too short to point anywhere.
        alpha=np.where(np.hypot(cosine, sine) < _MIN_LENGTH, np.nan, alpha),
        flip_log_odds=logits[rows, best] - logits[rows, from_flip.argmin(1)],
        dims_lwh=np.maximum(spec.mean_dims_lwh[cls] + residual, 0.3),
        center_px=center_px,
    )


def cut_crops(image: NDArray[np.uint8], xyxy_px: ArrayLike, crop_px: int) -> Crops:
    """Square crops around 2D boxes (N, 4) of an image (H, W, 3)."""
    return Crops(crop_vehicles(image, xyxy_px, crop_px), crop_windows(xyxy_px))


def crop_windows(xyxy_px: ArrayLike) -> NDArray[np.int64]:
    """Square windows (N, 3: left, top, side) of the crops of 2D boxes (N, 4), px: pixels left .. left + side - 1."""
    xyxy = np.asarray(xyxy_px, dtype=np.float64).reshape(-1, 4)
    side = np.maximum(np.rint(CONTEXT * (xyxy[:, 2:] - xyxy[:, :2]).max(1, initial=0.0)), _MIN_WINDOW_PX)
    corner = np.rint((xyxy[:, :2] + xyxy[:, 2:] - side[:, None]) / 2)
    return np.concatenate([corner, side[:, None]], 1).astype(np.int64)


def crop_vehicles(image: NDArray[np.uint8], xyxy_px: ArrayLike, crop_px: int) -> NDArray[np.uint8]:
    """Square crops (N, S, S, 3) around 2D boxes (N, 4) of an image (H, W, 3); outside the image they are grey."""
    xyxy = np.asarray(xyxy_px, dtype=np.float64).reshape(-1, 4)
    crops = np.empty((len(xyxy), crop_px, crop_px, 3), np.uint8)
    height, width = image.shape[:2]
    for row, (left, top, side) in enumerate(crop_windows(xyxy).tolist()):
        right, bottom = left + side, top + side
        window = image[max(top, 0) : max(min(bottom, height), 0), max(left, 0) : max(min(right, width), 0)]
        if window.shape[:2] != (side, side):
            window = _padded(window, side, max(-left, 0), max(-top, 0))
        _shrink(window, crops[row])
    return crops


def _padded(inside: NDArray[np.uint8], side: int, x: int, y: int) -> NDArray[np.uint8]:
    """A square window of which ``inside`` is what lies in the image, from column x and row y on."""
    if not inside.size:
        return np.full((side, side, 3), PAD_VALUE, np.uint8)
    height, width = inside.shape[:2]
    edges = (y, side - y - height, x, side - x - width)
    square = cv2.copyMakeBorder(inside, *edges, cv2.BORDER_CONSTANT, value=(PAD_VALUE,) * 3)
    return np.asarray(square, dtype=np.uint8)


def _shrink(window: NDArray[np.uint8], crop: NDArray[np.uint8]) -> None:
    """A square window (side, side, 3) into a crop (S, S, 3)."""
    # Averaging over areas costs up to ten times as much and shows in no figure until crops shrink by more than this; but
    # over 2x2 pixels it is cheap. An odd row or column that this leaves out is less than a pixel of the crop.
    while (side := window.shape[0]) > _MAX_SHRINK * crop.shape[0]:
        half = side // 2
        window = cv2.resize(window[: 2 * half, : 2 * half], (half, half), interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    cv2.resize(window, crop.shape[:2], dst=crop, interpolation=cv2.INTER_LINEAR)
