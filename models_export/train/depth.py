"""Training of the depth net on inverse depth."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from copy import copy
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from models_export.data.augment import NO_AUGMENT, AugmentConfig, flip_horizontally, photometric
from models_export.data.samples import Sample
from models_export.losses import depth_loss
from models_export.nets.depth import DepthConfig, EdgeDepth
from models_export.nets.dpt import DptConfig, DptHybrid
from models_export.train.task import Batch, ParameterGroup, decayed_groups, draw_uniform


class DepthTask:
    """The depth net with its training samples."""

    name = "depth"

    def __init__(
        self,
        samples: Iterable[Sample],
        config: DepthConfig | DptConfig,
        augment: AugmentConfig | None = None,
        *,
        build: Callable[[Any], nn.Module] = EdgeDepth,
    ) -> None:
        """build: the depth net of a configuration. The samples' inverse depth is at the stride of ``config``."""
        self.samples = list(samples)
        self.like = _by_size(self.samples)
        self.config = config
        self.augment = augment or AugmentConfig()
        self.net = build(config)

    def describe(self) -> dict[str, Any]:
        """Configuration of network, data and augmentation."""
        return {"net": asdict(self.config), "augment": asdict(self.augment), "samples": len(self.samples)}

    def __len__(self) -> int:
        return len(self.samples)

    def held_out(self, samples: Iterable[Sample]) -> DepthTask:
        """The same network and configuration over other samples, which are not augmented: for validation."""
        other = copy(self)
        other.samples, other.augment = list(samples), NO_AUGMENT
        other.like = _by_size(other.samples)
        return other

    def draw(self, rng: np.random.Generator, size: int) -> NDArray[np.int64]:
        """A frame as likely as the others, and more of its size: a batch has one."""
        (first,) = draw_uniform(rng, len(self), 1)
        like = self.like[self.samples[first].canvas.shape]
        return np.concatenate([[first], rng.choice(like, size - 1)])

    def labels(self, index: int) -> dict[str, str]:
        """Camera and weather of a frame."""
        return self.samples[index].labels

    def parameter_groups(self, net: nn.Module) -> list[ParameterGroup]:
        """All of the network at one pace; DPT's encoder, which starts from pretrained weights, slower."""
        if isinstance(net, DptHybrid):
            return [group for part, rate in net.paces() for group in decayed_groups(part, rate)]
        return decayed_groups(net)

    def batch(self, indices: NDArray[np.int64], rng: np.random.Generator) -> Batch:
        """Images (B, H, W, 3) uint8, inverse depth (B, h, w) in 1 / metres, 0 where unknown."""
        images, targets = [], []
        for index in indices:
            sample = self.samples[index]
            image, target = sample.canvas, sample.inverse_depth
            if rng.random() < self.augment.flip:
                image, _ = flip_horizontally(image, np.zeros((0, 4)), sample.image_size[0])
                target = _flip_map(target, sample.image_size[0] // self.config.stride)
            images.append(photometric(image, rng, self.augment))
            targets.append(target)
        return {"images": torch.from_numpy(np.stack(images)), "targets": torch.from_numpy(np.stack(targets))}

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Trimmed scale-and-shift-invariant loss plus gradient matching, over cells of known depth."""
        return depth_loss(net(batch["images"]).float(), batch["targets"], batch["targets"] > 0)


def _by_size(samples: list[Sample]) -> dict[tuple[int, ...], list[int]]:
    """Indices of samples by the size of their canvases."""
    groups: dict[tuple[int, ...], list[int]] = {}
    for index, sample in enumerate(samples):
        groups.setdefault(sample.canvas.shape, []).append(index)
    return groups


def _flip_map(target: np.ndarray, columns: int) -> np.ndarray:
    """Mirror the left ``columns`` cells; the image's width is not quite whole cells, so the rest counts as unknown."""
    flipped = np.zeros_like(target)
    flipped[:, :columns] = target[:, :columns][:, ::-1]
    return flipped
