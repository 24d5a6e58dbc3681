"""The edge detector: a Darknet-like backbone, a top-down path, three scales of three anchors (YOLOv3's plan, small)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn

from models_export.nets.blocks import Normalise, conv, patches, stage, start_with_rare_objects
from service.nets.decoding import BOX_FIELDS


@dataclass(frozen=True)
class DetectorConfig:
    """Shape of the detector."""

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
    channels: tuple[int, int, int, int] = (32, 64, 128, 256)
    """Channels after the stem and after each stage (strides 4, 8, 16, 32)."""
    residuals: tuple[int, int, int] = (2, 3, 2)
    """Residual blocks of the stages at strides 8, 16, 32."""


class EdgeDetector(nn.Module):
    """uint8 canvases (B, H, W, 3) to three heads of logits (B, A * (5 + C), H / s, W / s)."""

    def __init__(self, config: DetectorConfig) -> None:
        super().__init__()
        self.config = config
        c4, c8, c16, c32 = config.channels
        self.normalise = Normalise()
        self.stem = patches(c4)
        self.stage8 = stage(c4, c8, config.residuals[0])
        self.stage16 = stage(c8, c16, config.residuals[1])
        self.stage32 = stage(c16, c32, config.residuals[2])
        neck = c8
        self.lateral32 = conv(c32, neck, 1)
        self.lateral16 = conv(c16, neck, 1)
        self.lateral8 = conv(c8, neck, 1)
        self.upsample = nn.Upsample(scale_factor=2, mode="nearest")
        self.merge16 = conv(neck, neck)
        self.merge8 = conv(neck, neck)
        out = len(config.anchors_px[0]) * (BOX_FIELDS + len(config.classes))
        self.heads = nn.ModuleList(nn.Sequential(conv(neck, width), nn.Conv2d(width, out, 1)) for width in (neck, 96, 128))
        for head in self.heads:
            start_with_rare_objects(head[-1].bias, BOX_FIELDS + len(config.classes))  # type: ignore[index]

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Heads at strides 8, 16, 32; H and W are multiples of 32."""
        f8 = self.stage8(self.stem(self.normalise(images)))
        f16 = self.stage16(f8)
        f32 = self.stage32(f16)
        p32 = self.lateral32(f32)
        p16 = self.merge16(self.lateral16(f16) + self.upsample(p32))
        p8 = self.merge8(self.lateral8(f8) + self.upsample(p16))
        return self.heads[0](p8), self.heads[1](p16), self.heads[2](p32)
