"""Frames with 2D boxes as training data: what every detector's task shares."""

from __future__ import annotations

from copy import copy
from dataclasses import asdict
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from models_export.data.augment import NO_AUGMENT, AugmentConfig, flip_horizontally, photometric, rescale
from models_export.data.samples import MIN_SIDE_PX, Sample
from models_export.train.task import Batch, ParameterGroup, decayed_groups, draw_uniform
from service.geometry.transforms import Array


class BoxTask:
    """A detector with its training samples. A detector's own task adds the loss."""

    name = "detector"

    def __init__(self, samples: list[Sample], config: Any, net: nn.Module, augment: AugmentConfig | None) -> None:
        self.samples, self.config, self.net = samples, config, net
        self.augment = augment or AugmentConfig()

    def describe(self) -> dict[str, Any]:
        """Configuration of network, data and augmentation."""
        return {"net": asdict(self.config), "augment": asdict(self.augment), "samples": len(self.samples)}

    def __len__(self) -> int:
        return len(self.samples)

    def held_out(self, samples: list[Sample]) -> Self:
        """The same network and configuration over other samples, which are not augmented: for validation."""
        other = copy(self)
        other.samples, other.augment = samples, NO_AUGMENT
        return other

    def draw(self, rng: np.random.Generator, size: int) -> NDArray[np.int64]:
        """Every frame is as likely as the others."""
        return draw_uniform(rng, len(self), size)

    def labels(self, index: int) -> dict[str, str]:
        """Camera and weather of a frame."""
        return self.samples[index].labels

    def parameter_groups(self, net: nn.Module) -> list[ParameterGroup]:
        """All of the network at one pace."""
        return decayed_groups(net)

    def batch(self, indices: NDArray[np.int64], rng: np.random.Generator) -> Batch:
        """Images (B, H, W, 3) uint8; targets (T, 7): image, class, x0, y0, x1, y1 (px), ignore."""
        images, targets = [], []
        for row, index in enumerate(indices):
            image, boxes = self._augmented(self.samples[index], rng)
            images.append(image)
            targets.append(np.concatenate([np.full((len(boxes), 1), float(row)), boxes], 1))
        return {
            "images": torch.from_numpy(np.stack(images)),
            "targets": torch.from_numpy(np.concatenate(targets)).float().reshape(-1, 7),
        }

    def _augmented(self, sample: Sample, rng: np.random.Generator) -> tuple[np.ndarray, Array]:
        image, xyxy = sample.canvas, sample.xyxy_px
        if rng.random() < self.augment.flip:
            image, xyxy = flip_horizontally(image, xyxy, sample.image_size[0])
        if rng.random() < self.augment.geometric:
            image, xyxy = rescale(image, xyxy, rng, self.augment)
        height, width = image.shape[:2]
        clipped = np.clip(xyxy, 0, np.array([width - 1, height - 1] * 2))
        sides, full = clipped[:, 2:] - clipped[:, :2], np.maximum(xyxy[:, 2:] - xyxy[:, :2], 1e-6)
        kept = np.prod(sides, axis=1) / np.prod(full, axis=1)
        ignore = sample.ignore | (sides.min(1, initial=np.inf) < MIN_SIDE_PX) | (kept < 0.3)
        present = sides.min(1, initial=np.inf) > 1
        rows = np.concatenate([sample.cls[:, None], clipped, ignore[:, None]], 1)
        return photometric(image, rng, self.augment), rows[present]
