"""2D boxes of one image, and what makes one box of many on the same vehicle."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

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


def suppress(detections: Detections, nms_iou: float) -> Detections:
    """Greedy non-maximum suppression over all classes together: one place holds one vehicle."""
    if len(detections) == 0:
        return detections
    xywh = detections.xyxy_px.copy()
    xywh[:, 2:] -= xywh[:, :2]
    keep = np.asarray(cv2.dnn.NMSBoxes(xywh.tolist(), detections.score.tolist(), 0.0, nms_iou), dtype=np.int64).reshape(-1)
    return Detections(detections.xyxy_px[keep], detections.score[keep], detections.cls[keep])
