"""The edge multi-bin head: a small convolutional trunk, the paper's three branches, and two for outline and uncertainty."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from models_export.nets.blocks import Normalise, conv, patches, stage
from service.geometry.boxes import TANGENT_DEGREES
from service.nets.multibin import EDGES

OUTLINE_READINGS = EDGES + len(TANGENT_DEGREES)
"""Edges and tangents."""
SIGMA_UNITS = (0.05, 0.1, 0.1, 0.1, *(0.01,) * OUTLINE_READINGS)
"""Usual errors of ``UNCERTAIN`` and the tangents: training counts in them, so that all weigh alike. Radians, metres, sides of
the crop."""
_MIN_LOG, _MAX_LOG = -3.0, 4.0
"""Limits of the predicted logarithms over those units."""
OUTLINE_BINS, OUTLINE_REACH = 80, 1.0
"""A reading of the outline is the mean of a distribution over as many places between -reach and reach, in the crop's sides: it
is learned as a choice among places, and so finer and faster than as a number (SimCC, Li et al., ECCV 2022)."""


@dataclass(frozen=True)
class MultibinConfig:
    """Shape of the head."""

    classes: tuple[str, ...] = ("car", "van", "truck", "bus")
    crop_px: int = 96
    max_width: int | None = 1344
    """Widest image that crops are cut from, px: twice what the detector sees, for crops cost little and show more. None: what
    the detector sees."""
    bin_centers_rad: tuple[float, ...] = (0.0, math.pi / 2, math.pi, -math.pi / 2)
    """Driving away from the camera, to its left, towards it, to its right: what looks alike from the side has its own bins."""
    bin_overlap_rad: float = 0.1
    """How far a bin reaches into its neighbour, a side."""
    mean_dims_lwh: tuple[tuple[float, float, float], ...] = ((4.4, 1.8, 1.5),) * 4
    """Size priors a class, metres; the training data's means replace these."""
    channels: tuple[int, int, int] = (32, 64, 160)
    """After the stem and after each stage: strides 4, 8, 16 of the crop."""
    residuals: tuple[int, int] = (2, 2)
    """Residual blocks of the stages."""
    squeezed: int = 96
    """Channels of the last map, which the branches read whole."""
    detail: int = 24
    """Channels of the map of stride 8 that the outline's branch reads too: places want more detail than kinds."""
    hidden: int = 96
    """Width of a branch; the outline's is twice as wide."""
    dropout: float = 0.0


class EdgeMultibin(nn.Module):
    """uint8 crops (N, S, S, 3) to what :func:`service.nets.multibin.decode_multibin` reads.

    Outputs: bin vectors (N, B, 2), bin logits (N, B), size residuals (N, 3) in metres, edges and tangents (N, 12) in the
    crop's sides from its middle, and the logarithms of the standard deviations (N, 16) of ``UNCERTAIN`` and the tangents.
    """

    def __init__(self, config: MultibinConfig) -> None:
        super().__init__()
        self.config = config
        c4, c8, c16 = config.channels
        r8, r16 = config.residuals
        self.bins = len(config.bin_centers_rad)
        self.normalise = Normalise()
        self.early = nn.Sequential(patches(c4), stage(c4, c8, r8))
        self.late = nn.Sequential(stage(c8, c16, r16), conv(c16, config.squeezed, 1))
        self.detail = conv(c8, config.detail, 1)
        cells = (config.crop_px // 16) ** 2
        features, detail = config.squeezed * cells, config.detail * 4 * cells
        self.orientation = self._branch(features, 2 * self.bins)
        self.confidence = self._branch(features, self.bins)
        self.dimensions = self._branch(features, 3)
        self.outline = self._branch(features + detail, OUTLINE_READINGS * OUTLINE_BINS, 2 * config.hidden)
        self.log_sigma = self._branch(features, len(SIGMA_UNITS))
        self.register_buffer("log_units", torch.tensor(SIGMA_UNITS).log(), persistent=False)
        self.register_buffer("places", outline_places(), persistent=False)

    def _branch(self, features: int, out: int, hidden: int | None = None) -> nn.Sequential:
        hidden = hidden or self.config.hidden
        return nn.Sequential(
            nn.Linear(features, hidden), nn.ReLU(inplace=True), nn.Dropout(self.config.dropout), nn.Linear(hidden, out)
        )

    def forward(self, crops: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Bin vectors are (cos, sin) of the angle past the bin's centre, of length 1."""
        return self.with_places(crops)[:5]

    def with_places(self, crops: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """What ``forward`` gives, and the logits (N, 12, ``OUTLINE_BINS``) of the outline's places: for training."""
        early = self.early(self.normalise(crops))
        features = self.late(early).flatten(1)
        vectors = self.orientation(features).reshape(-1, self.bins, 2)
        # Not x / sqrt(x^2 + eps): int8 rounds that sum to 0 now and then, and the quotient is then no number.
        vectors = functional.normalize(vectors, dim=-1)
        log_sigma = self.log_sigma(features).clamp(_MIN_LOG, _MAX_LOG) + self.log_units
        detailed = torch.cat([features, self.detail(early).flatten(1)], 1)
        logits = self.outline(detailed).reshape(-1, OUTLINE_READINGS, OUTLINE_BINS)
        outline = (logits.softmax(-1) * self.places).sum(-1)
        return vectors, self.confidence(features), self.dimensions(features), outline, log_sigma, logits


def outline_places() -> Tensor:
    """Middles (``OUTLINE_BINS``,) of the outline's places, in the crop's sides from its middle."""
    width = 2 * OUTLINE_REACH / OUTLINE_BINS
    return (torch.arange(OUTLINE_BINS) + 0.5) * width - OUTLINE_REACH
