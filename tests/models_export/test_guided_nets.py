"""Depth-guided filtering against naive loops, and the two sizes' published or promised shapes."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import nn
from torch.nn import functional as F
from torch.utils.flop_counter import FlopCounterMode

from models_export.nets.blocks import parameter_count
from models_export.nets.filtering import (
    DILATIONS,
    DepthGuidedConvolution,
    LightGuidedConvolution,
    local_filter,
    shift_pool,
)
from models_export.nets.guided import PAPER, EdgeGuided, GuidedConfig, GuideInput, ResNetGuided
from models_export.nets.resnet import ResNet50, load_imagenet
from service.errors import InputError


def mirrored(index: int, size: int) -> int:
    """Reflection without repeating the border: -1 is 1, ``size`` is ``size - 2``."""
    index = abs(index)
    return 2 * (size - 1) - index if index >= size else index


def naive_filter(product: torch.Tensor, dilation: int) -> torch.Tensor:
    out = torch.zeros_like(product)
    _, _, rows, columns = product.shape
    for i in range(rows):
        for j in range(columns):
            for di in (-dilation, 0, dilation):
                for dj in (-dilation, 0, dilation):
                    out[..., i, j] += product[..., mirrored(i + di, rows), mirrored(j + dj, columns)] / 9
    return out


def test_shift_pooling_averages_a_channel_with_the_two_before_it() -> None:
    x = torch.arange(5.0).view(1, 5, 1, 1)
    # Cyclic: channel 0 meets 4 and 3.
    expected = torch.tensor([(0 + 4 + 3) / 3, (1 + 0 + 4) / 3, 1.0, 2.0, 3.0])
    torch.testing.assert_close(shift_pool(x)[0, :, 0, 0], expected)


@pytest.mark.parametrize("dilation", DILATIONS)
def test_the_local_filter_equals_a_naive_loop(dilation: int) -> None:
    product = torch.randn(2, 3, 6, 7, generator=torch.Generator().manual_seed(dilation))
    torch.testing.assert_close(local_filter(product, dilation), naive_filter(product, dilation))


def test_the_guided_convolution_equals_its_formula() -> None:
    torch.manual_seed(0)
    layer = DepthGuidedConvolution(4).eval()
    x, depth = torch.randn(2, 4, 8, 9), torch.randn(2, 4, 8, 9)
    pooled = F.adaptive_max_pool2d(x, 3)
    kernel, bias = layer.weights.weight, layer.weights.bias
    weights = (torch.einsum("bcij,ocij->bo", pooled, kernel) + bias).reshape(2, 4, 3).softmax(2)
    torch.testing.assert_close(weights.sum(2), torch.ones(2, 4))
    summed = sum(naive_filter(depth * shift_pool(x), r) * weights[:, :, k, None, None] for k, r in enumerate(DILATIONS))
    # An untrained batch norm in eval mode divides by sqrt(1 + eps).
    torch.testing.assert_close(layer(x, depth), F.relu(summed / (1 + 1e-5) ** 0.5))


def test_the_light_convolution_starts_as_the_mean_and_keeps_the_image() -> None:
    torch.manual_seed(0)
    layer = LightGuidedConvolution(4).eval()
    x = torch.rand(1, 4, 9, 9)
    torch.testing.assert_close(layer(x, torch.zeros_like(x)), x)
    depth = torch.rand(1, 4, 9, 9)
    product = depth * shift_pool(x)
    weights = layer.weights(x.amax((2, 3), keepdim=True)).reshape(1, 4, 3).softmax(2)
    inner = sum(naive_filter(product, r) * weights[:, :, k, None, None] for k, r in enumerate(DILATIONS))
    middle = (slice(None), slice(None), slice(3, 6), slice(3, 6))
    torch.testing.assert_close(layer(x, depth)[middle], (x + inner / (1 + 1e-5) ** 0.5)[middle])


def test_resnet_50_is_the_published_one() -> None:
    net = ResNet50()
    assert parameter_count(net) == 23_508_032
    assert sum(isinstance(m, nn.Conv2d) for m in net.modules()) == 53
    x = net.stem(torch.zeros(1, 3, 64, 96))
    shapes = []
    for layer in (net.layer1, net.layer2, net.layer3, net.layer4):
        x = layer(x)
        shapes.append(tuple(x.shape[1:]))
    assert shapes == [(256, 16, 24), (512, 8, 12), (1024, 4, 6), (2048, 2, 3)]


def test_a_dilated_last_stage_keeps_the_stride_at_16_and_the_weights() -> None:
    dilated = ResNet50(dilate_last=True)
    assert parameter_count(dilated) == 23_508_032
    assert dilated.layer4(torch.zeros(1, 1024, 4, 6)).shape == (1, 2048, 4, 6)


def test_imagenet_weights_load_into_both_branches(tmp_path: Path) -> None:
    torch.manual_seed(3)
    source = ResNet50().state_dict()
    path = tmp_path / "resnet50.pth"
    torch.save({**source, "fc.weight": torch.zeros(1000, 2048), "fc.bias": torch.zeros(1000)}, path)
    image, depth = ResNet50(dilate_last=True), ResNet50(stages=3)
    load_imagenet((image, depth), path)
    assert torch.equal(image.state_dict()["layer4.2.conv3.weight"], source["layer4.2.conv3.weight"])
    assert torch.equal(depth.state_dict()["layer3.5.bn2.weight"], source["layer3.5.bn2.weight"])
    torch.save({key: value for key, value in source.items() if key != "layer2.0.conv1.weight"}, path)
    with pytest.raises(InputError, match=r"no weight 'layer2\.0\.conv1\.weight'"):
        load_imagenet((image,), path)
    path.write_bytes(b"no weights")
    with pytest.raises(InputError, match="cannot be read"):
        load_imagenet((image,), path)


def test_the_published_size_has_36_anchors_on_a_grid_of_stride_16() -> None:
    assert len(PAPER.anchors_px) == 36
    assert PAPER.anchors_px[0] == (16.0, 32.0)
    assert PAPER.anchors_px[-1][1] == pytest.approx(32 * 1.2535**11, abs=1e-3)
    net = ResNetGuided(PAPER).eval()
    assert parameter_count(net.image) == 23_508_032
    assert parameter_count(net.depth) == 8_543_296
    with torch.inference_mode():
        heads = net(torch.zeros(1, 64, 96, 3, dtype=torch.uint8), torch.zeros(1, 1, 8, 12))
    assert [tuple(head.shape[1:]) for head in heads] == [(36 * 2, 4, 6), (36 * 4, 4, 6), (36 * 6, 4, 6), (36, 4, 6)]


def test_the_edge_size_takes_two_gigaflops_for_four_images() -> None:
    net = EdgeGuided(GuidedConfig()).eval()
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        heads = net(torch.zeros(4, 192, 672, 3, dtype=torch.uint8), torch.zeros(4, 2, 24, 84))
    assert counter.get_total_flops() < 2e9
    assert parameter_count(net) < 1e6
    assert [tuple(head.shape) for head in heads] == [(4, 10 * n, 24, 84) for n in (2, 4, 6, 6, 7)]


def test_guides_are_normalised_by_what_was_measured() -> None:
    maps = 0.05 + 0.02 * torch.randn(8, 2, 6, 6, generator=torch.Generator().manual_seed(1))
    guide = GuideInput(2)
    guide.measure(maps)
    out = guide(maps)
    torch.testing.assert_close(out.mean((0, 2, 3)), torch.zeros(2), atol=1e-4, rtol=0)
    torch.testing.assert_close(out.std((0, 2, 3)), torch.ones(2), atol=1e-4, rtol=0)
    assert "mean" in guide.state_dict()
