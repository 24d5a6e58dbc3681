"""Training of the detector: batches, anchors, target assignment, loss, validation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from copy import copy
from dataclasses import asdict, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from torch import Tensor, nn
from torch.nn import functional as F

from models_export.data.augment import NO_AUGMENT, AugmentConfig
from models_export.data.detection import DetectionSample
from models_export.data.mix import MixConfig, draw_by_odds, draw_odds
from models_export.losses import ciou
from models_export.nets.detector import DetectorConfig, EdgeDetector
from models_export.train.detector_pictures import UNKNOWN_CLASS, canvas_of, stacked, strips_on
from models_export.train.task import Batch, ParameterGroup, decayed_groups
from service.geometry.transforms import Array
from service.nets.decoding import BOX_FIELDS

MAX_RATIO = 4.0
"""An anchor answers for a box whose sides differ from its own by less than this factor: what (2 sigmoid)^2 can reach."""
SCALE_BALANCE = (4.0, 1.0, 0.4)
"""Weights of the objectness of the strides: fine grids hold more cells, and smaller vehicles."""
_ANCHOR_DRAWS = 4000
BOX_WEIGHT, OBJECT_WEIGHT, CLASS_WEIGHT = 0.05, 1.0, 0.2


class DetectorTask:
    """The detector with its training samples, which may be of several data sets and sizes."""

    name = "detector"

    def __init__(
        self,
        samples: Sequence[DetectionSample],
        config: DetectorConfig,
        augment: AugmentConfig | None = None,
        mix: MixConfig | None = None,
    ) -> None:
        self.samples = samples
        self.mix = mix or MixConfig()
        self.odds = draw_odds([sample.source for sample in samples], self.mix)
        self.canvas_px: tuple[int, int] | None = canvas_of(samples)
        drawn = self.draw(np.random.default_rng(0), _ANCHOR_DRAWS)
        self.config = replace(config, anchors_px=anchors_of([samples[i] for i in drawn], config.strides))
        self.augment = augment or AugmentConfig()
        self.net = EdgeDetector(self.config)

    def describe(self) -> dict[str, Any]:
        """Configuration of network, data and augmentation."""
        sources = Counter(sample.source.split("/")[0] for sample in self.samples)
        return {
            "net": asdict(self.config),
            "augment": asdict(self.augment),
            "samples": dict(sorted(sources.items())),
            "mix": asdict(self.mix),
        }

    def __len__(self) -> int:
        return len(self.samples)

    def held_out(self, samples: Sequence[DetectionSample]) -> DetectorTask:
        """The same network and configuration over other samples, as they are, each on its own canvas: for validation."""
        other = copy(self)
        other.samples, other.augment, other.canvas_px = samples, NO_AUGMENT, None
        other.odds = draw_odds([sample.source for sample in samples], self.mix)
        return other

    def draw(self, rng: np.random.Generator, size: int) -> NDArray[np.int64]:
        """Samples by the shares of the mix."""
        return draw_by_odds(rng, self.odds, size)

    def labels(self, index: int) -> dict[str, str]:
        """Camera and weather of a simulated frame, source of a real one."""
        return self.samples[index].labels

    def parameter_groups(self, net: nn.Module) -> list[ParameterGroup]:
        """All of the network at one pace."""
        return decayed_groups(net)

    def batch(self, indices: NDArray[np.int64], rng: np.random.Generator) -> Batch:
        """Images (B, H, W, 3) uint8; targets (T, 7): image, class or -1, x0, y0, x1, y1 (px), ignore.

        Where a canvas takes more than one picture, others of the same data set and size fill it.
        """
        images, targets = [], []
        for row, index in enumerate(indices):
            image, boxes = self._picture(int(index), rng)
            images.append(image)
            targets.append(np.concatenate([np.full((len(boxes), 1), float(row)), boxes], 1))
        return {
            "images": torch.from_numpy(np.stack(images)),
            "targets": torch.from_numpy(np.concatenate(targets)).float().reshape(-1, 7),
        }

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Box, objectness and class losses and their weighted sum."""
        return detector_loss([head.float() for head in net(batch["images"])], batch["targets"], self.config)

    def _picture(self, index: int, rng: np.random.Generator) -> tuple[np.ndarray, Array]:
        sample = self.samples[index]
        if self.canvas_px is None:
            return stacked([sample], (sample.canvas.shape[1], sample.canvas.shape[0]), rng, self.augment)
        strips = strips_on(self.canvas_px, sample)
        others = rng.choice(self._like[_likeness(sample)], size=strips - 1)
        return stacked([sample, *(self.samples[i] for i in others)], self.canvas_px, rng, self.augment)

    @cached_property
    def _like(self) -> dict[tuple[str, int], list[int]]:
        """Samples by data set and height."""
        groups: dict[tuple[str, int], list[int]] = {}
        for index, sample in enumerate(self.samples):
            groups.setdefault(_likeness(sample), []).append(index)
        return groups


def _likeness(sample: DetectionSample) -> tuple[str, int]:
    return sample.source.split("/")[0], sample.canvas.shape[0]


def anchors_of(
    samples: Sequence[DetectionSample], strides: tuple[int, ...], per_scale: int = 3
) -> tuple[tuple[tuple[float, float], ...], ...]:
    """Anchors (width, height), px, by k-means over the logarithms of the boxes' sides: smallest for the finest stride.

    Logarithms, for the decoding scales an anchor by a factor.
    """
    sides = np.concatenate([s.xyxy_px[~s.ignore][:, 2:] - s.xyxy_px[~s.ignore][:, :2] for s in samples])
    centers, _ = kmeans2(np.log(sides), per_scale * len(strides), minit="++", seed=0, iter=50)
    ordered = np.exp(centers[np.argsort(centers.sum(1))])
    rows = [tuple((round(float(w), 1), round(float(h), 1)) for w, h in group) for group in np.split(ordered, len(strides))]
    return tuple(rows)


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
        blamed = ~_covered(ignored, grid.shape, stride, grid.device) | (wanted > 0)
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


def _covered(ignored: Tensor, shape: torch.Size, stride: int, device: torch.device) -> Tensor:
    """Cells (B, 1, h, w) whose centre lies in an ignored box."""
    batch, _, rows, columns, _ = shape
    covered = torch.zeros((batch, 1, rows, columns), dtype=torch.bool, device=device)
    x = (torch.arange(columns, device=device) + 0.5) * stride - 0.5
    y = (torch.arange(rows, device=device) + 0.5) * stride - 0.5
    for image, _, x0, y0, x1, y1, _ in ignored.tolist():
        covered[int(image), 0] |= ((y >= y0) & (y <= y1))[:, None] & ((x >= x0) & (x <= x1))[None]
    return covered
