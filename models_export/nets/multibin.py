"""The edge multi-bin head: a small convolutional trunk, the paper's three branches, and two more for edges and uncertainty."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from models_export.nets.blocks import Normalise, conv, stage
from service.nets.multibin import UNCERTAIN

SIGMA_UNITS = (0.05, 0.1, 0.1, 0.1, 0.01, 0.01, 0.01, 0.01)
"""Usual errors of ``UNCERTAIN``: training counts in them, so that all weigh alike. Radians, metres, sides of the crop."""
_MIN_LOG, _MAX_LOG = -3.0, 4.0
"""Limits of the predicted logarithms over those units."""


@dataclass(frozen=True)
class MultibinConfig:
    """Shape of the head."""

    classes: tuple[str, ...] = ("car", "van", "truck", "bus")
    crop_px: int = 96
    max_width: int | None = 1344
    """Widest image that crops are cut from, px: twice what the detector sees, for crops cost little and show more. None: what
    the detector sees."""
    bin_centers_rad: tuple[float, ...] = (0.0, math.pi)
    """Driving away from the camera, and towards it."""
    bin_overlap_rad: float = 0.1
    """How far a bin reaches into its neighbour, a side."""
    mean_dims_lwh: tuple[tuple[float, float, float], ...] = ((4.4, 1.8, 1.5),) * 4
    """Size priors a class, metres; the training data's means replace these."""
    channels: tuple[int, ...] = (16, 32, 64, 160)
    """After the stem and after each stage: strides 2, 4, 8, 16 of the crop."""
    residuals: tuple[int, ...] = (1, 2, 1)
    """Residual blocks of the stages."""
    squeezed: int = 96
    """Channels of the last map, which the branches read whole."""
    hidden: int = 96
    """Width of a branch."""
    dropout: float = 0.1


class EdgeMultibin(nn.Module):
    """uint8 crops (N, S, S, 3) to what :func:`service.nets.multibin.decode_multibin` reads.

    Outputs: bin vectors (N, B, 2), bin logits (N, B), size residuals (N, 3) in metres, edges (N, 4) in the crop's sides from
    its middle, and the logarithms of the standard deviations (N, 8) of ``UNCERTAIN``.
    """

    def __init__(self, config: MultibinConfig) -> None:
        super().__init__()
        self.config = config
        c1, c2, c3, c4 = config.channels
        r2, r3, r4 = config.residuals
        self.bins = len(config.bin_centers_rad)
        self.normalise = Normalise()
        self.trunk = nn.Sequential(
            conv(3, c1, 3, 2),
            stage(c1, c2, r2),
            stage(c2, c3, r3),
            stage(c3, c4, r4),
            conv(c4, config.squeezed, 1),
            nn.Flatten(),
        )
        features = config.squeezed * (config.crop_px // 16) ** 2
        self.orientation = self._branch(features, 2 * self.bins)
        self.confidence = self._branch(features, self.bins)
        self.dimensions = self._branch(features, 3)
        self.edges = self._branch(features, 4)
        self.log_sigma = self._branch(features, len(UNCERTAIN))
        self.register_buffer("log_units", torch.tensor(SIGMA_UNITS).log(), persistent=False)

    def _branch(self, features: int, out: int) -> nn.Sequential:
        hidden = self.config.hidden
        return nn.Sequential(
            nn.Linear(features, hidden), nn.ReLU(inplace=True), nn.Dropout(self.config.dropout), nn.Linear(hidden, out)
        )

    def forward(self, crops: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Bin vectors are (cos, sin) of the angle past the bin's centre, of length 1."""
        features = self.trunk(self.normalise(crops))
        vectors = self.orientation(features).reshape(-1, self.bins, 2)
        # Not x / sqrt(x^2 + eps): int8 rounds that sum to 0 now and then, and the quotient is then no number.
        vectors = functional.normalize(vectors, dim=-1)
        log_sigma = self.log_sigma(features).clamp(_MIN_LOG, _MAX_LOG) + self.log_units
        return vectors, self.confidence(features), self.dimensions(features), self.edges(features), log_sigma
