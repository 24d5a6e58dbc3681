"""Scores of an exported depth-guided detector on validation frames, through the service's own code."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models_export.data.guided_frames import GuidedFrame, frame_maps
from models_export.data.samples import Sample
from models_export.validate import MATCH_IOU, detector_scores, image_of
from service.geometry.iou import iou_2d
from service.geometry.transforms import Array, wrap_angle
from service.nets.detections import Detections
from service.nets.guided import GuidedDetections, GuidedDetector

Index = NDArray[np.int64]
SCORE_FLOOR = 0.05
"""Detections below do not enter the precision-recall curve."""
MATCH_SCORE = 0.3
"""Detections above measure errors."""
_NORMAL_68 = 68.27
FIELDS = ("u_px", "v_px", "depth_m", "length_m", "width_m", "height_m", "alpha_rad")


@dataclass(frozen=True, eq=False)
class GuidedErrors:
    """What validation says of a detector."""

    sigma_scale: Array
    """(7,) 68th percentile of |error| / sigma, to go into the spec."""
    scores: dict[str, Any]


def detect_frames(detector: GuidedDetector, samples: Sequence[Sample], frames: Sequence[GuidedFrame]) -> list[GuidedDetections]:
    """Detections of every frame above ``SCORE_FLOOR``."""
    return [
        detector.detect(
            [image_of(sample)], [frame_maps(detector.spec, frame)], [abs(frame.K[1, 1])], score_threshold=SCORE_FLOOR
        )[0]
        for sample, frame in zip(samples, frames, strict=True)
    ]


def measure(detector: GuidedDetector, samples: Sequence[Sample], frames: Sequence[GuidedFrame]) -> GuidedErrors:
    """2D scores; errors of depth, heading and size; and by what the given sigmas must be multiplied to be honest."""
    found = detect_frames(detector, samples, frames)
    flat = [Detections(d.xyxy_px, d.score, d.cls) for d in found]
    errors, sigmas, depths = [np.zeros((0, 7))], [np.zeros((0, 7))], [np.zeros(0)]
    for frame, detections in zip(frames, found, strict=True):
        rows, truth = _matches(detections, frame)
        errors.append(_errors(detections.take(rows), frame, truth))
        sigmas.append(detections.sigma[rows])
        depths.append(frame.depth_m[truth])
    error, sigma, depth = np.concatenate(errors), np.concatenate(sigmas), np.concatenate(depths)
    flipped = np.abs(error[:, 6]) > np.pi / 2
    error[:, 6] = wrap_angle(error[:, 6] + np.pi * flipped)
    size = np.abs(error)
    scale = np.percentile(size / sigma, _NORMAL_68, axis=0) if len(size) else np.ones(7)
    scores: dict[str, Any] = dict(detector_scores(flat, samples))
    if len(size):
        scores |= {f"median_{name}": round(float(np.median(size[:, k])), 4) for k, name in enumerate(FIELDS)}
        scores |= {
            "depth_relative_median": round(float(np.median(size[:, 2] / depth)), 4),
            "flips_percent": round(100 * float(flipped.mean()), 2),
            "sigma_scale": scale.round(4).tolist(),
        }
    return GuidedErrors(scale.round(4), scores)


def _matches(found: GuidedDetections, frame: GuidedFrame) -> tuple[Index, Index]:
    """Detections that overlap a countable vehicle by more than ``MATCH_IOU``, and those vehicles."""
    overlap = iou_2d(found.xyxy_px, frame.xyxy_px)
    if not overlap.size:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    truth = overlap.argmax(1)
    rows = np.flatnonzero((overlap.max(1) > MATCH_IOU) & (found.score > MATCH_SCORE) & ~frame.ignore[truth])
    return rows, truth[rows]


def _errors(found: GuidedDetections, frame: GuidedFrame, truth: Index) -> Array:
    """(M, 7) of u v depth l w h alpha."""
    parts = (
        found.center_px - frame.center_px[truth],
        (found.depth_m - frame.depth_m[truth])[:, None],
        found.dims_lwh - frame.dims_lwh[truth],
        wrap_angle(found.alpha - frame.alpha[truth])[:, None],
    )
    return np.concatenate(parts, 1)
