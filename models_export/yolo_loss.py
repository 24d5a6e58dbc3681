"""YOLOv3's loss as Darknet computes it (Redmon and Farhadi 2018).

One prediction answers for a vehicle: the cell of its centre at the one anchor, of all scales, that is most like it. Darknet
knows only the gradients, "deltas": sigmoid(t) - target for the centre, objectness and classes, t - target for the logarithms of
the sides, centre and sides scaled by 2 - w h, w and h being parts of the picture, so that small vehicles count for more.
The terms here have just these gradients, and are zero at the truth. All other predictions are asked for objectness 0, but for
those that overlap some vehicle by more than ``IGNORE_IOU``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from torch.nn import functional as F

from service.nets.decoding import BOX_FIELDS, MAX_LOG_SIZE

IGNORE_IOU = 0.7
"""Darknet's ``ignore_thresh``."""


class AnchoredConfig(Protocol):
    """What the loss needs to know of a detector."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Its classes."""

    @property
    def strides(self) -> tuple[int, ...]:
        """Canvas pixels a cell, a scale each."""

    @property
    def anchors_px(self) -> tuple[tuple[tuple[float, float], ...], ...]:
        """Per stride, (width, height) of each anchor, px; as many at every stride."""


@dataclass(frozen=True, eq=False)
class Predictions:
    """All scales' predictions of B images in one row of N: by scale, anchor, row, column."""

    logits: Tensor
    """(B, N, 5 + C)."""
    cell: Tensor
    """(N, 2) column and row."""
    stride: Tensor
    """(N, 1) px."""
    anchor: Tensor
    """(N, 2) width and height, px."""

    def boxes(self) -> Tensor:
        """xyxy (B, N, 4), px: as ``service.nets.decoding`` decodes ``yolov3``, for integer pixel centres."""
        center = (self.logits[..., :2].sigmoid() + self.cell) * self.stride - 0.5
        half = 0.5 * self.anchor * self.logits[..., 2:4].clamp(max=MAX_LOG_SIZE).exp()
        return torch.cat([center - half, center + half], -1)


def yolo_loss(heads: Sequence[Tensor], targets: Tensor, config: AnchoredConfig) -> dict[str, Tensor]:
    """Darknet's loss, summed over predictions and averaged over images.

    heads: (B, A * (5 + C), h, w) logits a stride. targets (T, 7): image, class or -1, x0, y0, x1, y1 (px), ignore. Ignored
    vehicles are not asked for, and cells centred in them are not blamed; an unknown class is not asked for.
    """
    found = flatten(heads, config)
    positives, ignored = targets[targets[:, 6] == 0], targets[targets[:, 6] != 0]
    images, logits = len(found.logits), found.logits
    index, truth = assign_best(positives, heads, config)
    blamed = ~(_overlaps(found, targets) | _covered(ignored, heads, config))
    wanted = torch.zeros_like(logits[..., 4])
    blamed[index], wanted[index] = True, 1.0
    objectness = F.binary_cross_entropy_with_logits(logits[..., 4], wanted, reduction="none")[blamed].sum()
    answers, place = logits[index], index[1]
    size = truth[:, 4:6] - truth[:, 2:4]
    canvas = heads[0].new_tensor([heads[0].shape[3], heads[0].shape[2]]) * config.strides[0]
    scale = 2 - (size / canvas).prod(1)
    center = ((truth[:, 2:4] + truth[:, 4:6]) / 2 + 0.5) / found.stride[place] - found.cell[place]
    sides = (size / found.anchor[place]).log()
    box = (scale * (_divergence(answers[:, :2], center) + 0.5 * (answers[:, 2:4] - sides) ** 2).sum(1)).sum()
    known = truth[:, 1] >= 0
    one_hot = F.one_hot(truth[known, 1].long(), len(config.classes)).to(logits.dtype)
    classes = F.binary_cross_entropy_with_logits(answers[known, BOX_FIELDS:], one_hot, reduction="sum")
    terms = {"box": box / images, "objectness": objectness / images, "classes": classes / images}
    return {"total": terms["box"] + terms["objectness"] + terms["classes"], **terms}


def flatten(heads: Sequence[Tensor], config: AnchoredConfig) -> Predictions:
    """The heads (B, A * (5 + C), h, w) as one row of predictions."""
    logits, cells, strides, anchors = [], [], [], []
    for head, stride, shapes in zip(heads, config.strides, config.anchors_px, strict=True):
        rows, columns = head.shape[-2:]
        grid = head.unflatten(1, (len(shapes), BOX_FIELDS + len(config.classes))).permute(0, 1, 3, 4, 2)
        logits.append(grid.flatten(1, 3))
        y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
        cells.append(torch.stack([x, y], -1).reshape(-1, 2).repeat(len(shapes), 1).to(head))
        strides.append(head.new_full((len(cells[-1]), 1), stride))
        anchors.append(head.new_tensor(shapes).repeat_interleave(rows * columns, 0))
    return Predictions(torch.cat(logits, 1), torch.cat(cells), torch.cat(strides), torch.cat(anchors))


def assign_best(targets: Tensor, heads: Sequence[Tensor], config: AnchoredConfig) -> tuple[tuple[Tensor, Tensor], Tensor]:
    """Which prediction answers for which target (T, 7): (image, place) index tensors (P,) into (B, N), and targets (P, 7).

    Where two targets ask for one prediction the later one has it.
    """
    size = targets[:, 4:6] - targets[:, 2:4]
    anchors = targets.new_tensor(config.anchors_px)
    shared = torch.minimum(size[:, None], anchors.reshape(1, -1, 2)).prod(2)
    union = size.prod(1)[:, None] + anchors.reshape(-1, 2).prod(1) - shared
    best = (shared / union).argmax(1)
    scale, anchor = best // anchors.shape[1], best % anchors.shape[1]
    rows = torch.tensor([head.shape[2] for head in heads], device=targets.device)
    columns = torch.tensor([head.shape[3] for head in heads], device=targets.device)
    ends = torch.cumsum(anchors.shape[1] * rows * columns, 0)
    starts = ends - anchors.shape[1] * rows * columns
    # Pixel centres lie at integers: pixel p is at (p + 0.5) / stride cells.
    cell = ((targets[:, 2:4] + targets[:, 4:6]) / 2 + 0.5) / targets.new_tensor(config.strides)[scale][:, None]
    column = cell[:, 0].long().clamp(min=0).minimum(columns[scale] - 1)
    row = cell[:, 1].long().clamp(min=0).minimum(rows[scale] - 1)
    place = starts[scale] + (anchor * rows[scale] + row) * columns[scale] + column
    image = targets[:, 0].long()
    asked = {pair: number for number, pair in enumerate(zip(image.tolist(), place.tolist(), strict=True))}
    last = torch.tensor(list(asked.values()), dtype=torch.long, device=targets.device)
    return (image[last], place[last]), targets[last]


def covered_cells(ignored: Tensor, shape: tuple[int, int, int], stride: int) -> Tensor:
    """Which cells (B, 1, h, w) of a grid of shape (B, h, w) have their centre in a target (T, 7) of their image."""
    batch, rows, columns = shape
    covered = torch.zeros((batch, 1, rows, columns), dtype=torch.bool, device=ignored.device)
    x = (torch.arange(columns, device=ignored.device) + 0.5) * stride - 0.5
    y = (torch.arange(rows, device=ignored.device) + 0.5) * stride - 0.5
    for image, _, x0, y0, x1, y1, _ in ignored.tolist():
        covered[int(image), 0] |= ((y >= y0) & (y <= y1))[:, None] & ((x >= x0) & (x <= x1))[None]
    return covered


def _covered(ignored: Tensor, heads: Sequence[Tensor], config: AnchoredConfig) -> Tensor:
    """Predictions (B, N) of cells centred in ignored vehicles."""
    parts = []
    for head, stride, anchors in zip(heads, config.strides, config.anchors_px, strict=True):
        cells = covered_cells(ignored, (len(head), head.shape[2], head.shape[3]), stride)
        parts.append(cells.expand(-1, len(anchors), -1, -1).flatten(1))
    return torch.cat(parts, 1)


@torch.no_grad()
def _overlaps(found: Predictions, targets: Tensor) -> Tensor:
    """Predictions (B, N) that overlap some vehicle of their image by more than ``IGNORE_IOU``."""
    boxes = found.boxes()
    overlaps = torch.zeros(boxes.shape[:2], dtype=torch.bool, device=boxes.device)
    for target in targets:
        image = int(target[0])
        ours, theirs = boxes[image], target[2:6].to(boxes)
        low, high = torch.maximum(ours[:, :2], theirs[:2]), torch.minimum(ours[:, 2:], theirs[2:])
        shared = (high - low).clamp(min=0).prod(1)
        union = (ours[:, 2:] - ours[:, :2]).prod(1) + (theirs[2:] - theirs[:2]).prod() - shared
        overlaps[image] |= shared > IGNORE_IOU * union
    return overlaps


def _divergence(logits: Tensor, wanted: Tensor) -> Tensor:
    """Binary cross entropy less its least value, which a target between 0 and 1 has: zero at the truth, the same gradient."""
    least = torch.special.entr(wanted) + torch.special.entr(1 - wanted)
    return F.binary_cross_entropy_with_logits(logits, wanted, reduction="none") - least
