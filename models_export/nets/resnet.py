"""ResNet-50 as published (He et al., 2016), with the option of a last stage that dilates instead of halving the resolution.

The names of the weights are torchvision's, so that its ImageNet files load as they are.
"""

from __future__ import annotations

import pickle
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from service.errors import InputError

EXPANSION = 4
STAGES = (3, 4, 6, 3)
"""Bottleneck blocks of ResNet-50's four stages."""
WIDTHS = (64, 128, 256, 512)
CHANNELS = tuple(EXPANSION * width for width in WIDTHS)
"""Channels after each stage."""
_CLASSIFIER = "fc."


class Bottleneck(nn.Module):
    """1x1 down, 3x3 (with the stride), 1x1 up, added to the input."""

    def __init__(self, cin: int, width: int, stride: int = 1, dilation: int = 1) -> None:
        super().__init__()
        cout = EXPANSION * width
        self.conv1 = nn.Conv2d(cin, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, dilation, dilation, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, cout, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(cout)
        project = stride != 1 or cin != cout
        self.downsample = (
            nn.Sequential(nn.Conv2d(cin, cout, 1, stride, bias=False), nn.BatchNorm2d(cout)) if project else nn.Identity()
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, cin, H, W) to (B, 4 width, H / stride, W / stride)."""
        y = F.relu(self.bn1(self.conv1(x)))
        y = F.relu(self.bn2(self.conv2(y)))
        return F.relu(self.bn3(self.conv3(y)) + self.downsample(x))


class ResNet50(nn.Module):
    """The first ``stages`` stages, without pooling and classifier. Its user calls ``stem`` and then the layers one by one.

    dilate_last: the fourth stage keeps the resolution and dilates its 3x3 convolutions by 2, so that the stride stays 16.
    """

    def __init__(self, stages: int = 4, *, dilate_last: bool = False) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        cin = 64
        for number in range(stages):
            flat = number == 0 or (number == 3 and dilate_last)
            dilation = 2 if number == 3 and dilate_last else 1
            blocks = [Bottleneck(cin, WIDTHS[number], 1 if flat else 2, dilation)]
            cin = CHANNELS[number]
            blocks += [Bottleneck(cin, WIDTHS[number], 1, dilation) for _ in range(STAGES[number] - 1)]
            self.add_module(f"layer{number + 1}", nn.Sequential(*blocks))

    def stem(self, x: Tensor) -> Tensor:
        """(B, 3, H, W) normalised by ImageNet's mean and deviation to (B, 64, H / 4, W / 4)."""
        y: Tensor = self.maxpool(F.relu(self.bn1(self.conv1(x))))
        return y


def load_imagenet(nets: tuple[ResNet50, ...], path: Path) -> None:
    """Weights of a torchvision ResNet-50 file (``resnet50-*.pth``) into networks, as far as their stages reach.

    Raises InputError when the file cannot be read or lacks a weight.
    """
    try:
        weights = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError) as error:
        raise InputError(
            f"cannot be read: {str(error).splitlines()[0]}", field=str(path), remedy="Give a ResNet-50 state dict (.pth)."
        ) from error
    known = {key: value for key, value in weights.items() if not key.startswith(_CLASSIFIER)}
    for net in nets:
        wanted = net.state_dict()
        missing = sorted(key for key in wanted if key not in known or known[key].shape != wanted[key].shape)
        # Files older than torch 0.4.1 know no batch counters; nothing here reads them.
        missing = [key for key in missing if not key.endswith("num_batches_tracked")]
        if missing:
            raise InputError(f"no weight '{missing[0]}' of the right shape.", field=str(path), remedy="Give a ResNet-50 file.")
        net.load_state_dict({key: known.get(key, value) for key, value in wanted.items()})
