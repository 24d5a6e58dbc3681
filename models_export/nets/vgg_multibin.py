"""The paper's multi-bin head: VGG16's convolutions, then the branches of Mousavian et al. for angle, bin and size."""

from __future__ import annotations

import math
import pickle
from dataclasses import dataclass, field
from itertools import chain, pairwise
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from models_export.nets.blocks import NormaliseImageNet
from service.errors import InputError


def even_bins(count: int, first_rad: float = 0.0) -> tuple[float, ...]:
    """Centres of ``count`` bins of alpha, radians, evenly spaced from ``first_rad`` on."""
    return tuple(first_rad + 2 * math.pi * k / count for k in range(count))


@dataclass(frozen=True)
class VggMultibinConfig:
    """Shape of the head; the defaults are the published one."""

    classes: tuple[str, ...] = ("car",)
    crop_px: int = 224
    max_width: int | None = None
    """Widest image that crops are cut from, px; None: what the detector sees."""
    bin_centers_rad: tuple[float, ...] = field(default_factory=lambda: even_bins(2))
    """Of alpha, evenly spaced; their number is B. Public code has two pairs of centres: 0 and pi of KITTI's alpha + pi/2, and
    pi/2 and 3 pi/2 of its alpha + pi. KITTI's alpha is ``-alpha - pi/2``, so both are these two: away from the camera, and
    towards it."""
    bin_overlap_rad: float = 0.1
    """How far a bin reaches into its neighbour, a side."""
    mean_dims_lwh: tuple[tuple[float, float, float], ...] = ((3.884, 1.629, 1.526),)
    """Size priors a class, metres, KITTI's cars; the training data's means replace these."""
    channels: tuple[int, ...] = (64, 128, 256, 512, 512)
    """Of the stages; each ends in a pooling that halves the resolution."""
    convolutions: tuple[int, ...] = (2, 2, 3, 3, 3)
    """3x3 convolutions a stage."""
    angle_width: int = 256
    """Width of the orientation and confidence branches."""
    size_width: int = 512
    """Width of the dimensions branch."""
    dropout: float = 0.5

    def __post_init__(self) -> None:
        """Raises InputError when the bins leave angles that none of them covers."""
        gaps = [b - a for a, b in pairwise((*self.bin_centers_rad, self.bin_centers_rad[0] + 2 * math.pi))]
        if max(gaps) - min(gaps) > 1e-6:
            raise InputError(f"gaps of {gaps} rad.", field="bin_centers_rad", remedy="Space the centres evenly, rising.")


class VggMultibin(nn.Module):
    """uint8 crops (N, S, S, 3) to bin vectors (N, B, 2), bin logits (N, B), size residuals (N, 3) in metres.

    The outputs mean what those of ``EdgeMultibin`` mean. Modules of ``features`` are numbered as torchvision's ``vgg16``.
    """

    def __init__(self, config: VggMultibinConfig) -> None:
        super().__init__()
        self.config = config
        self.bins = len(config.bin_centers_rad)
        self.normalise = NormaliseImageNet()
        self.features = vgg_features(config.channels, config.convolutions)
        flat = config.channels[-1] * (config.crop_px // 2 ** len(config.channels)) ** 2
        self.orientation = self._branch(flat, config.angle_width, 2 * self.bins)
        self.confidence = self._branch(flat, config.angle_width, self.bins)
        self.dimensions = self._branch(flat, config.size_width, 3)
        for part in (self.features, self.orientation[:-1], self.confidence[:-1], self.dimensions[:-1]):
            part.apply(_start)

    def _branch(self, flat: int, width: int, out: int) -> nn.Sequential:
        widths = (flat, width, width)
        hidden = [(nn.Linear(a, b), nn.ReLU(inplace=True), nn.Dropout(self.config.dropout)) for a, b in pairwise(widths)]
        return nn.Sequential(*chain.from_iterable(hidden), nn.Linear(width, out))

    def load_imagenet(self, weights: Path) -> None:
        """Take the convolutions from a ``.pth`` state dict with torchvision's ``vgg16`` names; its classifier is not used.

        Raises InputError when the file cannot be read, or does not hold these convolutions.
        """
        saved = _read_state(weights)
        ours = self.features.state_dict()
        for key, value in ours.items():
            found = saved.get(f"features.{key}")
            if not isinstance(found, Tensor) or found.shape != value.shape:
                shape = f"has shape {tuple(found.shape)}" if isinstance(found, Tensor) else "is missing"
                raise InputError(
                    f"'features.{key}' {shape}, {tuple(value.shape)} is needed.",
                    field=str(weights),
                    remedy="Give the state dict of torchvision's vgg16 (the one without batch norm).",
                )
        self.features.load_state_dict({key: saved[f"features.{key}"] for key in ours})

    def forward(self, crops: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Bin vectors are (cos, sin) of the angle past the bin's centre, of length 1."""
        features = self.features(self.normalise(crops)).flatten(1)
        vectors = self.orientation(features).reshape(-1, self.bins, 2)
        return functional.normalize(vectors, dim=-1), self.confidence(features), self.dimensions(features)


def vgg_features(channels: tuple[int, ...], convolutions: tuple[int, ...]) -> nn.Sequential:
    """VGG's convolutional part: (N, 3, S, S) float to (N, C, S / 2^stages, S / 2^stages)."""
    layers: list[nn.Module] = []
    cin = 3
    for width, count in zip(channels, convolutions, strict=True):
        for _ in range(count):
            layers += [nn.Conv2d(cin, width, 3, padding=1), nn.ReLU(inplace=True)]
            cin = width
        layers.append(nn.MaxPool2d(2))
    return nn.Sequential(*layers)


def _start(module: nn.Module) -> None:
    """He's start: without batch norm, torch's default lets what tells crops apart fade on the way through fifteen layers."""
    if isinstance(module, nn.Conv2d | nn.Linear):
        nn.init.kaiming_normal_(module.weight, mode="fan_in", nonlinearity="relu")
        nn.init.zeros_(module.bias)


def _read_state(path: Path) -> dict[str, object]:
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise InputError(
            f"cannot be read: {error}", field=str(path), remedy="Give a .pth file that torch.save wrote a state dict to."
        ) from error
    if not isinstance(state, dict):
        raise InputError("holds no state dict.", field=str(path), remedy="Save `model.state_dict()`, not the model.")
    return state
