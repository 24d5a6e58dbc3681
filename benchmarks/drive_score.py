"""How a 2D detector does on the frames of a drive: vehicles found at IoU 0.5 and false boxes, by score threshold."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from benchmarks.drive_truth import DriveFrame
from service.frames import decode
from service.geometry.iou import iou_2d
from service.geometry.transforms import Array
from service.nets.detections import Detections

MIN_IOU = 0.5
"""A box that overlaps a vehicle by more finds it."""
MIN_ON_IGNORED = 0.5
"""A box of which a larger part lies on one ignored extent does not count."""


class Finds(Protocol):
    """What is scored: the service's detector, or one that computes the same elsewhere."""

    def detect(self, images: Sequence[NDArray[np.uint8]], *, score_threshold: float) -> list[Detections]:
        """2D boxes in images (H, W, 3) RGB, one result an image."""


@dataclass(frozen=True)
class DriveScore:
    """Counts over frames at one score threshold."""

    score_threshold: float
    frames: int = 0
    vehicles: int = 0
    found: int = 0
    clear: int = 0
    """Vehicles that no other cuboid mostly hides."""
    clear_found: int = 0
    false: int = 0

    def summary(self) -> dict[str, float | int]:
        """Counts, recalls in percent, false boxes a frame."""
        return {
            "score_threshold": self.score_threshold,
            "frames": self.frames,
            "vehicles": self.vehicles,
            "found": self.found,
            "recall_percent": round(100 * self.found / max(self.vehicles, 1), 2),
            "clear_vehicles": self.clear,
            "clear_found": self.clear_found,
            "clear_recall_percent": round(100 * self.clear_found / max(self.clear, 1), 2),
            "false": self.false,
            "false_per_frame": round(self.false / max(self.frames, 1), 3),
        }


def score_drive(detector: Finds, max_width: int, frames: Iterable[DriveFrame], thresholds: Sequence[float]) -> list[DriveScore]:
    """Scores by threshold, in the order given. The detector sees images at most ``max_width`` px wide."""
    scores = [DriveScore(threshold) for threshold in thresholds]
    for frame in frames:
        found = detect_in(detector, max_width, frame, min(thresholds))
        scores = [_with_frame(score, frame, found) for score in scores]
    return scores


def detect_in(detector: Finds, max_width: int, frame: DriveFrame, score_threshold: float) -> Detections:
    """Boxes of a frame, best first, in the recording's own pixels."""
    image = decode(frame.jpeg, frame.camera, max_width)
    found = detector.detect([image], score_threshold=score_threshold)[0]
    scale = np.array([frame.camera.width / image.shape[1], frame.camera.height / image.shape[0]] * 2)
    order = np.argsort(-found.score, kind="stable")
    return Detections(((found.xyxy_px + 0.5) * scale - 0.5)[order], found.score[order], found.cls[order])


def _with_frame(score: DriveScore, frame: DriveFrame, found: Detections) -> DriveScore:
    kept = found.xyxy_px[found.score > score.score_threshold]
    taken, false = match(kept, frame.xyxy_px, frame.ignored_xyxy_px)
    return replace(
        score,
        frames=score.frames + 1,
        vehicles=score.vehicles + len(taken),
        found=score.found + int(taken.sum()),
        clear=score.clear + int(frame.clear.sum()),
        clear_found=score.clear_found + int((taken & frame.clear).sum()),
        false=score.false + false,
    )


def match(ours: Array, truth: Array, ignored: Array) -> tuple[NDArray[np.bool_], int]:
    """Which vehicles (N, 4) are found (N,) by boxes (K, 4), best first, each by one; and how many boxes are false.

    A box takes the free vehicle that it overlaps most. What takes none is false, unless it lies on an ignored extent (M, 4).
    """
    taken, outcome = outcomes(ours, truth, ignored)
    return taken, int((outcome == 0).sum())


def outcomes(
    ours: Array, truth: Array, ignored: Array, min_iou: float = MIN_IOU
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """As :func:`match`: which vehicles (N,) are found, and what became of each box (K,): 1 right, 0 false, -1 left out."""
    overlap = iou_2d(ours, truth)
    taken = np.zeros(len(truth), dtype=bool)
    outcome = np.zeros(len(ours), dtype=np.int64)
    for row, excused in enumerate(_part_on(ours, ignored) > MIN_ON_IGNORED):
        free = np.where(taken, 0.0, overlap[row])
        best = int(free.argmax()) if len(free) else -1
        if best >= 0 and free[best] > min_iou:
            taken[best] = True
            outcome[row] = 1
        elif excused:
            outcome[row] = -1
    return taken, outcome


def _part_on(ours: Array, ignored: Array) -> Array:
    """The largest part (K,) of each box (K, 4) that lies on one extent (M, 4)."""
    low, high = np.maximum(ours[:, None, :2], ignored[None, :, :2]), np.minimum(ours[:, None, 2:], ignored[None, :, 2:])
    shared = np.prod(np.maximum(high - low, 0.0), axis=-1)
    area = np.maximum(np.prod(ours[:, 2:] - ours[:, :2], axis=1), 1e-9)
    part: Array = shared.max(1, initial=0.0) / area
    return part
