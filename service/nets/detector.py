"""The one-stage 2D detector: canvases in, 2D boxes out. The decoding is YOLO's, from anchors in the ONNX metadata."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from service.errors import PackError
from service.geometry.transforms import Array
from service.nets.canvas import batches
from service.nets.error_model import ErrorModel
from service.nets.pack import Network

MAX_CANDIDATES = 300
"""Boxes of one image that enter non-maximum suppression, best first."""
BOX_FIELDS = 5
"""Channels of an anchor before its class logits: x, y, w, h, objectness."""


@dataclass(frozen=True, eq=False)
class DetectorSpec:
    """What the ONNX metadata says of a detector."""

    classes: tuple[str, ...]
    strides: tuple[int, ...]
    anchors_px: tuple[tuple[tuple[float, float], ...], ...]
    """Per stride, (width, height) of each anchor in px."""
    max_width: int
    """Images are decoded to at most this width, px."""
    sigma_edge_px: ErrorModel
    """Of each edge of a box, px."""

    @staticmethod
    def from_metadata(metadata: dict[str, object]) -> DetectorSpec:
        """Read the metadata of an ONNX file. Raises PackError naming what is missing."""
        try:
            return DetectorSpec(
                classes=tuple(metadata["classes"]),  # type: ignore[arg-type]
                strides=tuple(metadata["strides"]),  # type: ignore[arg-type]
                anchors_px=tuple(tuple((float(w), float(h)) for w, h in scale) for scale in metadata["anchors_px"]),  # type: ignore[attr-defined]
                max_width=int(metadata["max_width"]),  # type: ignore[call-overload]
                sigma_edge_px=ErrorModel.from_metadata(metadata["sigma_edge_px"]),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise PackError(f"metadata is incomplete: {error!r}.", field="detector", remedy="Export the pack again.") from error


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
        xyxy = (self.xyxy_px + 0.5) * np.tile(np.asarray(factor, dtype=np.float64), 2) - 0.5
        return Detections(xyxy, self.score, self.cls)


class Detector:
    """The detector of a pack."""

    def __init__(self, network: Network) -> None:
        self.spec = DetectorSpec.from_metadata(network.metadata)
        self.network = network

    def detect(
        self, images: Sequence[NDArray[np.uint8]], *, score_threshold: float = 0.3, nms_iou: float = 0.55
    ) -> list[Detections]:
        """2D boxes in images (H, W, 3) RGB uint8, which may differ in size; one result an image."""
        results: list[Detections | None] = [None] * len(images)
        for members, canvases in batches(images):
            heads = self.network.run(canvases)
            for row, member in enumerate(members):
                raw = decode_heads([head[row] for head in heads], self.spec, score_threshold)
                results[member] = suppress(raw, nms_iou)
        return [result for result in results if result is not None]


def decode_heads(heads: Sequence[NDArray[np.float32]], spec: DetectorSpec, score_threshold: float) -> Detections:
    """Boxes of one image above a score, before suppression.

    heads: one array (A * (5 + C), h, w) of logits a stride. Per anchor: centre = (2 sigmoid(t) - 0.5 + cell) * stride,
    size = (2 sigmoid(t))^2 * anchor, score = sigmoid(objectness) * sigmoid(class): YOLOv3's decoding, with its
    exponential replaced by a bounded square so that no logit overflows, and centres free to reach into the next cell.
    """
    boxes, scores, classes = [], [], []
    # A score is at most its objectness: compare logits first, decode few.
    logit_threshold = np.log(score_threshold / (1 - score_threshold))
    for head, stride, anchors in zip(heads, spec.strides, spec.anchors_px, strict=True):
        fields = BOX_FIELDS + len(spec.classes)
        grid = head.reshape(len(anchors), fields, *head.shape[-2:])
        anchor, row, column = np.nonzero(grid[:, 4] > logit_threshold)
        logits = grid[anchor, :, row, column].astype(np.float64)
        probability = 1.0 / (1.0 + np.exp(-logits))
        cell = np.stack([column, row], -1)
        # Pixel centres lie at integers, so the centre of cell 0 is at (stride - 1) / 2.
        center = (2.0 * probability[:, :2] - 0.5 + cell) * stride - 0.5
        half = 0.5 * (2.0 * probability[:, 2:4]) ** 2 * np.asarray(anchors, dtype=np.float64)[anchor]
        cls = probability[:, BOX_FIELDS:].argmax(1)
        boxes.append(np.concatenate([center - half, center + half], 1))
        scores.append(probability[:, 4] * probability[np.arange(len(cls)), BOX_FIELDS + cls])
        classes.append(cls)
    xyxy, score, cls = np.concatenate(boxes), np.concatenate(scores), np.concatenate(classes)
    keep = np.nonzero(score > score_threshold)[0]
    keep = keep[np.argsort(-score[keep], kind="stable")][:MAX_CANDIDATES]
    return Detections(xyxy[keep], score[keep], cls[keep])


def suppress(detections: Detections, nms_iou: float) -> Detections:
    """Greedy non-maximum suppression over all classes together: one place holds one vehicle."""
    if len(detections) == 0:
        return detections
    xywh = detections.xyxy_px.copy()
    xywh[:, 2:] -= xywh[:, :2]
    keep = np.asarray(cv2.dnn.NMSBoxes(xywh.tolist(), detections.score.tolist(), 0.0, nms_iou), dtype=np.int64).reshape(-1)
    return Detections(detections.xyxy_px[keep], detections.score[keep], detections.cls[keep])


def box_size(xyxy_px: ArrayLike) -> Array:
    """Sizes (N,) of boxes (N, 4): sqrt(width * height), px, at least 1."""
    xyxy = np.asarray(xyxy_px, dtype=np.float64)
    size: Array = np.sqrt(np.maximum(np.prod(xyxy[:, 2:] - xyxy[:, :2], axis=1), 1.0))
    return size


def edge_sigma(spec: DetectorSpec, xyxy_px: ArrayLike, score: ArrayLike, is_cut: ArrayLike) -> Array:
    """Standard deviations (N, 4) of the edges of boxes (N, 4) with scores (N,), cut by the border or not (N,), px."""
    return np.repeat(spec.sigma_edge_px.sigma(score, is_cut, box_size(xyxy_px))[:, None], 4, axis=1)
