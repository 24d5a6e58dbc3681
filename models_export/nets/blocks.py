"""Building blocks of the edge networks: plain convolution, batch norm, ReLU, which fold and quantize without loss of speed."""

from __future__ import annotations

import torch
from torch import Tensor, nn

PIXEL_SCALE, PIXEL_OFFSET = 1.0 / 127.5, 1.0
"""Networks see ``pixel * PIXEL_SCALE - PIXEL_OFFSET``."""
_PRIOR_OBJECTNESS_LOGIT = -4.6
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""RGB over 0..1: what torchvision's ImageNet weights were trained under."""


class Normalise(nn.Module):
    """uint8 NHWC pixels, 0..255, to float NCHW in -1..1; part of every exported graph."""

    def forward(self, images: Tensor) -> Tensor:
        """(B, H, W, 3) uint8 to (B, 3, H, W) float."""
        return images.permute(0, 3, 1, 2).float() * PIXEL_SCALE - PIXEL_OFFSET


class NormaliseImageNet(nn.Module):
    """uint8 NHWC RGB pixels, 0..255, to float NCHW of ImageNet's mean 0 and deviation 1."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", 255 * torch.tensor(IMAGENET_MEAN).reshape(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", 255 * torch.tensor(IMAGENET_STD).reshape(1, 3, 1, 1), persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        """(B, H, W, 3) uint8 to (B, 3, H, W) float."""
        return (images.permute(0, 3, 1, 2).float() - self.mean) / self.std


def conv(cin: int, cout: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    """Convolution, batch norm, ReLU; "same" padding."""
    return nn.Sequential(
        nn.Conv2d(cin, cout, kernel, stride, kernel // 2, bias=False), nn.BatchNorm2d(cout), nn.ReLU(inplace=True)
    )


def projection(cin: int, cout: int) -> nn.Sequential:
    """Convolution of single pixels, batch norm; no ReLU, for what is added to other maps."""
    return nn.Sequential(nn.Conv2d(cin, cout, 1, bias=False), nn.BatchNorm2d(cout))


def halving(channels: int) -> nn.Conv2d:
    """Half the resolution, each channel by itself; a mean of four pixels at first. In int8 faster than average pooling."""
    layer = nn.Conv2d(channels, channels, 2, 2, groups=channels, bias=False)
    nn.init.constant_(layer.weight, 0.25)
    return layer


def patches(channels: int) -> nn.Sequential:
    """The pixels' first convolution: stride 4, patches that overlap by 1 px a side.

    Two convolutions of stride 2 see no more and take longer: the first is bound by memory, not by arithmetic.
    """
    return nn.Sequential(nn.Conv2d(3, channels, 6, 4, 1, bias=False), nn.BatchNorm2d(channels), nn.ReLU(inplace=True))


class Residual(nn.Module):
    """Darknet's residual block: 1x1 to half the channels, 3x3 back, added."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.body = nn.Sequential(conv(channels, channels // 2, 1), conv(channels // 2, channels))

    def forward(self, x: Tensor) -> Tensor:
        """Same shape in and out."""
        return x + self.body(x)


def stage(cin: int, cout: int, residuals: int) -> nn.Sequential:
    """Halve the resolution, then ``residuals`` residual blocks."""
    return nn.Sequential(conv(cin, cout, 3, 2), *(Residual(cout) for _ in range(residuals)))


def start_with_rare_objects(bias: Tensor, fields: int) -> None:
    """Set the objectness of a head's bias (A * fields,) low in place.

    Vehicles cover a few cells of a few thousand: otherwise the first steps only unlearn them.
    """
    with torch.no_grad():
        bias.view(-1, fields)[:, 4] = _PRIOR_OBJECTNESS_LOGIT


def parameter_count(net: nn.Module) -> int:
    """Number of trained values."""
    return sum(p.numel() for p in net.parameters())
