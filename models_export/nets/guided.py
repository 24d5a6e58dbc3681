"""The depth-guided detector at two sizes: the paper's (D4LCN on two ResNet-50 branches) and the edge's.

Both take uint8 canvases and guide maps (``service.nets.guided.guide_maps``), filter image features by depth features, and give
the same heads, which ``service.nets.guided.decode_guided`` reads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models_export.nets.blocks import Normalise, conv, stage
from models_export.nets.filtering import DepthGuidedConvolution, LightGuidedConvolution
from models_export.nets.resnet import CHANNELS, ResNet50

OUTPUTS = ("scores", "boxes_2d", "boxes_3d", "headings", "log_variances")
"""Names of the heads; the last only where sigmas are learned."""
# Vehicles cover a few anchors of thousands: start with the background, or the first steps only unlearn the rest.
_PRIOR_BACKGROUND_LOGIT = 4.6
_IMAGENET_MEAN, _IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class GuidedConfig:
    """Shape of a depth-guided detector; the defaults are the edge's."""

    classes: tuple[str, ...] = ("car",)
    max_width: int = 672
    """Widest image that the detector is given, px."""
    stride: int = 8
    """Canvas pixels a cell of the anchors' grid; fixed by the trunk's plan."""
    anchor_heights_px: tuple[float, ...] = (9.0, 15.0, 25.0, 42.0, 70.0)
    anchor_ratios: tuple[float, ...] = (1.1, 2.2)
    """Width over height."""
    focal_px: float = 400.0
    """Depths are learned as those of a camera of this focal length; 0: as they are."""
    log_depth: bool = True
    """Depth as a ratio to the anchor's; False: as a difference, as published."""
    bin_centers_rad: tuple[float, ...] = (0.0, math.pi)
    """Bins of the heading; none: a difference to the anchor's mean alpha, as published."""
    guides: tuple[str, ...] = ("depth", "ground")
    guide_stride: int = 8
    learned_sigma: bool = True
    """Whether the network gives log variances of its 3D outputs."""
    channels: tuple[int, ...] = (12, 24, 48, 96, 128)
    """Of the edge trunk after its stem and stages (strides 2, 4, 8, 16, 32)."""
    neck: int = 40
    """Channels of the edge neck."""

    @property
    def anchors_px(self) -> tuple[tuple[float, float], ...]:
        """(width, height) of each anchor."""
        return tuple((round(h * ratio, 3), round(h, 3)) for h in self.anchor_heights_px for ratio in self.anchor_ratios)

    @property
    def heading_fields(self) -> int:
        """Channels of an anchor's heading."""
        return 3 * len(self.bin_centers_rad) or 1


PAPER = GuidedConfig(
    max_width=1284,
    stride=16,
    anchor_heights_px=tuple(32.0 * 1.2535**i for i in range(12)),
    anchor_ratios=(0.5, 1.0, 1.5),
    focal_px=0.0,
    log_depth=False,
    bin_centers_rad=(),
    guides=("depth",),
    learned_sigma=False,
)
"""D4LCN's configuration: 36 anchors, differences to their priors, no learned sigma."""


class GuidedHeads(nn.Module):
    """1x1 convolutions to the outputs of every anchor."""

    def __init__(self, cin: int, config: GuidedConfig) -> None:
        super().__init__()
        fields = [1 + len(config.classes), 4, 6, config.heading_fields] + [7] * config.learned_sigma
        self.heads = nn.ModuleList(nn.Conv2d(cin, len(config.anchors_px) * n, 1) for n in fields)
        for head in self.heads:
            nn.init.normal_(head.weight, std=0.01)  # type: ignore[arg-type]
            nn.init.zeros_(head.bias)  # type: ignore[arg-type]
        with torch.no_grad():
            self.heads[0].bias.view(-1, fields[0])[:, 0] = _PRIOR_BACKGROUND_LOGIT  # type: ignore[operator]

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        """(B, cin, h, w) to the tensors of ``OUTPUTS``, each (B, A * F, h, w)."""
        return tuple(head(x) for head in self.heads)


class GuideInput(nn.Module):
    """Guide maps (B, G, h, w), 1 / metres, less their mean over their deviation.

    Both are measured on the training data's own maps (``measure``) and travel with the weights: a fixed normalisation would
    not match its source.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, guides: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(1, guides, 1, 1))
        self.register_buffer("std", torch.ones(1, guides, 1, 1))

    def measure(self, maps: Tensor) -> None:
        """Take mean and deviation from maps (N, G, h, w)."""
        self.mean.copy_(maps.mean((0, 2, 3), keepdim=True))
        self.std.copy_(maps.std((0, 2, 3), keepdim=True).clamp(min=1e-6))

    def forward(self, maps: Tensor) -> Tensor:
        """Same shape in and out."""
        return (maps - self.mean) / self.std


class EdgeGuided(nn.Module):
    """The edge size: a small trunk whose features at strides 8, 16 and 32 are filtered by those of the guide maps.

    Plain convolutions and ReLU; about 2 GFLOP for four 672x192 canvases.
    """

    def __init__(self, config: GuidedConfig) -> None:
        super().__init__()
        self.config = config
        c2, c4, c8, c16, c32 = config.channels
        neck = config.neck
        self.normalise = Normalise()
        self.guide = GuideInput(len(config.guides))
        self.stem = nn.Sequential(conv(3, c2, 3, 2), conv(c2, c4, 3, 2))
        self.stage8, self.stage16, self.stage32 = stage(c4, c8, 1), stage(c8, c16, 1), stage(c16, c32, 1)
        self.guide8 = nn.Sequential(conv(len(config.guides), c4), conv(c4, c8, 1))
        self.guide16, self.guide32 = conv(c8, c16, 3, 2), conv(c16, c32, 1, 2)
        self.filter8, self.filter16 = LightGuidedConvolution(c8), LightGuidedConvolution(c16)
        self.lateral8, self.lateral16, self.lateral32 = (conv(c, neck, 1) for c in (c8 + c8, c16, c32))
        self.upsample = nn.Upsample(scale_factor=2, mode="nearest")
        self.merge16, self.merge8 = conv(neck, neck), conv(neck, neck)
        self.heads = GuidedHeads(neck, config)

    def forward(self, images: Tensor, guides: Tensor) -> tuple[Tensor, ...]:
        """Canvases (B, H, W, 3) uint8 and maps (B, G, H / 8, W / 8) to the heads at stride 8; H, W multiples of 32."""
        g8 = self.guide8(self.guide(guides))
        g16 = self.guide16(g8)
        f8 = self.filter8(self.stage8(self.stem(self.normalise(images))), g8)
        f16 = self.filter16(self.stage16(f8), g16)
        f32 = self.stage32(f16) * self.guide32(g16)
        p16 = self.merge16(self.lateral16(f16) + self.upsample(self.lateral32(f32)))
        p8 = self.merge8(self.lateral8(torch.cat([f8, g8], 1)) + self.upsample(p16))
        return self.heads(p8)


class ResNetGuided(nn.Module):
    """The published size: ResNet-50 for the image, the first three stages of another for the depth map.

    After stages 2 and 3 the image features go through a depth-guided convolution; after stage 4, whose stride is taken for
    dilation, they are multiplied by the depth features, which a 1x1 convolution brings to as many channels (the filter branch
    has no fourth stage). Inputs of one size only.
    """

    def __init__(self, config: GuidedConfig, width: int = 512, dropout: float = 0.5, channel_dropout: float = 0.3) -> None:
        super().__init__()
        self.config = config
        self.guide = GuideInput(len(config.guides))
        self.image = ResNet50(dilate_last=True)
        self.depth = ResNet50(stages=3)
        self.filter2, self.filter3 = DepthGuidedConvolution(CHANNELS[1]), DepthGuidedConvolution(CHANNELS[2])
        self.widen = conv(CHANNELS[2], CHANNELS[3], 1)
        self.channel_dropout, self.dropout = nn.Dropout2d(channel_dropout), nn.Dropout(dropout)
        self.features = nn.Conv2d(CHANNELS[3], width, 3, padding=1)
        self.heads = GuidedHeads(width, config)
        self.register_buffer("pixel_mean", 255.0 * torch.tensor(_IMAGENET_MEAN).view(1, 3, 1, 1))
        self.register_buffer("pixel_std", 255.0 * torch.tensor(_IMAGENET_STD).view(1, 3, 1, 1))

    def forward(self, images: Tensor, guides: Tensor) -> tuple[Tensor, ...]:
        """Canvases (B, H, W, 3) uint8 and maps (B, 1, H / s, W / s) to the heads at stride 16; H, W multiples of 16."""
        x = (images.permute(0, 3, 1, 2).float() - self.pixel_mean) / self.pixel_std
        d = F.interpolate(self.guide(guides), size=x.shape[-2:], mode="bilinear", align_corners=False)
        x, d = self.image.stem(x), self.depth.stem(d.expand(-1, 3, -1, -1))
        x, d = self.image.layer2(self.image.layer1(x)), self.depth.layer2(self.depth.layer1(d))
        x = self.channel_dropout(self.filter2(x, d))
        x, d = self.image.layer3(x), self.depth.layer3(d)
        x = self.image.layer4(self.filter3(x, d)) * self.widen(d)
        return self.heads(F.relu(self.features(self.dropout(x))))
