"""What the anchors of the depth-guided detector are asked for: priors, assignment, encoded targets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from models_export.data.guided_frames import GuidedFrame
from models_export.nets.guided import GuidedConfig
from service.errors import InputError
from service.geometry.iou import iou_2d
from service.geometry.transforms import Array, wrap_angle
from service.nets.guided import GuidedSpec, anchor_boxes

PRIOR_IOU = 0.2
"""Vehicles that overlap an anchor by more make its prior."""
IGNORED_SHARE = 0.5
"""Anchors of which ignored vehicles cover more are not blamed."""
_MEASURED_FRAMES = 512
Index = NDArray[np.int64]


@dataclass(frozen=True)
class AssignConfig:
    """Which anchors answer for which vehicles."""

    foreground_iou: float = 0.5
    """An anchor that overlaps a vehicle by at least this answers for it."""
    best_iou: float = 0.35
    """So does a vehicle's best anchor, from this overlap on."""
    background_iou: float = 0.5
    """Anchors that answer for nothing and overlap less are background; between the two they are not asked."""


@dataclass(frozen=True, eq=False)
class Assignment:
    """P anchors that answer for vehicles of one frame."""

    anchor: Index
    row: Index
    column: Index
    vehicle: Index
    """(P,) rows of the frame's vehicles."""
    blamed: NDArray[np.bool_]
    """(A, h, w) anchors that are background."""


def all_anchors(spec: GuidedSpec, grid: tuple[int, int]) -> tuple[Index, Index, Index]:
    """Number, row and column of every anchor of a grid (h, w), in the order of the outputs' channels."""
    mesh = np.meshgrid(np.arange(len(spec.anchors_px)), np.arange(grid[0]), np.arange(grid[1]), indexing="ij")
    anchor, row, column = (m.reshape(-1) for m in mesh)
    return anchor, row, column


def corners_of(boxes: Array) -> Array:
    """x0 y0 x1 y1 of boxes (N, 4) given as centre and size."""
    half = 0.5 * boxes[:, 2:]
    return np.concatenate([boxes[:, :2] - half, boxes[:, :2] + half], 1)


def assign_anchors(frame: GuidedFrame, spec: GuidedSpec, grid: tuple[int, int], config: AssignConfig) -> Assignment:
    """Which anchors of a grid (h, w) answer for the frame's vehicles, and which are background."""
    anchor, row, column = all_anchors(spec, grid)
    corners = corners_of(anchor_boxes(spec, anchor, row, column))
    wanted = np.flatnonzero(~frame.ignore)
    overlap = iou_2d(corners, frame.xyxy_px[wanted])
    best = overlap.max(1, initial=0.0)
    owner = overlap.argmax(1) if len(wanted) else np.zeros(len(corners), np.int64)
    answers = best >= config.foreground_iou
    if len(wanted):
        champion = overlap.argmax(0)
        good = np.flatnonzero(overlap[champion, np.arange(len(wanted))] >= config.best_iou)
        answers[champion[good]], owner[champion[good]] = True, good
    positive = np.flatnonzero(answers)
    blamed = ~answers & (best < config.background_iou) & ~_hidden(corners, frame.xyxy_px[frame.ignore])
    return Assignment(
        anchor[positive], row[positive], column[positive], wanted[owner[positive]], blamed.reshape(len(spec.anchors_px), *grid)
    )


def _hidden(corners: Array, ignored: Array) -> NDArray[np.bool_]:
    """Anchors (N,) of which an ignored box covers more than ``IGNORED_SHARE``."""
    low = np.maximum(corners[:, None, :2], ignored[None, :, :2])
    high = np.minimum(corners[:, None, 2:], ignored[None, :, 2:])
    shared = np.prod(np.maximum(high - low, 0.0), -1)
    hidden: NDArray[np.bool_] = shared.max(1, initial=0.0) > IGNORED_SHARE * np.prod(corners[:, 2:] - corners[:, :2], 1)
    return hidden


def encode(spec: GuidedSpec, frame: GuidedFrame, vehicle: Index, anchor: Index, boxes: Array) -> Array:
    """Standardised targets (P, 11) of vehicles at anchors (P, 4): x y w h, u v depth l w h, alpha.

    The inverse of ``service.nets.guided.decode_boxes``: both measure a box as corner differences, without the "minus one
    pixel" that some references encode with and decode without.
    """
    xyxy, size, prior = frame.xyxy_px[vehicle], boxes[:, 2:], spec.priors[anchor]
    center, sides = (xyxy[:, :2] + xyxy[:, 2:]) / 2, xyxy[:, 2:] - xyxy[:, :2]
    depth = frame.depth_m[vehicle] * spec.depth_factor(abs(frame.K[1, 1]))
    shift = np.log(depth / prior[:, 0]) if spec.log_depth else depth - prior[:, 0]
    raw = [
        (center - boxes[:, :2]) / size,
        np.log(sides / size),
        (frame.center_px[vehicle] - boxes[:, :2]) / size,
        shift[:, None],
        np.log(frame.dims_lwh[vehicle] / prior[:, 1:4]),
        wrap_angle(frame.alpha[vehicle] - prior[:, 4])[:, None],
    ]
    standardised: Array = (np.concatenate(raw, 1) - spec.mean) / spec.std
    return standardised


def fit_spec(frames: Sequence[GuidedFrame], config: GuidedConfig, assign: AssignConfig) -> GuidedSpec:
    """Anchors with their priors, and mean and deviation of the targets, from training frames as they are.

    Raises InputError where no vehicle meets an anchor.
    """
    count = len(config.anchors_px)
    bare = GuidedSpec(
        classes=config.classes, stride=config.stride, anchors_px=np.array(config.anchors_px), priors=np.ones((count, 5)),
        mean=np.zeros(11), std=np.ones(11), focal_px=config.focal_px, log_depth=config.log_depth,
        bin_centers_rad=np.array(config.bin_centers_rad), guides=config.guides, guide_stride=config.guide_stride,
        sigma_scale=np.ones(7),
    )  # fmt: skip
    spec = replace(bare, priors=_priors(frames, bare))
    targets = [np.zeros((0, 11))]
    for frame in frames[:: max(len(frames) // _MEASURED_FRAMES, 1)]:
        grid = frame.canvas.shape[0] // spec.stride, frame.canvas.shape[1] // spec.stride
        found = assign_anchors(frame, spec, grid, assign)
        boxes = anchor_boxes(spec, found.anchor, found.row, found.column)
        targets.append(encode(spec, frame, found.vehicle, found.anchor, boxes))
    every = np.concatenate(targets)
    if len(every) < 2:
        raise InputError("no vehicle meets an anchor.", field="data", remedy="Give more scenes, or other anchors.")
    return replace(spec, mean=every.mean(0).round(6), std=np.maximum(every.std(0), 1e-3).round(6))


def _priors(frames: Sequence[GuidedFrame], spec: GuidedSpec) -> Array:
    """(A, 5) means over the vehicles that overlap each anchor, put at the cell nearest to them, by more than ``PRIOR_IOU``.

    An anchor that no vehicle overlaps takes the mean of all.
    """
    rows, overlaps = [np.zeros((0, 5))], [np.zeros((0, len(spec.anchors_px)))]
    for frame in frames:
        wanted = ~frame.ignore
        xyxy = frame.xyxy_px[wanted]
        depth = frame.depth_m[wanted] * spec.depth_factor(abs(frame.K[1, 1]))
        rows.append(np.column_stack([depth, frame.dims_lwh[wanted], frame.alpha[wanted]]))
        overlaps.append(_overlap_at_nearest_cell(spec, xyxy))
    values, meets = np.concatenate(rows), np.concatenate(overlaps) > PRIOR_IOU
    if len(values) == 0:
        raise InputError("no vehicles.", field="data", remedy="Give scenes that hold some.")
    meets[:, ~meets.any(0)] = True
    priors = np.stack([_mean_box(values[mask]) for mask in meets.T])
    return priors.round(5)


def _overlap_at_nearest_cell(spec: GuidedSpec, xyxy: Array) -> Array:
    """IoU (N, A) of boxes (N, 4) with each anchor at the cell nearest to the box's centre."""
    center = (xyxy[:, :2] + xyxy[:, 2:]) / 2
    cell = np.floor((center + 0.5) / spec.stride).astype(np.int64)
    count = len(spec.anchors_px)
    anchor = np.tile(np.arange(count), len(xyxy))
    corners = corners_of(anchor_boxes(spec, anchor, np.repeat(cell[:, 1], count), np.repeat(cell[:, 0], count)))
    boxes = np.repeat(xyxy, count, 0)
    low, high = np.maximum(corners[:, :2], boxes[:, :2]), np.minimum(corners[:, 2:], boxes[:, 2:])
    shared = np.prod(np.maximum(high - low, 0.0), 1)
    union = np.prod(corners[:, 2:] - corners[:, :2], 1) + np.prod(boxes[:, 2:] - boxes[:, :2], 1) - shared
    overlap: Array = (shared / union).reshape(len(xyxy), count)
    return overlap


def _mean_box(values: Array) -> Array:
    """Mean (5,) of depth, l, w, h and alpha (M, 5); the angle's on the circle."""
    alpha = np.arctan2(np.sin(values[:, 4]).mean(), np.cos(values[:, 4]).mean())
    return np.append(values[:, :4].mean(0), alpha)
