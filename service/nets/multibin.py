"""The multi-bin head: a crop of one vehicle in, observation angle and size out (the paper's equations 2 and 3)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from service.errors import PackError
from service.geometry.transforms import Array, wrap_angle
from service.nets.canvas import PAD_VALUE
from service.nets.error_model import ErrorModel
from service.nets.pack import Network

CONTEXT = 1.2
"""Side of the square crop over the longer side of the 2D box: a margin, and the box's shape kept."""

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
    """Of length, width and height, metres."""
    sigma_alpha_rad: ErrorModel
    """Of the angle, flips aside, radians."""

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
            )
        except (KeyError, TypeError, ValueError) as error:
            raise PackError(f"metadata is incomplete: {error!r}.", field="multibin", remedy="Export the pack again.") from error


@dataclass(frozen=True, eq=False)
class MultibinEstimates:
    """Angles and sizes of N vehicles."""

    alpha: Array
    """(N,) heading relative to the azimuth of the ray through the box's centre, radians in [-pi, pi); NaN: no heading."""
    flip_log_odds: Array
    """(N,) log-odds of alpha against alpha + pi."""
    dims_lwh: Array
    """(N, 3) metres."""


class Multibin:
    """The multi-bin head of a pack."""

    def __init__(self, network: Network) -> None:
        self.spec = MultibinSpec.from_metadata(network.metadata)
        self.network = network

    def estimate(self, crops: NDArray[np.uint8], cls: NDArray[np.int64]) -> MultibinEstimates:
        """Estimates for crops (N, S, S, 3) RGB uint8 of vehicles of classes (N,). N may be 0."""
        if len(crops) == 0:
            return MultibinEstimates(np.zeros(0), np.zeros(0), np.zeros((0, 3)))
        vectors, confidence, residual = self.network.run(crops)
        return decode_multibin(vectors, confidence, residual, cls, self.spec)


def decode_multibin(
    vectors: NDArray[np.float32],
    confidence: NDArray[np.float32],
    residual: NDArray[np.float32],
    cls: NDArray[np.int64],
    spec: MultibinSpec,
) -> MultibinEstimates:
    """Angles and sizes from raw outputs: bin (cos, sin) pairs (N, B, 2), bin logits (N, B), size residuals (N, 3), metres."""
    best = confidence.argmax(1)
    cosine, sine = vectors[np.arange(len(best)), best].T
    alpha = wrap_angle(np.arctan2(sine, cosine) + spec.bin_centers_rad[best])
    ordered = np.sort(confidence.astype(np.float64), axis=1)
    return MultibinEstimates(
        # The graph makes vectors one long; a quantised one can be too short to point anywhere.
        alpha=np.where(np.hypot(cosine, sine) < _MIN_LENGTH, np.nan, alpha),
        flip_log_odds=ordered[:, -1] - ordered[:, -2],
        dims_lwh=np.maximum(spec.mean_dims_lwh[cls] + residual, 0.3),
    )


def crop_vehicles(image: NDArray[np.uint8], xyxy_px: ArrayLike, crop_px: int) -> NDArray[np.uint8]:
    """Square crops (N, S, S, 3) around 2D boxes (N, 4) of an image (H, W, 3); outside the image they are grey."""
    xyxy = np.asarray(xyxy_px, dtype=np.float64).reshape(-1, 4)
    crops = np.empty((len(xyxy), crop_px, crop_px, 3), np.uint8)
    height, width = image.shape[:2]
    for row, (x0, y0, x1, y1) in enumerate(xyxy.tolist()):
        side = max(round(CONTEXT * max(x1 - x0, y1 - y0)), 4)
        left, top = round((x0 + x1 - side) / 2), round((y0 + y1 - side) / 2)
        inside = image[max(top, 0) : max(min(top + side, height), 0), max(left, 0) : max(min(left + side, width), 0)]
        if inside.shape[:2] != (side, side):
            square = np.full((side, side, 3), PAD_VALUE, np.uint8)
            y, x = max(-top, 0), max(-left, 0)
            square[y : y + inside.shape[0], x : x + inside.shape[1]] = inside
            inside = square
        interpolation = cv2.INTER_AREA if side > crop_px else cv2.INTER_LINEAR
        cv2.resize(inside, (crop_px, crop_px), dst=crops[row], interpolation=interpolation)
    return crops
