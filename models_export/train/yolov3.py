"""Training of YOLOv3 and YOLOv3-tiny on frames with 2D boxes, from a Darknet backbone where the user has one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from torch import Tensor, nn

from models_export.anchors import anchors_of, iou_clusters
from models_export.darknet_weights import read_backbone
from models_export.data.augment import AugmentConfig
from models_export.data.samples import Sample
from models_export.nets.yolov3 import Yolov3, Yolov3Config
from models_export.train.boxes import BoxTask
from models_export.train.task import Batch
from models_export.yolo_loss import yolo_loss


class Yolov3Task(BoxTask):
    """YOLOv3 with its training samples; its anchors are theirs."""

    def __init__(
        self, samples: list[Sample], config: Yolov3Config, augment: AugmentConfig | None = None, start: Path | None = None
    ) -> None:
        config = replace(config, anchors_px=anchors_of(samples, config.strides, iou_clusters))
        net = Yolov3(config)
        if start is not None:
            read_backbone(net, start)
        super().__init__(samples, config, net, augment)

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Darknet's loss: box, objectness and class terms and their sum."""
        return yolo_loss([head.float() for head in net(batch["images"])], batch["targets"], self.config)
