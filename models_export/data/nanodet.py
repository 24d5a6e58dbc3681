"""NanoDet-g in ONNX, a public detector of COCO's 80 classes (weights: Apache-2.0): its vehicles, for teaching and comparing.

The graph holds no normalisation, so it is done here; canvas and decoding are the service's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.errors import NotFoundError
from service.nets.canvas import InputFit
from service.nets.decoding import decode_heads
from service.nets.detections import Detections, suppress
from service.nets.detector import NMS_IOU, SCORE_THRESHOLD
from service.nets.detector_spec import DROPPED, DetectorSpec
from service.nets.error_model import ErrorModel
from service.nets.pack import session_options
from service.nets.quiet_onnxruntime import ort

WEIGHTS = "teacher_nanodet_g_416.onnx"
SIDE_PX = 416
STRIDES = (8, 16, 32)
CREDIT = "NanoDet-g, COCO, Apache-2.0"
COCO_CLASSES, COCO_VEHICLES = 80, (2, 5, 7)
"""Cars, buses and trucks."""
MEAN_BGR = np.array([103.53, 116.28, 123.675], np.float32)
STD_BGR = np.array([57.375, 57.12, 58.395], np.float32)
"""Of the pixels, grey levels: it sees (x - mean) / deviation."""
SPEC = DetectorSpec(
    classes=("vehicle",),
    strides=STRIDES,
    anchors_px=(),
    max_width=1280,
    sigma_edge_px=ErrorModel(1.0, 0.02, 0.0, 1.0),
    format="nanodet",
    class_of=tuple(0 if coco in COCO_VEHICLES else DROPPED for coco in range(COCO_CLASSES)),
    fit=InputFit((SIDE_PX, SIDE_PX), "corner", 0),
)


@dataclass(frozen=True, eq=False)
class NanoDet:
    """An open session."""

    session: ort.InferenceSession

    @property
    def max_width(self) -> int:
        """Images are decoded to at most this width, px."""
        return SPEC.max_width

    def detect(
        self, images: Sequence[NDArray[np.uint8]], *, score_threshold: float = SCORE_THRESHOLD, nms_iou: float = NMS_IOU
    ) -> list[Detections]:
        """Vehicles of any kind in images (H, W, 3) RGB uint8; one result an image, all of class 0."""
        results = []
        for image in images:
            (batch,) = SPEC.fit.batches([image])
            pixels = ((batch.pixels[..., ::-1] - MEAN_BGR) / STD_BGR).transpose(0, 3, 1, 2)
            outputs = self.session.run(None, {self.session.get_inputs()[0].name: np.ascontiguousarray(pixels)})
            found = suppress(decode_heads(in_order(outputs), SPEC, score_threshold), nms_iou)
            results.append(Detections(batch.placements[0].to_image(found.xyxy_px), found.score, found.cls))
        return results


def open_nanodet(path: Path) -> NanoDet:
    """A session on one thread. Raises NotFoundError when the file is not there."""
    if not path.is_file():
        raise NotFoundError("no such weights.", field=str(path), remedy="Give the folder that holds the teacher's ONNX file.")
    return NanoDet(ort.InferenceSession(str(path), session_options(1), providers=["CPUExecutionProvider"]))


def in_order(outputs: Sequence[NDArray[np.float32]]) -> list[NDArray[np.float32]]:
    """Outputs (1, cells, fields) of this file, whose order is arbitrary, as the decoding wants them: scores, then distances,
    each from the finest stride to the coarsest, without the batch's axis."""
    found = [output[0] for output in outputs]
    return sorted(found, key=lambda output: (output.shape[1] != COCO_CLASSES, -len(output)))
