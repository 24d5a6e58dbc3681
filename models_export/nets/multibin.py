"""The edge multi-bin head: a small convolutional trunk, then the paper's three branches."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor, nn
from torch.nn import functional

from models_export.nets.blocks import Normalise, conv, stage


@dataclass(frozen=True)
class MultibinConfig:
    """Shape of the head."""

    classes: tuple[str, ...] = ("car",)
    crop_px: int = 64
    bin_centers_rad: tuple[float, ...] = (0.0, math.pi)
    """Driving away from the camera, and towards it."""
    bin_overlap_rad: float = 0.1
    """How far a bin reaches into its neighbour, a side."""
    mean_dims_lwh: tuple[tuple[float, float, float], ...] = ((4.4, 1.8, 1.5),)
    """Size priors a class, metres; the training data's means replace these."""
    channels: tuple[int, ...] = (24, 48, 96, 160)
    dropout: float = 0.2


class EdgeMultibin(nn.Module):
    """uint8 crops (N, S, S, 3) to bin vectors (N, B, 2), bin logits (N, B), size residuals (N, 3) in metres."""

    def __init__(self, config: MultibinConfig) -> None:
        super().__init__()
        self.config = config
        c1, c2, c3, c4 = config.channels
        self.bins = len(config.bin_centers_rad)
        self.normalise = Normalise()
        self.trunk = nn.Sequential(conv(3, c1, 3, 2), stage(c1, c2, 1), stage(c2, c3, 1), stage(c3, c4, 1), nn.Flatten())
        features = c4 * (config.crop_px // 16) ** 2
        self.orientation = self._branch(features, 2 * self.bins)
        self.confidence = self._branch(features, self.bins)
        self.dimensions = self._branch(features, 3)

    def _branch(self, features: int, out: int) -> nn.Sequential:
        return nn.Sequential(
            nn.Linear(features, 96), nn.ReLU(inplace=True), nn.Dropout(self.config.dropout), nn.Linear(96, out)
        )

    def forward(self, crops: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Bin vectors are (cos, sin) of the angle past the bin's centre, of length 1."""
        features = self.trunk(self.normalise(crops))
        vectors = self.orientation(features).reshape(-1, self.bins, 2)
        # Not x / sqrt(x^2 + eps): int8 rounds that sum to 0 now and then, and the quotient is then no number.
        vectors = functional.normalize(vectors, dim=-1)
        return vectors, self.confidence(features), self.dimensions(features)
