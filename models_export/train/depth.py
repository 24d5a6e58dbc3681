"""Training of the depth net on inverse depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from models_export.data.augment import AugmentConfig, flip_horizontally, photometric
from models_export.data.samples import Sample
from models_export.losses import depth_loss
from models_export.nets.depth import DepthConfig, EdgeDepth
from models_export.nets.dpt import DptConfig, DptHybrid
from models_export.train.loop import Batch


class DepthTask:
    """The depth net with its training samples."""

    name = "depth"

    def __init__(
        self,
        samples: list[Sample],
        config: DepthConfig | DptConfig,
        augment: AugmentConfig | None = None,
        *,
        build: Callable[[Any], nn.Module] = EdgeDepth,
    ) -> None:
        """build: the depth net of a configuration. The samples' inverse depth is at the stride of ``config``."""
        self.samples = samples
        self.config = config
        self.augment = augment or AugmentConfig()
        self.net = build(config)

    def describe(self) -> dict[str, Any]:
        """Configuration of network, data and augmentation."""
        return {"net": asdict(self.config), "augment": asdict(self.augment), "samples": len(self.samples)}

    def batch(self, rng: np.random.Generator, size: int) -> Batch:
        """Images (B, H, W, 3) uint8, inverse depth (B, h, w) in 1 / metres, 0 where unknown."""
        images, targets = [], []
        for index in rng.integers(len(self.samples), size=size):
            sample = self.samples[index]
            image, target = sample.canvas, sample.inverse_depth
            if rng.random() < self.augment.flip:
                image, _ = flip_horizontally(image, np.zeros((0, 4)), sample.image_size[0])
                target = _flip_map(target, sample.image_size[0] // self.config.stride)
            images.append(photometric(image, rng, self.augment))
            targets.append(target)
        return {"images": torch.from_numpy(np.stack(images)), "targets": torch.from_numpy(np.stack(targets))}

    def parameter_groups(self, net: nn.Module) -> list[tuple[list[nn.Parameter], float]]:
        """Parameters of ``net``, each group with its factor of the learning rate: DPT's encoder learns slower."""
        return net.parameter_groups() if isinstance(net, DptHybrid) else [(list(net.parameters()), 1.0)]

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Trimmed scale-and-shift-invariant loss plus gradient matching, over cells of known depth."""
        return depth_loss(net(batch["images"]).float(), batch["targets"], batch["targets"] > 0)


def _flip_map(target: np.ndarray, columns: int) -> np.ndarray:
    """Mirror the left ``columns`` cells; the image's width is not quite whole cells, so the rest counts as unknown."""
    flipped = np.zeros_like(target)
    flipped[:, :columns] = target[:, :columns][:, ::-1]
    return flipped
