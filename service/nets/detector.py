"""The 2D detector of a pack, of any output format: images in, 2D boxes out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from service.geometry.transforms import Array
from service.nets.canvas import CanvasBatch, InputFit
from service.nets.decoding import decode_heads
from service.nets.detections import Detections, suppress
from service.nets.detector_spec import DetectorSpec
from service.nets.pack import Network

SCORE_THRESHOLD = 0.3
"""Boxes of a lower score are dropped."""
NMS_IOU = 0.5
"""Boxes that overlap a better one by more are dropped."""


class Detector:
    """The detector of a pack."""

    def __init__(self, network: Network) -> None:
        self.spec = DetectorSpec.from_metadata(network.metadata)
        self.network = network

    @property
    def fit(self) -> InputFit:
        """What the network takes in."""
        return self.spec.fit

    def detect(
        self, images: Sequence[NDArray[np.uint8]], *, score_threshold: float = SCORE_THRESHOLD, nms_iou: float = NMS_IOU
    ) -> list[Detections]:
        """2D boxes in images (H, W, 3) RGB uint8, which may differ in size; one result an image."""
        return self.detect_on(self.fit.batches(images), score_threshold=score_threshold, nms_iou=nms_iou)

    def detect_on(
        self, batches: Sequence[CanvasBatch], *, score_threshold: float = SCORE_THRESHOLD, nms_iou: float = NMS_IOU
    ) -> list[Detections]:
        """:meth:`detect` on canvases that were made with ``fit``; one result an image, in the images' order."""
        results: dict[int, Detections] = {}
        for batch in batches:
            outputs = self.network.run(batch.pixels)
            for row, (member, placement) in enumerate(zip(batch.members, batch.placements, strict=True)):
                raw = decode_heads([output[row] for output in outputs], self.spec, score_threshold)
                kept = suppress(raw, nms_iou)
                results[member] = Detections(placement.to_image(kept.xyxy_px), kept.score, kept.cls)
        return [results[member] for member in sorted(results)]


def box_size(xyxy_px: ArrayLike) -> Array:
    """Sizes (N,) of boxes (N, 4): sqrt(width * height), px, at least 1."""
    xyxy = np.asarray(xyxy_px, dtype=np.float64)
    size: Array = np.sqrt(np.maximum(np.prod(xyxy[:, 2:] - xyxy[:, :2], axis=1), 1.0))
    return size


def edge_sigma(spec: DetectorSpec, xyxy_px: ArrayLike, score: ArrayLike, is_cut: ArrayLike) -> Array:
    """Standard deviations (N, 4) of the edges of boxes (N, 4) with scores (N,), cut by the border or not (N,), px."""
    return np.repeat(spec.sigma_edge_px.sigma(score, is_cut, box_size(xyxy_px))[:, None], 4, axis=1)
