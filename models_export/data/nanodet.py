"""NanoDet-g in ONNX, a public detector of COCO's 80 classes: its vehicles, for teaching and for comparison.

Li et al., "Generalized Focal Loss" (2020), is where its boxes as distributions over bins come from. Weights: Apache-2.0.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from service.errors import NotFoundError
from service.geometry.transforms import Array
from service.nets.detector import Detections, suppress

WEIGHTS = "teacher_nanodet_g_416.onnx"
SIDE_PX = 416
STRIDES = (8, 16, 32)
BINS = 11
VEHICLE_COLUMNS = (2, 5, 7)
"""COCO's car, bus and truck."""
_MEAN_BGR = np.array([103.53, 116.28, 123.675], np.float32)
_STD_BGR = np.array([57.375, 57.12, 58.395], np.float32)


@dataclass(frozen=True, eq=False)
class NanoDet:
    """An open session."""

    session: ort.InferenceSession

    def detect(self, image: NDArray[np.uint8], *, score_threshold: float = 0.3, nms_iou: float = 0.55) -> Detections:
        """Vehicles of any kind in an image (H, W, 3) RGB uint8, scaled to fit the net; boxes in the image's pixels, class 0."""
        scale = SIDE_PX / max(image.shape[:2])
        size = round(image.shape[1] * scale), round(image.shape[0] * scale)
        pixels = np.zeros((SIDE_PX, SIDE_PX, 3), np.float32)
        resized = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        pixels[: size[1], : size[0]] = (resized[..., ::-1] - _MEAN_BGR) / _STD_BGR
        (name,) = (entry.name for entry in self.session.get_inputs())
        outputs = self.session.run(None, {name: pixels.transpose(2, 0, 1)[None]})
        found = decode_outputs([output[0] for output in outputs], score_threshold)
        # Pixel centres lie at integers here, pixel edges in the net's own boxes.
        xyxy = np.clip(found.xyxy_px / scale - 0.5, 0, [image.shape[1] - 1, image.shape[0] - 1] * 2)
        return suppress(Detections(xyxy, found.score, found.cls), nms_iou)


def open_nanodet(path: Path) -> NanoDet:
    """A session on one thread. Raises NotFoundError when the file is not there."""
    if not path.is_file():
        raise NotFoundError("no such weights.", field=str(path), remedy="Give the folder that holds the teacher's ONNX file.")
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    return NanoDet(ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"]))


def decode_outputs(outputs: list[NDArray[np.float32]], score_threshold: float) -> Detections:
    """Vehicles above a score, best first, not suppressed; boxes in the net's input, edges of pixels at integers.

    outputs: for each stride, in any order, class scores (cells, 80) in 0..1 and distances (cells, 4 * BINS) of logits: left,
    top, right, bottom from the cell's centre, each the expectation over its bins, in strides.
    """
    boxes, scores = [np.zeros((0, 4))], [np.zeros(0)]
    for stride in STRIDES:
        cells = -(-SIDE_PX // stride)
        of_stride = {output.shape[1]: output for output in outputs if len(output) == cells * cells}
        score = of_stride[80][:, VEHICLE_COLUMNS].max(1).astype(np.float64)
        keep = np.flatnonzero(score > score_threshold)
        distance = _expectation(of_stride[4 * BINS][keep].reshape(-1, 4, BINS).astype(np.float64)) * stride
        center = (np.stack([keep % cells, keep // cells], 1) + 0.5) * stride
        boxes.append(np.concatenate([center - distance[:, :2], center + distance[:, 2:]], 1))
        scores.append(score[keep])
    xyxy, score = np.concatenate(boxes), np.concatenate(scores)
    order = np.argsort(-score, kind="stable")
    return Detections(xyxy[order], score[order], np.zeros(len(order), np.int64))


def _expectation(logits: Array) -> Array:
    weights = np.exp(logits - logits.max(-1, keepdims=True))
    expectation: Array = (weights * np.arange(BINS)).sum(-1) / weights.sum(-1)
    return expectation
