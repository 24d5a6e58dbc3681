"""Training of YOLOv3 and YOLOv3-tiny on pictures with 2D boxes."""

from __future__ import annotations

from collections.abc import Iterable

from torch import Tensor, nn

from models_export.anchors import iou_clusters
from models_export.data.augment import AugmentConfig
from models_export.data.detection import DetectionSample
from models_export.data.mix import MixConfig
from models_export.nets.yolov3 import Yolov3, Yolov3Config
from models_export.train.boxes import BoxTask
from models_export.train.task import Batch
from models_export.yolo_loss import yolo_loss


class Yolov3Task(BoxTask):
    """YOLOv3 with its training samples; its anchors are theirs."""

    def __init__(
        self,
        samples: Iterable[DetectionSample],
        config: Yolov3Config,
        augment: AugmentConfig | None = None,
        mix: MixConfig | None = None,
    ) -> None:
        super().__init__(samples, config, Yolov3, iou_clusters, augment, mix)

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Darknet's loss: box, objectness and class terms and their sum."""
        return yolo_loss([head.float() for head in net(batch["images"])], batch["targets"], self.config)
