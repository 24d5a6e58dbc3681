"""The edge detector: the backbone and neck of NanoDet-g, three scales of three anchors (YOLOv3's plan, small)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from models_export.nets.blocks import Normalise, conv, halving, projection, start_with_rare_objects
from service.nets.decoding import BOX_FIELDS


@dataclass(frozen=True)
class DetectorConfig:
    """Shape of the detector. As it stands it takes the public weights of NanoDet-g (``train/nanodet_start.py``)."""

    classes: tuple[str, ...] = ("car", "van", "truck", "bus")
    strides: tuple[int, int, int] = (8, 16, 32)
    anchors_px: tuple[tuple[tuple[float, float], ...], ...] = (
        ((14.0, 9.0), (22.0, 14.0), (36.0, 18.0)),
        ((34.0, 28.0), (60.0, 30.0), (62.0, 52.0)),
        ((104.0, 50.0), (120.0, 90.0), (200.0, 110.0)),
    )
    """Per stride, (width, height) of each anchor, px; k-means of the training boxes replaces these."""
    max_width: int = 672
    """Widest image that the detector is given, px."""
    width: int = 32
    """Channels of the stem; the four stages, at strides 4, 8, 16, 32, give 2, 4, 8, 16 times as many."""
    blocks: tuple[int, int, int, int] = (1, 2, 2, 3)
    """Inner blocks of the stages."""
    neck: int = 128
    """Channels of the neck and of the heads' hidden maps."""


class InnerBlock(nn.Module):
    """Two convolutions of half the channels, the second behind the first, both kept."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = conv(channels, channels // 2)
        self.second = conv(channels // 2, channels // 2)

    def forward(self, x: Tensor) -> Tensor:
        """Same shape in and out."""
        x = self.first(x)
        return torch.cat([self.second(x), x], 1)


class PartialStage(nn.Module):
    """A convolution, inner blocks behind it, one more convolution, and the first's map beside the last's.

    Cross-stage partial connections (Wang et al., 2020), as NanoDet-g has them.
    """

    def __init__(self, channels: int, blocks: int, stride: int) -> None:
        super().__init__()
        self.first = conv(channels, channels, 3, stride)
        self.inner = nn.Sequential(*(InnerBlock(channels) for _ in range(blocks)))
        self.last = conv(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to (B, 2 C, H / stride, W / stride)."""
        x = self.first(x)
        return torch.cat([self.last(self.inner(x)), x], 1)


class EdgeDetector(nn.Module):
    """uint8 canvases (B, H, W, 3) to three heads of logits (B, A * (5 + C), H / s, W / s)."""

    def __init__(self, config: DetectorConfig) -> None:
        super().__init__()
        self.config = config
        width, neck = config.width, config.neck
        self.normalise = Normalise()
        self.stem = conv(3, width, 3, 2)
        self.pool = nn.MaxPool2d(3, 2, 1)
        self.stage4, self.stage8, self.stage16, self.stage32 = (
            PartialStage(width * 2**level, blocks, 1 if level == 0 else 2) for level, blocks in enumerate(config.blocks)
        )
        self.lateral8, self.lateral16, self.lateral32 = (projection(width * 2**level, neck) for level in (2, 3, 4))
        self.up = nn.Upsample(scale_factor=2, mode="nearest")
        self.down = halving(neck)
        out = len(config.anchors_px[0]) * (BOX_FIELDS + len(config.classes))
        self.heads = nn.ModuleList(nn.Sequential(conv(neck, neck), nn.Conv2d(neck, out, 1)) for _ in config.strides)
        for head in self.heads:
            start_with_rare_objects(head[-1].bias, BOX_FIELDS + len(config.classes))  # type: ignore[index]

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Heads at strides 8, 16, 32; H and W are multiples of 32."""
        f8 = self.stage8(self.stage4(self.pool(self.stem(self.normalise(images)))))
        f16 = self.stage16(f8)
        p32 = self.lateral32(self.stage32(f16))
        p16 = self.lateral16(f16) + self.up(p32)
        p8 = self.lateral8(f8) + self.up(p16)
        p16 = p16 + self.down(p8)
        p32 = p32 + self.down(p16)
        return self.heads[0](p8), self.heads[1](p16), self.heads[2](p32)
