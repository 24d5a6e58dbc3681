"""The edge depth net: a convolutional stem, self-attention over its 1/32 grid, a light decoder (DPT's plan, small)."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from models_export.nets.blocks import Normalise, conv

_POOLED = 4


@dataclass(frozen=True)
class DepthConfig:
    """Shape of the depth net."""

    stem: tuple[int, int, int] = (24, 48, 96)
    """Channels at strides 8, 16, 32 of the canvas."""
    width: int = 96
    """Channels of a token."""
    blocks: int = 2
    heads: int = 4
    mlp_ratio: int = 2
    decoder: int = 24
    """Channels of the decoder."""
    stride: int = 16
    """Canvas pixels an output cell; fixed by the decoder's plan."""


class Attention(nn.Module):
    """Multi-head self-attention; spelled out, so that the exported graph is plain MatMul and Softmax of dynamic length."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads, self.head_width = heads, width // heads
        self.qkv = nn.Linear(width, 3 * width)
        self.project = nn.Linear(width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, N, width) in and out."""
        batch, count, width = tokens.shape
        q, k, v = self.qkv(tokens).reshape(batch, count, 3, self.heads, self.head_width).permute(2, 0, 3, 1, 4).unbind(0)
        weights = torch.softmax((q * self.head_width**-0.5) @ k.transpose(-2, -1), dim=-1)
        return self.project((weights @ v).transpose(1, 2).reshape(batch, count, width))


class Block(nn.Module):
    """A pre-norm transformer block."""

    def __init__(self, width: int, heads: int, mlp_ratio: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attention = Attention(width, heads)
        self.mlp = nn.Sequential(nn.Linear(width, mlp_ratio * width), nn.GELU(), nn.Linear(mlp_ratio * width, width))

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, N, width) in and out."""
        tokens = tokens + self.attention(self.norm1(tokens))
        return tokens + self.mlp(self.norm2(tokens))


class EdgeDepth(nn.Module):
    """uint8 canvases (B, H, W, 3) to affine-invariant inverse depth (B, H / 16, W / 16).

    Positions enter through a zero-padded depth-wise convolution over the token grid, so any canvas size fits one graph.
    """

    def __init__(self, config: DepthConfig) -> None:
        super().__init__()
        self.config = config
        c8, c16, c32 = config.stem
        d = config.decoder
        self.normalise = Normalise()
        # A picture of a quarter the size is enough for depth, and pooling is the cheapest way to it.
        self.stem8 = nn.Sequential(nn.AvgPool2d(_POOLED), conv(3, c8, 3, 2))
        self.stem16 = nn.Sequential(conv(c8, c16, 3, 2), conv(c16, c16))
        self.stem32 = conv(c16, c32, 3, 2)
        self.embed = nn.Conv2d(c32, config.width, 1)
        self.position = nn.Conv2d(config.width, config.width, 5, padding=2, groups=config.width)
        self.blocks = nn.ModuleList(Block(config.width, config.heads, config.mlp_ratio) for _ in range(config.blocks))
        self.norm = nn.LayerNorm(config.width)
        self.upsample = nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False)
        self.from32 = nn.Conv2d(config.width, d, 1)
        self.from16, self.fuse16 = nn.Conv2d(c16, d, 1), conv(d, d)
        self.head = nn.Conv2d(d, 1, 3, padding=1)

    def with_folded_pooling(self) -> EdgeDepth:
        """A copy in which the pooling is part of the first convolution, with the same outputs: for export.

        Pooling over uint8 pixels is slow where a convolution is fast. A 3x3 kernel of stride 2 over 4x4 means is a 12x12 kernel
        of stride 8 whose taps are a sixteenth each.
        """
        folded = deepcopy(self)
        first = folded.stem8[1][0]
        wide = nn.Conv2d(first.in_channels, first.out_channels, 3 * _POOLED, 2 * _POOLED, _POOLED, bias=False)
        taps = first.weight.detach().repeat_interleave(_POOLED, 2).repeat_interleave(_POOLED, 3)
        wide.weight = nn.Parameter(taps / _POOLED**2)
        folded.stem8[0], folded.stem8[1][0] = nn.Identity(), wide
        return folded

    def forward(self, images: Tensor) -> Tensor:
        """H and W are multiples of 32."""
        f16 = self.stem16(self.stem8(self.normalise(images)))
        grid = self.embed(self.stem32(f16))
        grid = grid + self.position(grid)
        batch, width, rows, columns = grid.shape
        tokens = grid.reshape(batch, width, rows * columns).transpose(1, 2)
        for block in self.blocks:
            tokens = block(tokens)
        grid = self.norm(tokens).transpose(1, 2).reshape(batch, width, rows, columns)
        x = self.fuse16(self.upsample(self.from32(grid)) + self.from16(f16))
        return self.head(x).squeeze(1)
