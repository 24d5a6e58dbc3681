"""Anchors of a data set: k-means over the sides of its boxes, in the distance that the decoding cares for."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.cluster.vq import kmeans2

from models_export.data.detection import DetectionSample
from service.geometry.transforms import Array

_MAX_ROUNDS = 100

Clusters = Callable[[Array, int], Array]
"""Centres (K, 2) of box sides (N, 2), px."""


def anchors_of(
    samples: Sequence[DetectionSample], strides: tuple[int, ...], clusters: Clusters, per_scale: int = 3
) -> tuple[tuple[tuple[float, float], ...], ...]:
    """Anchors (width, height), px, of the vehicles that count: smallest for the finest stride."""
    sides = np.concatenate([s.xyxy_px[~s.ignore][:, 2:] - s.xyxy_px[~s.ignore][:, :2] for s in samples])
    centers = clusters(sides, per_scale * len(strides))
    ordered = centers[np.argsort(np.log(centers).sum(1))]
    rows = [tuple((round(float(w), 1), round(float(h), 1)) for w, h in group) for group in np.split(ordered, len(strides))]
    return tuple(rows)


def log_clusters(sides: Array, count: int) -> Array:
    """By the logarithms of the sides: for a decoding that scales an anchor by a factor of limited size."""
    centers, _ = kmeans2(np.log(sides), count, minit="++", seed=0, iter=50)
    return np.asarray(np.exp(centers), dtype=np.float64)


def iou_clusters(sides: Array, count: int) -> Array:
    """By 1 - IoU of boxes on one centre, as YOLO has it since its second version: large boxes count no more than small ones.

    A cluster's centre is the median of its boxes: the mean follows the largest ones, and overlaps the others less.
    """
    centers = log_clusters(sides, count)
    nearest = np.full(len(sides), -1)
    for _ in range(_MAX_ROUNDS):
        before, nearest = nearest, shape_iou(sides, centers).argmax(1)
        if np.array_equal(before, nearest):
            break
        for number in np.unique(nearest):
            centers[number] = np.median(sides[nearest == number], axis=0)
    return centers


def shape_iou(sides: Array, anchors: Array) -> Array:
    """IoU (N, K) of boxes of sides (N, 2) and anchors (K, 2) laid on one centre."""
    shared = np.minimum(sides[:, None], anchors[None]).prod(-1)
    overlap: Array = shared / (sides.prod(-1)[:, None] + anchors.prod(-1)[None] - shared)
    return overlap
