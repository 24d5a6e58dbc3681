"""Training pictures of the detector: samples, augmented, on canvases of one size, with the rows of their targets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from models_export.data.augment import AugmentConfig, Image, cut_out, flip_horizontally, photometric, place, rescale, shrink
from models_export.data.detection import MIN_SIDE_PX, DetectionSample
from service.geometry.transforms import Array
from service.nets.canvas import PAD_VALUE

UNKNOWN_CLASS = -1
"""Class of a target whose class is not known."""
MIN_KEPT = 0.3
"""Vehicles of which less lies on the canvas are neither positives nor negatives."""
MAX_CANVAS_HEIGHT = 384
"""Canvases are at most this high, px; higher pictures are cut. Two simulated frames fit one above the other."""


def canvas_of(samples: Sequence[DetectionSample]) -> tuple[int, int]:
    """Width and height of the canvases on which samples of several sizes are trained together."""
    width, height = (max(sample.canvas.shape[axis] for sample in samples) for axis in (1, 0))
    return width, min(height, MAX_CANVAS_HEIGHT)


def strips_on(canvas: tuple[int, int], sample: DetectionSample) -> int:
    """How many pictures of a sample's height a canvas takes, one above the other; at least one."""
    return max(canvas[1] // sample.canvas.shape[0], 1)


def tiled(
    samples: Sequence[DetectionSample],
    canvas: tuple[int, int],
    rng: np.random.Generator,
    augment: AugmentConfig,
    columns: int = 1,
) -> tuple[Image, Array]:
    """Samples side by side, row by row, on one canvas, and target rows (T, 6): class or -1, x0, y0, x1, y1 (px), ignore.

    In one column samples are strips. In more, which divide their number, each is made smaller: small vehicles, and many of
    them, after the mosaic of YOLOv4 (Bochkovskiy et al., 2020), of which the cells keep their size. What they leave is grey.
    """
    width, height = canvas[0] // columns, canvas[1] * columns // len(samples)
    image, rows = np.full((canvas[1], canvas[0], 3), PAD_VALUE, np.uint8), []
    for number, sample in enumerate(samples):
        cell, targets = augmented(sample, (width, height), rng, augment, smaller=columns > 1)
        y, x = height * (number // columns), width * (number % columns)
        image[y : y + height, x : x + width] = cell
        rows.append(targets + np.array([0, x, y, x, y, 0]))
    return image, np.concatenate(rows)


def augmented(
    sample: DetectionSample,
    size: tuple[int, int],
    rng: np.random.Generator,
    augment: AugmentConfig,
    *,
    smaller: bool = False,
) -> tuple[Image, Array]:
    """One sample on a canvas of ``size`` (width, height), and its target rows (T, 6). smaller: always reduced."""
    image, xyxy = sample.canvas, sample.xyxy_px
    if rng.random() < augment.flip:
        image, xyxy = flip_horizontally(image, xyxy, sample.image_size[0])
    if smaller:
        image, xyxy = shrink(image, xyxy, size, rng, augment)
    elif rng.random() < augment.geometric:
        image, xyxy = rescale(image, xyxy, size, rng, augment)
    else:
        image, xyxy = place(image, xyxy, size, rng)
    clipped = np.clip(xyxy, 0, np.array([size[0] - 1, size[1] - 1] * 2))
    sides, full = clipped[:, 2:] - clipped[:, :2], np.maximum(xyxy[:, 2:] - xyxy[:, :2], 1e-6)
    kept = np.prod(sides, axis=1) / np.prod(full, axis=1)
    ignore = sample.ignore | (sides.min(1, initial=np.inf) < MIN_SIDE_PX) | (kept < MIN_KEPT)
    present = sides.min(1, initial=np.inf) > 1
    if rng.random() < augment.cut_out:
        image, covered = cut_out(image, clipped, rng, augment)
        ignore = ignore | (covered > augment.max_covered)
    cls = np.where(sample.class_known, sample.cls, UNKNOWN_CLASS)
    rows = np.concatenate([cls[:, None], clipped, ignore[:, None]], 1)
    return photometric(image, rng, augment), rows[present]
