"""Raw outputs of 2D detectors to boxes, before suppression: one function a format.

Formats write boxes in continuous coordinates, in which a canvas of width W spans 0..W; here pixel centres lie at integers
and it spans -0.5..W - 0.5. So each function gives continuous boxes, and :func:`decode_heads` shifts them, once. All choose
the few candidates by one comparison of raw scores before they compute anything else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.geometry.transforms import Array
from service.nets.detections import Detections
from service.nets.detector_spec import DROPPED, DetectorSpec
from service.odds import log_odds, probability

MAX_CANDIDATES = 300
"""Boxes of one image that enter non-maximum suppression, best first."""
BOX_FIELDS = 5
"""Channels of an anchor before its class scores: x, y, w, h, objectness."""
MAX_LOG_SIZE = 10.0
"""Largest exponent of a size, where a format takes an exponential: e^10 anchors are wider than any canvas."""
_LEAST_PROBABILITY = 1e-9

Outputs = Sequence[NDArray[np.float32]]


@dataclass(frozen=True, eq=False)
class _Candidates:
    """Boxes that may be worth keeping."""

    xyxy: Array
    """(n, 4) continuous canvas coordinates."""
    score: Array
    """(n,) in 0..1."""
    network_cls: NDArray[np.int64]
    """(n,) the network's class ids; the count of its classes where it gave none that it has."""


def decode_heads(heads: Outputs, spec: DetectorSpec, score_threshold: float) -> Detections:
    """Boxes of one image above a score, before suppression, in the pixels of its canvas.

    heads: all outputs of the network for one image, in the graph's order; their shapes stand at each format's function.
    Boxes of classes that the spec drops, or that are not finite, are left out.
    """
    found = _DECODERS[spec.format](heads, spec, score_threshold)
    ours = range(spec.network_classes) if spec.class_of is None else spec.class_of
    cls = np.array([*ours, DROPPED], dtype=np.int64)[found.network_cls]
    keep = np.nonzero((found.score > score_threshold) & (cls >= 0) & np.isfinite(found.xyxy).all(1))[0]
    keep = keep[np.argsort(-found.score[keep], kind="stable")][:MAX_CANDIDATES]
    return Detections(found.xyxy[keep] - 0.5, found.score[keep], cls[keep])


def _quadlift(heads: Outputs, spec: DetectorSpec, threshold: float) -> _Candidates:
    """This project's heads: one (A * (5 + C), h, w) of logits a stride.

    Per anchor: centre = (2 sigmoid(t) - 0.5 + cell) * stride, size = (2 sigmoid(t))^2 * anchor, score = sigmoid(objectness) *
    sigmoid(class): YOLOv3's decoding, with its exponential replaced by a bounded square so that no logit overflows, and
    centres free to reach into the next cell.
    """
    cells = _anchored_cells(heads, spec, threshold)
    fields = probability(cells.logits)
    center = (2.0 * fields[:, :2] - 0.5 + cells.cell) * cells.stride
    size = (2.0 * fields[:, 2:4]) ** 2 * cells.anchor
    return _scored(center, size, fields[:, 4:])


def _yolov3(heads: Outputs, spec: DetectorSpec, threshold: float) -> _Candidates:
    """Darknet's YOLOv3: one (A * (5 + C), h, w) of logits a stride.

    Per anchor: centre = (sigmoid(t) + cell) * stride, size = anchor * exp(t), score = sigmoid(objectness) * sigmoid(class).
    """
    cells = _anchored_cells(heads, spec, threshold)
    center = (probability(cells.logits[:, :2]) + cells.cell) * cells.stride
    size = cells.anchor * np.exp(np.minimum(cells.logits[:, 2:4], MAX_LOG_SIZE))
    return _scored(center, size, probability(cells.logits[:, 4:]))


def _yolox(heads: Outputs, spec: DetectorSpec, threshold: float) -> _Candidates:
    """YOLOX's export without decoding: one (N, 5 + C), the cells of all strides in turn, row by row.

    centre = (t + cell) * stride, size = exp(t) * stride; objectness and class scores are probabilities.
    """
    rows = np.nonzero(heads[0][:, 4] > threshold)[0]
    fields = heads[0][rows].astype(np.float64)
    cell, stride = _flat_cells(spec)
    center = (fields[:, :2] + cell[rows]) * stride[rows]
    size = np.exp(np.minimum(fields[:, 2:4], MAX_LOG_SIZE)) * stride[rows]
    return _scored(center, size, fields[:, 4:])


def _nanodet(heads: Outputs, spec: DetectorSpec, threshold: float) -> _Candidates:
    """NanoDet: one (N, C + 4 B), or the class scores (n, C) of every stride and then the distances (n, 4 B) of every stride.

    Each side's distance from the cell's reference point, left, top, right, bottom, is the expectation over B bins of the
    softmax, times the stride (generalised focal loss, arXiv 2006.04388).
    """
    classes = spec.network_classes
    if len(heads) == 1:
        scores, distances = heads[0][:, :classes], heads[0][:, classes:]
    else:
        scores = np.concatenate(heads[: len(spec.strides)])
        distances = np.concatenate(heads[len(spec.strides) :])
    rows = _rows_above(scores, spec, float(log_odds(threshold, _LEAST_PROBABILITY)) if spec.is_logit else threshold)
    bins = distances[rows].astype(np.float64).reshape(len(rows), 4, distances.shape[1] // 4)
    weights = np.exp(bins - bins.max(2, keepdims=True))
    cell, stride = _flat_cells(spec)
    ltrb = (weights @ np.arange(bins.shape[2])) / weights.sum(2) * stride[rows]
    center = (cell[rows] + spec.cell_center) * stride[rows]
    xyxy = np.concatenate([center - ltrb[:, :2], center + ltrb[:, 2:]], 1)
    chosen = scores[rows].astype(np.float64)
    return _best_class(xyxy, probability(chosen) if spec.is_logit else chosen)


def _ultralytics(heads: Outputs, spec: DetectorSpec, threshold: float) -> _Candidates:
    """Ultralytics' exports, in canvas pixels, scores as probabilities.

    ``v8`` (also v9, v11): (4 + C, N) cx cy w h and class scores. ``v5`` (also v7): (N, 5 + C) cx cy w h, objectness, class
    scores. ``end2end`` (v10, or exported with suppression inside): (N, 6) x0 y0 x1 y1, score, class.
    """
    head = heads[0]
    if spec.layout == "end2end":
        rows = np.nonzero(head[:, 4] > threshold)[0]
        fields = head[rows].astype(np.float64)
        return _Candidates(fields[:, :4], fields[:, 4], _class_ids(fields[:, 5], spec))
    if spec.layout == "v5":
        fields = head[np.nonzero(head[:, 4] > threshold)[0]].astype(np.float64)
        return _scored(fields[:, :2], fields[:, 2:4], fields[:, 4:])
    fields = head[:, _rows_above(head[4:].T, spec, threshold)].T.astype(np.float64)
    return _best_class(_box(fields[:, :2], fields[:, 2:4]), fields[:, 4:])


def _rtdetr(heads: Outputs, spec: DetectorSpec, threshold: float) -> _Candidates:
    """RT-DETR, scores as probabilities; boxes are cx cy w h as parts of the canvas, or x0 y0 x1 y1 in its pixels.

    ``unit``: one (N, 4 + C), boxes and class scores (Ultralytics), or labels (N,), boxes (N, 4), scores (N,). ``pixels``:
    labels, boxes, scores, the boxes as the authors' export gives them for a picture of the canvas' size.
    """
    assert spec.fit.size is not None, "the spec's check"
    if len(heads) == 1:
        fields = heads[0][_rows_above(heads[0][:, 4:], spec, threshold)].astype(np.float64)
        return _best_class(_box(fields[:, :2] * spec.fit.size, fields[:, 2:4] * spec.fit.size), fields[:, 4:])
    labels, boxes, scores = heads
    rows = np.nonzero(scores > threshold)[0]
    xyxy: Array = boxes[rows].astype(np.float64)
    if spec.layout == "unit":
        xyxy = _box(xyxy[:, :2] * spec.fit.size, xyxy[:, 2:] * spec.fit.size)
    return _Candidates(xyxy, scores[rows].astype(np.float64), _class_ids(labels[rows], spec))


_DECODERS = {
    "quadlift": _quadlift,
    "yolov3": _yolov3,
    "yolox": _yolox,
    "nanodet": _nanodet,
    "ultralytics": _ultralytics,
    "rtdetr": _rtdetr,
}


@dataclass(frozen=True, eq=False)
class _AnchoredCells:
    """Candidates of all strides of a format with anchors."""

    logits: Array
    """(n, 5 + C)"""
    cell: Array
    """(n, 2) column and row."""
    anchor: Array
    """(n, 2) width and height, px."""
    stride: Array
    """(n, 1) px."""


def _anchored_cells(heads: Outputs, spec: DetectorSpec, threshold: float) -> _AnchoredCells:
    """Cells whose objectness passes; a score is at most its objectness."""
    logits, cells, sizes = [], [], []
    least = log_odds(threshold, _LEAST_PROBABILITY)
    for head, anchors in zip(heads, spec.anchors_px, strict=True):
        grid = head.reshape(len(anchors), BOX_FIELDS + spec.network_classes, *head.shape[-2:])
        passes = grid[:, 4] > least
        # Three times as quick as `nonzero` of three axes.
        anchor, row, column = np.unravel_index(np.flatnonzero(passes), passes.shape)
        logits.append(grid[anchor, :, row, column])
        cells.append(np.stack([column, row], 1))
        sizes.append(np.asarray(anchors, dtype=np.float64)[anchor])
    strides = np.repeat(np.array(spec.strides, dtype=np.float64), [len(own) for own in cells])
    return _AnchoredCells(
        np.concatenate(logits).astype(np.float64),
        np.concatenate(cells).astype(np.float64),
        np.concatenate(sizes),
        strides[:, None],
    )


def _flat_cells(spec: DetectorSpec) -> tuple[Array, Array]:
    """Column and row (N, 2) and stride (N, 1) of the cells of all strides of a canvas of fixed size."""
    assert spec.fit.size is not None, "the spec's check"
    width, height = spec.fit.size
    cells, strides = [], []
    for stride in spec.strides:
        column, row = np.meshgrid(np.arange(-(-width // stride)), np.arange(-(-height // stride)))
        cells.append(np.stack([column.ravel(), row.ravel()], -1).astype(np.float64))
        strides.append(np.full((column.size, 1), float(stride)))
    return np.concatenate(cells), np.concatenate(strides)


def _rows_above(scores: NDArray[np.float32], spec: DetectorSpec, threshold: float) -> NDArray[np.int64]:
    """Rows of class scores (N, C) in which a class that is not dropped passes."""
    if spec.class_of is not None:
        scores = scores[:, [index for index, ours in enumerate(spec.class_of) if ours >= 0]]
    return np.nonzero(scores.max(1, initial=-np.inf) > threshold)[0]


def _scored(center: Array, size: Array, probability: Array) -> _Candidates:
    """Candidates from objectness and class scores (n, 1 + C)."""
    return _best_class(_box(center, size), probability[:, :1] * probability[:, 1:])


def _best_class(xyxy: Array, scores: Array) -> _Candidates:
    """Candidates of their best class, from scores (n, C)."""
    cls = scores.argmax(1)
    return _Candidates(xyxy, scores[np.arange(len(cls)), cls], cls)


def _class_ids(values: NDArray[np.generic], spec: DetectorSpec) -> NDArray[np.int64]:
    """Class ids (n,) that a network wrote as numbers; those that it cannot have become the one after its last."""
    ids = values.astype(np.float64)
    possible = (ids >= 0) & (ids < spec.network_classes)
    return np.where(possible, ids, spec.network_classes).astype(np.int64)


def _box(center: Array, size: Array) -> Array:
    return np.concatenate([center - 0.5 * size, center + 0.5 * size], 1)
