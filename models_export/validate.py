"""Scores and error sizes of exported networks on validation scenes, through the service's own code.

The sigmas measured here go into the ONNX metadata: lifting weighs each reading by them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from models_export.data.samples import Sample
from service.depth_scale import DepthScale, fit_scale, ground_inverse_depth, read_boxes
from service.errors import InputError
from service.geometry.boxes import cut_edges, scaled_extents, scaled_points, tangents_of
from service.geometry.camera import Camera, ray_azimuth
from service.geometry.iou import iou_2d
from service.geometry.transforms import Array, wrap_angle
from service.nets.depth import UNBIASED, DepthNet, InverseDepth
from service.nets.detections import Detections
from service.nets.detector import Detector, box_size
from service.nets.error_model import ErrorModel
from service.nets.multibin import OUTLINE, Multibin, cut_crops

SCORE_FLOOR = 0.05
"""Detections below do not enter the precision-recall curve."""
MATCH_IOU = 0.5
"""Detections that overlap a vehicle by more measure edges, angles and sizes."""
_NORMAL_68 = 68.27
_SCORE_BINS, _SIZE_BINS = 8, 4
_MIN_ERRORS = 4 * _SCORE_BINS * _SIZE_BINS
_MIN_CUT = 30


class TooFewVehiclesError(InputError):
    """The detector finds too few of the validation scenes' vehicles to measure anything on them."""

    def __init__(self) -> None:
        super().__init__(
            "the detector finds next to nothing on the validation scenes.", field="detector", remedy="Train it longer."
        )


@dataclass(frozen=True, eq=False)
class Matched:
    """Detections of one sample matched with its vehicles."""

    sample: Sample
    xyxy_px: Array
    """(M, 4) detected boxes."""
    score: Array
    """(M,)"""
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
        matches.append(Matched(sample, found.xyxy_px[good], found.score[good], truth[good]))
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


def fit_error_model(error: Array, score: Array, is_cut: NDArray[np.bool_], size: Array | None = None) -> ErrorModel:
    """The error model of absolute errors (N,) on detections of scores (N,), cut or not (N,), of sizes (N,).

    Fitted to the 68th percentile of the errors in bins of score (and size), which a few gross errors do not move. Raises
    TooFewVehiclesError when there are too few errors to measure anything.
    """
    whole = np.flatnonzero(~is_cut)
    if len(whole) < _MIN_ERRORS:
        raise TooFewVehiclesError
    sizes = np.zeros_like(error) if size is None else size
    rows = []
    for by_score in np.array_split(whole[np.argsort(score[whole])], _SCORE_BINS):
        for part in np.array_split(by_score[np.argsort(sizes[by_score])], 1 if size is None else _SIZE_BINS):
            rows.append((score[part].mean(), sizes[part].mean(), np.percentile(error[part], _NORMAL_68)))
    scores, means, sigmas = np.array(rows).T

    def misfit(parameters: Array) -> Array:
        floor, slope, growth = parameters
        misfits: Array = np.log((floor + slope * means) * np.exp(growth * (1 - scores))) - np.log(np.maximum(sigmas, 1e-6))
        return misfits

    slope_limit = 1e-9 if size is None else np.inf
    start = [float(np.median(sigmas)), min(1e-3, slope_limit / 2), 1.0]
    floor, slope, growth = least_squares(misfit, start, bounds=([1e-6, 0.0, 0.0], [np.inf, slope_limit, 10.0])).x
    model = ErrorModel(round(float(floor), 6), round(float(slope), 6), round(float(growth), 4), 1.0)
    if is_cut.sum() < _MIN_CUT:
        return model
    excess = error[is_cut] / model.sigma(score[is_cut], False, sizes[is_cut])
    return replace(model, cut=round(max(float(np.percentile(excess, _NORMAL_68)), 1.0), 3))


def edge_errors(matches: Sequence[Matched]) -> ErrorModel:
    """The error model of box edges, px. Edges at the border itself are left out: lifting does not read them.

    Raises TooFewVehiclesError.
    """
    error, score, is_cut, size = [], [], [], []
    for m in matches:
        at_border = cut_edges(m.sample.camera, m.xyxy_px)
        inner = ~at_border
        error.append(np.abs(m.xyxy_px - m.sample.xyxy_px[m.truth])[inner])
        score.append(np.repeat(m.score[:, None], 4, 1)[inner])
        is_cut.append(np.repeat(at_border.any(1)[:, None], 4, 1)[inner])
        size.append(np.repeat(box_size(m.xyxy_px)[:, None], 4, 1)[inner])
    return fit_error_model(np.concatenate(error), np.concatenate(score), np.concatenate(is_cut), np.concatenate(size))


def multibin_scores(multibin: Multibin, matches: Sequence[Matched]) -> dict[str, Any]:
    """Errors of angle and size on detected boxes: medians, flips, and the error models that lifting uses.

    Of a head that predicts an outline and standard deviations, also the outline's errors and ``sigma_scale``: what makes the
    predicted deviations cover 68 % of the errors. Raises TooFewVehiclesError.
    """
    rows = [_head_errors(multibin, m) for m in matches if len(m.truth)]
    if not rows:
        raise TooFewVehiclesError
    error, sigma = np.concatenate([row.error for row in rows]), np.concatenate([row.sigma for row in rows])
    flipped, is_cut = np.concatenate([row.flipped for row in rows]), np.concatenate([row.is_cut for row in rows])
    score = np.concatenate([row.score for row in rows])
    angles, sizes, outline = np.abs(error[:, 0]), error[:, 1:4], np.abs(error[:, OUTLINE])
    scores = {
        "vehicles": len(angles),
        "angle_median_deg": round(float(np.degrees(np.median(angles))), 3),
        "angle_p90_deg": round(float(np.degrees(np.percentile(angles, 90))), 3),
        "flips_percent": round(100 * float(np.mean(flipped)), 3),
        "size_rmse_lwh_m": np.sqrt((sizes**2).mean(0)).round(4).tolist(),
        "sigma_alpha_rad": fit_error_model(angles, score, is_cut).to_metadata(),
        "sigma_dims_lwh": [fit_error_model(np.abs(sizes[:, axis]), score, is_cut).to_metadata() for axis in range(3)],
    }
    if multibin.spec.sigma_scale is None:
        return scores
    ratio = np.where(np.isfinite(error), np.abs(error) / sigma, np.nan)
    return scores | {
        "outline_median_px": round(float(np.nanmedian(outline)), 3),
        "outline_p90_px": round(float(np.nanpercentile(outline, 90)), 3),
        "sigma_scale": np.nanpercentile(ratio, _NORMAL_68, axis=0).round(4).tolist(),
    }


@dataclass(frozen=True, eq=False)
class _HeadErrors:
    """What the head says of M matched detections, less the truth."""

    error: Array
    """(M, 8 or 16) in the order of ``UNCERTAIN`` and the tangents: radians (flips aside), metres, px; NaN for edges that are
    cut, or not read."""
    sigma: Array
    """(M, 8 or 16) predicted standard deviations; ones where the head predicts none."""
    flipped: NDArray[np.bool_]
    is_cut: NDArray[np.bool_]
    score: Array


def _head_errors(multibin: Multibin, m: Matched) -> _HeadErrors:
    sample, spec = m.sample, multibin.spec
    image, camera = image_of(sample), sample.camera
    if spec.max_width is not None and sample.still is not None:
        image, camera = sample.still.at(spec.max_width)
    factor = np.array([image.shape[1] / sample.image_size[0], image.shape[0] / sample.image_size[1]])
    detected, truth = (scaled_extents(xyxy, factor) for xyxy in (m.xyxy_px, sample.xyxy_px[m.truth]))
    estimate = multibin.estimate(cut_crops(image, detected, spec.crop_px), sample.cls[m.truth])
    corners = scaled_points(sample.corners_px[m.truth], factor)
    turn = wrap_angle(estimate.alpha + _azimuth(camera, detected) - sample.alpha[m.truth] - _azimuth(camera, truth))
    flip = np.abs(turn) > np.pi / 2
    cut = cut_edges(camera, detected)
    outline = np.full((len(m.truth), 4), np.nan)
    if estimate.xyxy_px is not None:
        outline = np.where(cut, np.nan, estimate.xyxy_px - truth)
    if estimate.tangents_px is not None:
        outline = np.concatenate([outline, estimate.tangents_px - tangents_of(corners)], 1)
    angle = wrap_angle(turn + np.pi * flip)
    error = np.concatenate([angle[:, None], estimate.dims_lwh - sample.dims_lwh[m.truth], outline], 1)
    sigma = np.ones_like(error) if estimate.sigma is None else estimate.sigma
    return _HeadErrors(error, sigma, flip, cut.any(1), m.score)


def _azimuth(camera: Camera, xyxy_px: Array) -> Array:
    return ray_azimuth(camera, (xyxy_px[:, :2] + xyxy_px[:, 2:]) / 2)


def depth_scores(
    depth: DepthNet, samples: Sequence[Sample], matches: Sequence[Matched]
) -> tuple[dict[str, float], NDArray[np.float64]]:
    """Errors of the depth net: of its maps, and (N,) relative ones of what the service reads in detected boxes.

    ``abs_rel`` and ``delta_1.25`` (percent) over all cells after the least-squares scale and shift of each image. Boxes are
    read with the scale that the service fits on the road.
    """
    errors, within, readings = [], [], [np.zeros(0)]
    for sample, m in zip(samples, matches, strict=True):
        ours = depth.infer([image_of(sample)])[0]
        truth = true_map(sample, ours)
        known = truth > 0
        ratio = truth[known] / np.maximum(_aligned(ours.values[known], truth[known]), 1 / 200)
        errors.append(float(np.mean(np.abs(ratio - 1))))
        within.append(float(np.mean(np.maximum(ratio, 1 / ratio) < 1.25)))
        readings.append(_reading_errors(ours, truth, sample, m))
    scores = {"abs_rel": round(float(np.mean(errors)), 4), "delta_1.25": round(100 * float(np.mean(within)), 2)}
    return scores, np.concatenate(readings)


def reading_error(errors: NDArray[np.float64]) -> dict[str, float]:
    """Median of relative errors (N,) of readings, and the 68th percentile about it. Raises TooFewVehiclesError for none.

    The map blurs a vehicle into the road behind it.
    """
    if not len(errors):
        raise TooFewVehiclesError
    bias = float(np.median(errors))
    return {
        "bias_relative": round(bias, 4),
        "sigma_relative": round(float(np.percentile(np.abs((1 + errors) / (1 + bias) - 1), _NORMAL_68)), 4),
    }


def true_map(sample: Sample, ours: InverseDepth) -> NDArray[np.float32]:
    """The true inverse depth (h, w) at the cells of a map, which may be coarser or finer than the sample's."""
    stride = sample.canvas.shape[0] / sample.inverse_depth.shape[0]
    rows, columns = (
        np.minimum(((np.arange(ours_size) + 0.5) * ours.stride / stride).astype(np.int64), size - 1)
        for ours_size, size in zip(ours.values.shape, sample.inverse_depth.shape, strict=True)
    )
    truth: NDArray[np.float32] = sample.inverse_depth[np.ix_(rows, columns)]
    return truth


def _aligned(ours: NDArray[np.float32], truth: NDArray[np.float32]) -> Array:
    design = np.stack([ours.astype(np.float64), np.ones(len(ours))], 1)
    solution, *_ = np.linalg.lstsq(design, truth.astype(np.float64), rcond=None)
    aligned: Array = design @ solution
    return aligned


def _reading_errors(ours: InverseDepth, truth: NDArray[np.float32], sample: Sample, m: Matched) -> Array:
    """Relative errors of the readings of one sample's detected boxes."""
    ground = ground_inverse_depth(sample.camera, sample.ground, ours.values.shape, ours.stride)
    read = read_boxes(ours, fit_scale(ours.values, ground), m.xyxy_px, UNBIASED).depth_m
    exact = read_boxes(InverseDepth(truth, ours.stride), DepthScale(1.0, 0.0, 0.0), m.xyxy_px, UNBIASED).depth_m
    error = read / exact - 1
    return error[np.isfinite(error)]
