"""2D boxes of one image, and what makes one box of many on the same vehicle."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from service.geometry.boxes import scaled_extents
from service.geometry.transforms import Array


@dataclass(frozen=True, eq=False)
class Detections:
    """2D boxes of one image, best first."""

    xyxy_px: Array
    """(N, 4) in the pixels of the image given to the detector, not clipped."""
    score: Array
    """(N,) in 0..1."""
    cls: NDArray[np.int64]
    """(N,) indices into the classes."""

    def __len__(self) -> int:
        return len(self.score)

    def scaled(self, factor: ArrayLike) -> Detections:
        """The same in the pixels of an image ``factor`` (2,) times as wide and high (pixel centres at integers)."""
        return Detections(scaled_extents(self.xyxy_px, factor), self.score, self.cls)


def unsuppressed(xyxy_px: Array, score: Array, nms_iou: float) -> NDArray[np.int64]:
    """Rows of 2D boxes (N, 4) with scores (N,) that greedy non-maximum suppression keeps, best first."""
    if len(score) == 0:
        return np.zeros(0, np.int64)
    xywh = xyxy_px.copy()
    xywh[:, 2:] -= xywh[:, :2]
    return np.asarray(cv2.dnn.NMSBoxes(xywh.tolist(), score.tolist(), 0.0, nms_iou), dtype=np.int64).reshape(-1)


def suppress(detections: Detections, nms_iou: float) -> Detections:
    """Greedy non-maximum suppression over all classes together: one place holds one vehicle."""
    keep = unsuppressed(detections.xyxy_px, detections.score, nms_iou)
    return Detections(detections.xyxy_px[keep], detections.score[keep], detections.cls[keep])
