"""Pictures with 2D boxes as training data: what every detector's task shares."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from copy import copy
from dataclasses import asdict, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from models_export.anchors import Clusters, anchors_of
from models_export.data.augment import NO_AUGMENT, AugmentConfig
from models_export.data.detection import DetectionSample
from models_export.data.mix import MixConfig, draw_by_odds, draw_odds
from models_export.train.detector_pictures import canvas_of, strips_on, tiled
from models_export.train.task import Batch, ParameterGroup, decayed_groups
from service.geometry.transforms import Array

_ANCHOR_DRAWS = 4000


class BoxTask:
    """A detector with its training samples, of several data sets and sizes. A detector's own task adds the loss."""

    name = "detector"

    def __init__(
        self,
        samples: Iterable[DetectionSample],
        config: Any,
        build: Callable[[Any], nn.Module],
        clusters: Clusters,
        augment: AugmentConfig | None,
        mix: MixConfig | None,
    ) -> None:
        """Make the network of ``config``, whose anchors become the samples' own, as drawn by ``mix``."""
        self.samples = list(samples)
        self.mix = mix or MixConfig()
        self.odds = draw_odds([sample.source for sample in self.samples], self.mix)
        self.canvas_px: tuple[int, int] | None = canvas_of(self.samples)
        drawn = self.draw(np.random.default_rng(0), _ANCHOR_DRAWS)
        self.config = replace(config, anchors_px=anchors_of([self.samples[i] for i in drawn], config.strides, clusters))
        self.augment = augment or AugmentConfig()
        self.net = build(self.config)

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

    def held_out(self, samples: Iterable[DetectionSample]) -> Self:
        """The same network and configuration over other samples, as they are, each on its own canvas: for validation."""
        other = copy(self)
        other.samples, other.augment, other.canvas_px = list(samples), NO_AUGMENT, None
        other.odds = draw_odds([sample.source for sample in other.samples], self.mix)
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

    def _picture(self, index: int, rng: np.random.Generator) -> tuple[np.ndarray, Array]:
        sample = self.samples[index]
        if self.canvas_px is None:
            return tiled([sample], (sample.canvas.shape[1], sample.canvas.shape[0]), rng, self.augment)
        strips = strips_on(self.canvas_px, sample)
        columns = 2 if rng.random() < self.augment.tiles else 1
        others = rng.choice(self._like[_likeness(sample)], size=columns**2 * strips - 1)
        return tiled([sample, *(self.samples[i] for i in others)], self.canvas_px, rng, self.augment, columns)

    @cached_property
    def _like(self) -> dict[tuple[str, int], list[int]]:
        """Samples by data set and height."""
        groups: dict[tuple[str, int], list[int]] = {}
        for index, sample in enumerate(self.samples):
            groups.setdefault(_likeness(sample), []).append(index)
        return groups


def _likeness(sample: DetectionSample) -> tuple[str, int]:
    return sample.source.split("/")[0], sample.canvas.shape[0]
