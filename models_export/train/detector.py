"""Training of the edge detector: target assignment and loss."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models_export.anchors import log_clusters
from models_export.data.augment import AugmentConfig
from models_export.data.detection import DetectionSample
from models_export.data.mix import MixConfig
from models_export.losses import ciou
from models_export.nets.detector import DetectorConfig, EdgeDetector
from models_export.train.boxes import BoxTask
from models_export.train.detector_pictures import UNKNOWN_CLASS
from models_export.train.task import Batch
from models_export.yolo_loss import covered_cells
from service.nets.decoding import BOX_FIELDS

MAX_RATIO = 4.0
"""An anchor answers for a box whose sides differ from its own by less than this factor: what (2 sigmoid)^2 can reach."""
SCALE_BALANCE = (4.0, 1.0, 0.4)
"""Weights of the objectness of the strides: fine grids hold more cells, and smaller vehicles."""
BOX_WEIGHT, OBJECT_WEIGHT, CLASS_WEIGHT = 0.1, 1.0, 0.2


class DetectorTask(BoxTask):
    """The edge detector with its training samples."""

    def __init__(
        self,
        samples: Iterable[DetectionSample],
        config: DetectorConfig,
        augment: AugmentConfig | None = None,
        mix: MixConfig | None = None,
    ) -> None:
        super().__init__(samples, config, EdgeDetector, log_clusters, augment, mix)

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Box, objectness and class losses and their weighted sum."""
        return detector_loss([head.float() for head in net(batch["images"])], batch["targets"], self.config)


def detector_loss(heads: list[Tensor], targets: Tensor, config: DetectorConfig) -> dict[str, Tensor]:
    """YOLO's loss over all scales.

    heads: (B, A * (5 + C), h, w) logits a stride. targets (T, 7): image, class or -1, x0, y0, x1, y1 (px), ignore. Complete
    IoU for boxes; binary cross entropy for objectness, whose target is the IoU reached; cells centred in ignored boxes are
    left out of the objectness unless they answer for a vehicle; targets of unknown class are left out of the class's loss.
    """
    positives = targets[targets[:, 6] == 0]
    ignored = targets[targets[:, 6] != 0]
    box = heads[0].new_zeros(())
    objectness, classes = box.clone(), box.clone()
    for head, stride, anchors, balance in zip(heads, config.strides, config.anchors_px, SCALE_BALANCE, strict=True):
        grid = head.unflatten(1, (len(anchors), BOX_FIELDS + len(config.classes))).permute(0, 1, 3, 4, 2)
        index, truth = assign(positives, grid.shape[2:4], stride, head.new_tensor(anchors))
        wanted = torch.zeros_like(grid[..., 4])
        if len(truth):
            cells = grid[index]
            overlap = ciou(decode(cells, index, stride, head.new_tensor(anchors)), truth[:, 2:6])
            box = box + (1 - overlap).mean()
            wanted[index] = overlap.detach().clamp(min=0).to(wanted.dtype)
            classes = classes + _class_loss(cells[:, BOX_FIELDS:], truth[:, 1].long())
        blamed = ~covered_cells(ignored, (len(grid), *grid.shape[2:4]), stride) | (wanted > 0)
        losses = F.binary_cross_entropy_with_logits(grid[..., 4], wanted, reduction="none")
        objectness = objectness + balance * (losses * blamed).mean()
    total = BOX_WEIGHT * box + OBJECT_WEIGHT * objectness + CLASS_WEIGHT * classes
    return {"total": total, "box": box, "objectness": objectness, "classes": classes}


def _class_loss(logits: Tensor, cls: Tensor) -> Tensor:
    """Mean binary cross entropy of logits (P, C) over the targets (P,) whose class is known; 0 when there are none."""
    known = cls != UNKNOWN_CLASS
    one_hot = F.one_hot(cls.clamp(min=0), logits.shape[1]).to(logits.dtype)
    losses = F.binary_cross_entropy_with_logits(logits, one_hot, reduction="none").mean(1)
    return (losses * known).sum() / known.sum().clamp(min=1)


def assign(targets: Tensor, grid_shape: tuple[int, int], stride: int, anchors: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
    """Which cells answer for which targets at one scale.

    targets (T, 7), anchors (A, 2) px. A target is answered for by every anchor within ``MAX_RATIO`` of its shape, in its
    own cell and in the nearer neighbour along each axis (whose centres can reach it). Returns (image, anchor, row,
    column) index tensors (P,) and the targets (P, 7).
    """
    rows, columns = grid_shape
    size = targets[:, 4:6] - targets[:, 2:4]
    ratio = size[:, None] / anchors[None]
    fits = torch.maximum(ratio, 1 / ratio.clamp(min=1e-6)).amax(2) < MAX_RATIO
    target, anchor = fits.nonzero(as_tuple=True)
    # Pixel centres lie at integers: pixel p is at (p + 0.5) / stride cells.
    center = ((targets[target, 2:4] + targets[target, 4:6]) / 2 + 0.5) / stride
    cell = center.floor()
    toward = torch.where(center - cell < 0.5, -1.0, 1.0)
    zero = torch.zeros_like(toward[:, 0])
    offsets = torch.stack(
        [torch.zeros_like(toward), torch.stack([toward[:, 0], zero], 1), torch.stack([zero, toward[:, 1]], 1)]
    )
    cells = (cell[None] + offsets).reshape(-1, 2).long()
    target, anchor = target.repeat(3), anchor.repeat(3)
    inside = (cells[:, 0] >= 0) & (cells[:, 0] < columns) & (cells[:, 1] >= 0) & (cells[:, 1] < rows)
    target, anchor, cells = target[inside], anchor[inside], cells[inside]
    return (targets[target, 0].long(), anchor, cells[:, 1], cells[:, 0]), targets[target]


def decode(cells: Tensor, index: tuple[Tensor, ...], stride: int, anchors: Tensor) -> Tensor:
    """Boxes xyxy (P, 4) in px of cells (P, 5 + C) of logits: as ``service.nets.decoding.decode_heads``, with gradients."""
    probability = cells.sigmoid()
    place = torch.stack([index[3], index[2]], 1)
    center = (2 * probability[:, :2] - 0.5 + place) * stride - 0.5
    half = 0.5 * (2 * probability[:, 2:4]) ** 2 * anchors[index[1]]
    return torch.cat([center - half, center + half], 1)
