"""YOLOv3 and YOLOv3-tiny (Redmon and Farhadi 2018), described once as Darknet's list of layers.

Modules, channels, strides and the order of the weights in Darknet's files all follow from that list. Layers are counted as
Darknet counts them, from 0, routes and shortcuts included: YOLOv3 has 107, of which 75 are convolutions.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from models_export.nets.blocks import start_with_rare_objects
from service.nets.decoding import BOX_FIELDS

_LEAK = 0.1
_STAGE_FILTERS = (64, 128, 256, 512, 1024)
"""Channels of Darknet-53's stages, at strides 2 to 32."""
RESIDUALS = (1, 2, 8, 8, 4)
"""Residual blocks of Darknet-53's stages."""
BACKBONE_CONVOLUTIONS = 1 + sum(1 + 2 * blocks for blocks in RESIDUALS)
"""Convolutions of Darknet-53 without its classifier: what ``darknet53.conv.74`` holds."""


@dataclass(frozen=True)
class Conv:
    """Convolution without bias, batch norm, leaky ReLU; "same" padding."""

    filters: int
    size: int
    stride: int = 1


@dataclass(frozen=True)
class Predict:
    """1x1 convolution with bias to the logits of one scale."""


@dataclass(frozen=True)
class Output:
    """Darknet's ``yolo`` layer: what comes in is a head."""


@dataclass(frozen=True)
class Shortcut:
    """Adds the layer three back."""


@dataclass(frozen=True)
class MaxPool:
    """2x2; at stride 1 the picture's last column and row are repeated, so that the size stays."""

    stride: int


@dataclass(frozen=True)
class Route:
    """The channels of other layers, one after another; negative numbers count back from here."""

    layers: tuple[int, ...]


@dataclass(frozen=True)
class Upsample:
    """Twice the size, nearest neighbour."""


Layer = Conv | Predict | Output | Shortcut | MaxPool | Route | Upsample


def yolov3_layers(residuals: tuple[int, ...] = RESIDUALS) -> tuple[Layer, ...]:
    """YOLOv3's layers: Darknet-53, then three outputs, each beside a finer stage of the backbone than the one before."""
    layers: list[Layer] = [Conv(32, 3)]
    ends = []
    for filters, blocks in zip(_STAGE_FILTERS, residuals, strict=True):
        layers += [Conv(filters, 3, 2), *[Conv(filters // 2, 1), Conv(filters, 3), Shortcut()] * blocks]
        ends.append(len(layers) - 1)
    layers += _output_after(512)
    layers += [*_back_beside(256, ends[3]), *_output_after(256)]
    layers += [*_back_beside(128, ends[2]), *_output_after(128)]
    return tuple(layers)


def yolov3_tiny_layers() -> tuple[Layer, ...]:
    """YOLOv3-tiny's layers: convolutions with poolings between them, then two outputs."""
    layers: list[Layer] = [Conv(16, 3)]
    for filters in (32, 64, 128, 256):
        layers += [MaxPool(2), Conv(filters, 3)]
    fine = len(layers) - 1
    layers += [MaxPool(2), Conv(512, 3), MaxPool(1), Conv(1024, 3), Conv(256, 1), Conv(512, 3), Predict(), Output()]
    return (*layers, *_back_beside(128, fine), Conv(256, 3), Predict(), Output())


def _output_after(filters: int) -> list[Layer]:
    """The convolutions before and at one of YOLOv3's outputs."""
    return [*[Conv(filters, 1), Conv(2 * filters, 3)] * 3, Predict(), Output()]


def _back_beside(filters: int, layer: int) -> list[Layer]:
    """From an output back to its trunk, twice as fine, beside a layer of the backbone."""
    return [Route((-4,)), Conv(filters, 1), Upsample(), Route((-1, layer))]


@dataclass(frozen=True)
class Yolov3Config:
    """Shape of the detector. :func:`tiny_config` gives YOLOv3-tiny's."""

    classes: tuple[str, ...] = ("car",)
    strides: tuple[int, ...] = (8, 16, 32)
    """Finest first."""
    anchors_px: tuple[tuple[tuple[float, float], ...], ...] = (
        ((10.0, 13.0), (16.0, 30.0), (33.0, 23.0)),
        ((30.0, 61.0), (62.0, 45.0), (59.0, 119.0)),
        ((116.0, 90.0), (156.0, 198.0), (373.0, 326.0)),
    )
    """Per stride, (width, height) of each anchor, px. These are COCO's; k-means of the training boxes replaces them."""
    max_width: int = 672
    """Widest image that the detector is given, px."""
    width: float = 1.0
    """Factor on the channels of every layer but the outputs. The published networks have 1."""
    residuals: tuple[int, ...] = RESIDUALS
    """Residual blocks of the backbone's stages; YOLOv3-tiny has none."""

    @property
    def layers(self) -> tuple[Layer, ...]:
        """Darknet's layers."""
        return yolov3_layers(self.residuals) if self.residuals else yolov3_tiny_layers()

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the heads, finest first."""
        return tuple(f"p{stride}" for stride in self.strides)


def tiny_config(classes: tuple[str, ...] = ("car",), max_width: int = 416) -> Yolov3Config:
    """YOLOv3-tiny with the anchors that its public COCO weights were trained with.

    Those are the second to fourth for the finer scale, although Darknet's own cfg names the first to third.
    """
    anchors = (((23.0, 27.0), (37.0, 58.0), (81.0, 82.0)), ((81.0, 82.0), (135.0, 169.0), (344.0, 319.0)))
    return Yolov3Config(classes=classes, strides=(16, 32), anchors_px=anchors, max_width=max_width, residuals=())


class ConvBlock(nn.Sequential):
    """One of Darknet's convolutions: batch-normalised and leaky, or with a bias and nothing else."""

    def __init__(self, cin: int, cout: int, size: int, stride: int = 1, *, linear: bool = False) -> None:
        parts: list[nn.Module] = [nn.Conv2d(cin, cout, size, stride, size // 2, bias=linear)]
        if not linear:
            parts += [nn.BatchNorm2d(cout), nn.LeakyReLU(_LEAK, inplace=True)]
        super().__init__(*parts)

    @property
    def conv(self) -> nn.Conv2d:
        """The convolution itself."""
        conv = self[0]
        assert isinstance(conv, nn.Conv2d)
        return conv

    @property
    def norm(self) -> nn.BatchNorm2d | None:
        """The batch norm; None for a linear convolution."""
        norm = self[1] if len(self) > 1 else None
        assert norm is None or isinstance(norm, nn.BatchNorm2d)
        return norm


class Yolov3(nn.Module):
    """uint8 canvases (B, H, W, 3) RGB to one head of logits (B, A * (5 + C), H / s, W / s) a stride, finest first."""

    def __init__(self, config: Yolov3Config) -> None:
        super().__init__()
        self.config = config
        fields = BOX_FIELDS + len(config.classes)
        channels: list[int] = []
        modules: list[nn.Module] = []
        for layer in config.layers:
            cin = channels[-1] if channels else 3
            out = len(config.anchors_px[0]) * fields
            modules.append(_module(layer, cin, out, config.width))
            channels.append(_channels(layer, channels, out, config.width))
        self.steps = nn.ModuleList(modules)
        for layer, step in zip(config.layers, self.steps, strict=True):
            if isinstance(layer, Predict):
                start_with_rare_objects(step.conv.bias, fields)  # type: ignore[union-attr, arg-type]

    @property
    def convolutions(self) -> list[ConvBlock]:
        """All convolutions in the order of Darknet's weight files."""
        return [step for step in self.steps if isinstance(step, ConvBlock)]

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        """Heads, finest stride first; H and W are multiples of 32."""
        x = images.permute(0, 3, 1, 2).float() / 255.0
        done: list[Tensor] = []
        heads: list[Tensor] = []
        for layer, step in zip(self.config.layers, self.steps, strict=True):
            if isinstance(layer, Shortcut):
                x = x + done[-3]
            elif isinstance(layer, Route):
                x = torch.cat([done[number] for number in layer.layers], 1)
            else:
                x = step(x)
            if isinstance(layer, Output):
                heads.append(x)
            done.append(x)
        return tuple(reversed(heads))


def _module(layer: Layer, cin: int, out: int, width: float) -> nn.Module:
    """What computes a layer; an identity where the network itself does."""
    if isinstance(layer, Conv):
        return ConvBlock(cin, _scaled(layer.filters, width), layer.size, layer.stride)
    if isinstance(layer, Predict):
        return ConvBlock(cin, out, 1, linear=True)
    if isinstance(layer, MaxPool):
        halves = nn.MaxPool2d(2, layer.stride)
        return halves if layer.stride == 2 else nn.Sequential(nn.ReplicationPad2d((0, 1, 0, 1)), halves)
    return nn.Upsample(scale_factor=2, mode="nearest") if isinstance(layer, Upsample) else nn.Identity()


def _channels(layer: Layer, before: list[int], out: int, width: float) -> int:
    """Channels that a layer gives."""
    if isinstance(layer, Conv):
        return _scaled(layer.filters, width)
    if isinstance(layer, Route):
        return sum(before[number] for number in layer.layers)
    return out if isinstance(layer, Predict) else before[-1]


def _scaled(filters: int, width: float) -> int:
    return max(round(filters * width), 1)
