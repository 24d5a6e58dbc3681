"""Scores and error sizes of exported networks on validation scenes, through the service's own code.

The sigmas measured here go into the ONNX metadata: lifting weighs each reading by them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models_export.data.samples import Sample
from service.errors import InputError
from service.geometry.camera import ray_azimuth
from service.geometry.iou import iou_2d
from service.geometry.transforms import Array, wrap_angle
from service.nets.depth import DepthNet
from service.nets.detector import Detections, Detector
from service.nets.multibin import Multibin, crop_vehicles

SCORE_FLOOR = 0.05
"""Detections below do not enter the precision-recall curve."""
MATCH_IOU = 0.6
"""Detections that overlap a vehicle by more measure edges, angles and sizes."""
_NORMAL_68 = 68.27
_SIZE_BINS = 8


@dataclass(frozen=True, eq=False)
class Matched:
    """Detections of one sample matched with its vehicles."""

    sample: Sample
    xyxy_px: Array
    """(M, 4) detected boxes."""
    truth: NDArray[np.int64]
    """(M,) rows of the sample's vehicles."""


def image_of(sample: Sample) -> NDArray[np.uint8]:
    """The image of a sample without its padding."""
    width, height = sample.image_size
    return np.ascontiguousarray(sample.canvas[:height, :width])


def detect_all(detector: Detector, samples: Sequence[Sample]) -> list[Detections]:
    """Detections of every sample above ``SCORE_FLOOR``."""
    return [detector.detect([image_of(sample)], score_threshold=SCORE_FLOOR)[0] for sample in samples]


def match_all(detections: Sequence[Detections], samples: Sequence[Sample], min_score: float = 0.3) -> list[Matched]:
    """Detections that overlap one countable vehicle by more than ``MATCH_IOU``."""
    matches = []
    for found, sample in zip(detections, samples, strict=True):
        overlap = iou_2d(found.xyxy_px, sample.xyxy_px)
        truth = overlap.argmax(1) if overlap.size else np.zeros(len(found), np.int64)
        good = overlap.max(1, initial=0.0) > MATCH_IOU
        good &= (found.score > min_score) & ~sample.ignore[truth] if len(sample.ignore) else False
        matches.append(Matched(sample, found.xyxy_px[good], truth[good]))
    return matches


def detector_scores(detections: Sequence[Detections], samples: Sequence[Sample]) -> dict[str, float]:
    """2D average precision (percent, area under the interpolated curve) at IoU 0.5 and 0.7, and recall at score 0.3."""
    scores = {f"AP_2d_{int(100 * iou)}": average_precision(detections, samples, iou) for iou in (0.5, 0.7)}
    recalled = sum(len(set(m.truth.tolist())) for m in match_all(detections, samples))
    countable = sum(int((~s.ignore).sum()) for s in samples)
    return scores | {"recall_at_0.3": round(100 * recalled / max(countable, 1), 2), "vehicles": countable}


def average_precision(detections: Sequence[Detections], samples: Sequence[Sample], min_iou: float) -> float:
    """AP in percent over all samples; detections on ignored vehicles count neither way."""
    outcomes: list[tuple[float, bool]] = []
    countable = 0
    for found, sample in zip(detections, samples, strict=True):
        overlap = iou_2d(found.xyxy_px, sample.xyxy_px)
        taken = np.zeros(len(sample.ignore), dtype=bool)
        countable += int((~sample.ignore).sum())
        for row in np.argsort(-found.score):
            free = np.where(taken, 0.0, overlap[row])
            best = int(free.argmax()) if len(free) else -1
            hit = best >= 0 and free[best] > min_iou
            if hit:
                taken[best] = True
            if not hit or not sample.ignore[best]:
                outcomes.append((float(found.score[row]), bool(hit)))
    if not outcomes or not countable:
        return 0.0
    hits = np.array([hit for _, hit in sorted(outcomes, key=lambda o: -o[0])])
    recall = np.cumsum(hits) / countable
    precision = np.cumsum(hits) / np.arange(1, len(hits) + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return round(100 * float(np.sum(np.diff(recall, prepend=0.0) * envelope)), 2)


def edge_sigma_fit(matches: Sequence[Matched]) -> tuple[float, float]:
    """(a, b) of sigma = a + b * sqrt(width * height), px: the 68th percentile of edge errors in bins of box size.

    Raises InputError when there are too few matches to measure anything.
    """
    sizes, errors = [], []
    for m in matches:
        truth = m.sample.xyxy_px[m.truth]
        sizes.append(np.repeat(np.sqrt(np.prod(truth[:, 2:] - truth[:, :2], axis=1)), 4))
        errors.append(np.abs(m.xyxy_px - truth).reshape(-1))
    size, error = np.concatenate(sizes or [np.zeros(0)]), np.concatenate(errors or [np.zeros(0)])
    if len(size) < _SIZE_BINS:
        raise InputError(
            "the detector finds next to nothing on the validation scenes.", field="detector", remedy="Train it longer."
        )
    edges = np.quantile(size, np.linspace(0, 1, _SIZE_BINS + 1))
    bins = np.clip(np.searchsorted(edges, size, side="right") - 1, 0, _SIZE_BINS - 1)
    centers = np.array([size[bins == b].mean() for b in range(_SIZE_BINS)])
    sigmas = np.array([np.percentile(error[bins == b], _NORMAL_68) for b in range(_SIZE_BINS)])
    slope, floor = np.polyfit(centers, sigmas, 1)
    return round(float(max(floor, 0.3)), 4), round(float(max(slope, 0.0)), 5)


def multibin_scores(multibin: Multibin, matches: Sequence[Matched]) -> dict[str, Any]:
    """Errors of angle and size on detected boxes: medians, flips, and the sigmas that lifting uses."""
    angle, size, flipped = [], [], []
    for m in matches:
        if not len(m.truth):
            continue
        image, sample = image_of(m.sample), m.sample
        estimate = multibin.estimate(crop_vehicles(image, m.xyxy_px, multibin.spec.crop_px), sample.cls[m.truth])
        truth_boxes = sample.xyxy_px[m.truth]
        heading = sample.alpha[m.truth] + ray_azimuth(sample.camera, (truth_boxes[:, :2] + truth_boxes[:, 2:]) / 2)
        ours = estimate.alpha + ray_azimuth(sample.camera, (m.xyxy_px[:, :2] + m.xyxy_px[:, 2:]) / 2)
        error = wrap_angle(ours - heading)
        flip = np.abs(error) > np.pi / 2
        flipped.append(flip)
        angle.append(np.abs(wrap_angle(error + np.pi * flip)))
        size.append(estimate.dims_lwh - sample.dims_lwh[m.truth])
    angles, sizes = np.concatenate(angle), np.concatenate(size)
    return {
        "vehicles": len(angles),
        "angle_median_deg": round(float(np.degrees(np.median(angles))), 3),
        "angle_p90_deg": round(float(np.degrees(np.percentile(angles, 90))), 3),
        "flips_percent": round(100 * float(np.mean(np.concatenate(flipped))), 3),
        "size_rmse_lwh_m": np.sqrt((sizes**2).mean(0)).round(4).tolist(),
        "sigma_alpha_rad": round(float(np.percentile(angles, _NORMAL_68)), 5),
        "sigma_dims_lwh": np.percentile(np.abs(sizes), _NORMAL_68, axis=0).round(4).tolist(),
    }


def depth_scores(depth: DepthNet, samples: Sequence[Sample]) -> dict[str, float]:
    """Absolute relative depth error after the least-squares scale and shift of each image, and the share within 25 %."""
    errors, within = [], []
    for sample in samples:
        ours = depth.infer([image_of(sample)])[0].values.astype(np.float64)
        truth = sample.inverse_depth[: ours.shape[0], : ours.shape[1]].astype(np.float64)
        known = truth > 0
        design = np.stack([ours[known], np.ones(known.sum())], 1)
        (scale, shift), *_ = np.linalg.lstsq(design, truth[known], rcond=None)
        inverse = np.maximum(scale * ours[known] + shift, 1 / 200)
        ratio = truth[known] / inverse
        errors.append(float(np.mean(np.abs(ratio - 1))))
        within.append(float(np.mean(np.maximum(ratio, 1 / ratio) < 1.25)))
    return {"abs_rel": round(float(np.mean(errors)), 4), "delta_1.25": round(100 * float(np.mean(within)), 2)}
