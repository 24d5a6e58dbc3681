"""Depth-guided filtering: depth features as the kernels of a convolution over image features (D4LCN's DLCN).

The product D * X of depth and image features, summed over a neighbourhood, is a convolution whose kernel at every pixel and
channel is the depth feature there. Shift pooling lets neighbouring channels see each other; dilations 1..3, weighted per
channel by what the picture as a whole looks like, stand for receptive fields that depend on the scene.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

DILATIONS = (1, 2, 3)
SHIFTS = 3
"""Channels that shift pooling averages: each with the two before it."""
_TAPS = 9


def shift_pool(x: Tensor) -> Tensor:
    """X' = (X + shift_1(X) + shift_2(X)) / 3 over the channels, cyclically: (B, C, H, W) in and out."""
    shifted = [torch.cat([x[:, -n:], x[:, :-n]], 1) for n in range(1, SHIFTS)]
    return torch.stack([x, *shifted]).sum(0) / SHIFTS


def local_filter(product: Tensor, dilation: int) -> Tensor:
    """Mean of ``product`` (B, C, H, W) over its 3x3 neighbours ``dilation`` apart, mirrored at the border."""
    rows, columns = product.shape[-2:]
    padded = F.pad(product, (dilation,) * 4, mode="reflect")
    steps = (0, dilation, 2 * dilation)
    total = torch.zeros_like(product)
    for down in steps:
        for right in steps:
            total = total + padded[..., down : down + rows, right : right + columns]
    return total / _TAPS


def pool_3x3(x: Tensor) -> Tensor:
    """Adaptive max pooling (B, C, H, W) to (B, C, 3, 3), in operators that ONNX has; H and W of a traced graph are fixed."""
    rows, columns = ([slice(size * i // 3, -(-size * (i + 1) // 3)) for i in range(3)] for size in x.shape[-2:])
    return torch.stack([torch.stack([x[..., r, c].amax((2, 3)) for c in columns], -1) for r in rows], -2)


class DepthGuidedConvolution(nn.Module):
    """DLCN with adaptive dilation, as published: ReLU(BN(sum over r of w_r * mean over offsets of D * X')).

    The map must be larger than the largest dilation. A traced graph takes one input size only, for the adaptive pooling.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weights = nn.Conv2d(channels, channels * len(DILATIONS), 3)
        self.norm = nn.BatchNorm2d(channels)

    def forward(self, x: Tensor, depth: Tensor) -> Tensor:
        """Image features and depth features (B, C, H, W) to filtered image features of the same shape."""
        weights = self.weights(pool_3x3(x)).unflatten(1, (-1, len(DILATIONS))).softmax(2)
        product = depth * shift_pool(x)
        filtered = [local_filter(product, r) * weights[:, :, k] for k, r in enumerate(DILATIONS)]
        return F.relu(self.norm(torch.stack(filtered).sum(0)))


class LightGuidedConvolution(nn.Module):
    """The same principle for small networks and any size: ReLU(X + BN(sum over r of w_r * filter_r(D * X'))).

    The filters are depthwise and start as the mean; weights come from the picture's strongest responses; the image features are
    added, so that a map without depth does not silence them.
    """

    def __init__(self, channels: int, dilations: Sequence[int] = DILATIONS) -> None:
        super().__init__()
        self.filters = nn.ModuleList(
            nn.Conv2d(channels, channels, 3, padding=r, dilation=r, groups=channels, bias=False) for r in dilations
        )
        for layer in self.filters:
            nn.init.constant_(layer.weight, 1.0 / _TAPS)  # type: ignore[arg-type]
        self.weights = nn.Conv2d(channels, channels * len(dilations), 1)
        self.norm = nn.BatchNorm2d(channels)

    def forward(self, x: Tensor, depth: Tensor) -> Tensor:
        """Image features and depth features (B, C, H, W) to filtered image features of the same shape."""
        batch, channels = x.shape[:2]
        weights = self.weights(x.amax((2, 3), keepdim=True)).reshape(batch, channels, len(self.filters), 1, 1).softmax(2)
        product = depth * shift_pool(x)
        filtered = [layer(product) * weights[:, :, k] for k, layer in enumerate(self.filters)]
        return F.relu(x + self.norm(torch.stack(filtered).sum(0)))
