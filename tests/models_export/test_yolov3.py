"""YOLOv3's published counts and shapes, and that its parts compute what Darknet's layers do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from models_export.export import to_onnx, with_metadata
from models_export.nets.blocks import parameter_count
from models_export.nets.yolov3 import (
    ConvBlock,
    Layer,
    MaxPool,
    Output,
    Route,
    Shortcut,
    Yolov3,
    Yolov3Config,
    tiny_config,
    yolov3_layers,
    yolov3_tiny_layers,
)
from models_export.verify import require_parity
from service.nets.pack import open_network

COCO = tuple(f"class {number}" for number in range(80))
YOLOV3, YOLOV3_TINY = yolov3_layers(), yolov3_tiny_layers()
SMALL = Yolov3Config(width=0.125, residuals=(1, 1, 1, 1, 1))
SMALL_TINY = replace(tiny_config(), width=0.25)


def on_paper(config: Yolov3Config) -> Yolov3:
    """The network without its memory."""
    with torch.device("meta"):
        return Yolov3(config)


def places(layers: tuple[Layer, ...], kind: type[Layer]) -> list[int]:
    return [number for number, layer in enumerate(layers) if isinstance(layer, kind)]


def test_yolov3_has_the_published_layers() -> None:
    assert len(YOLOV3) == 107
    assert places(YOLOV3, Output) == [82, 94, 106]
    assert {n: layer.layers for n, layer in enumerate(YOLOV3) if isinstance(layer, Route)} == {
        83: (-4,), 86: (-1, 61), 95: (-4,), 98: (-1, 36),
    }  # fmt: skip
    assert len(places(YOLOV3, Shortcut)) == 23
    assert len(on_paper(Yolov3Config()).convolutions) == 75


def test_yolov3_tiny_has_the_published_layers() -> None:
    assert len(YOLOV3_TINY) == 24
    assert places(YOLOV3_TINY, Output) == [16, 23]
    assert [YOLOV3_TINY[n] for n in places(YOLOV3_TINY, Route)] == [Route((-4,)), Route((-1, 8))]
    assert [layer.stride for layer in YOLOV3_TINY if isinstance(layer, MaxPool)] == [2, 2, 2, 2, 2, 1]
    assert len(on_paper(tiny_config()).convolutions) == 13


@pytest.mark.parametrize(
    ("config", "count"),
    [
        (Yolov3Config(classes=COCO), 61_949_149),
        # A class less is three channels of 1024 + 512 + 256 weights and a bias each.
        (Yolov3Config(), 61_949_149 - 79 * 3 * (1024 + 512 + 256 + 3)),
        (tiny_config(COCO), 8_852_366),
    ],
)
def test_parameter_counts(config: Yolov3Config, count: int) -> None:
    assert parameter_count(on_paper(config)) == count


def test_one_class_has_eighteen_channels_at_three_strides() -> None:
    heads = on_paper(Yolov3Config())(torch.zeros(2, 416, 608, 3, dtype=torch.uint8, device="meta"))
    assert [tuple(head.shape) for head in heads] == [(2, 18, 52, 76), (2, 18, 26, 38), (2, 18, 13, 19)]
    heads = on_paper(tiny_config(COCO))(torch.zeros(1, 416, 416, 3, dtype=torch.uint8, device="meta"))
    assert [tuple(head.shape) for head in heads] == [(1, 255, 26, 26), (1, 255, 13, 13)]


def test_pooling_at_stride_one_looks_right_and_down() -> None:
    (number,) = (n for n, layer in enumerate(YOLOV3_TINY) if layer == MaxPool(1))
    pooled = Yolov3(SMALL_TINY).steps[number](torch.tensor([[[[1.0, 2.0], [4.0, 3.0]]]]) - 10)
    assert pooled.tolist() == [[[[-6.0, -7.0], [-6.0, -7.0]]]]


def test_a_convolution_is_normalised_and_leaks() -> None:
    block = ConvBlock(1, 1, 1).eval()
    with torch.no_grad():
        block.conv.weight.fill_(2.0)
    assert block.norm is not None
    block.norm.running_mean.fill_(3.0)  # type: ignore[union-attr]
    block.norm.running_var.fill_(4.0)  # type: ignore[union-attr]
    out = block(torch.tensor([[[[1.0, 5.0]]]]))
    np.testing.assert_allclose(out.detach().numpy().ravel(), [-0.5 * 0.1, 3.5], rtol=1e-4)


def test_onnx_runtime_computes_the_same_at_any_size() -> None:
    torch.manual_seed(0)
    net = Yolov3(SMALL).eval()
    model = to_onnx(net, "detector", (96, 160), SMALL.outputs, dynamic_hw=True)
    rng = np.random.default_rng(1)
    images = [rng.integers(0, 255, shape, dtype=np.uint8) for shape in ((1, 96, 160, 3), (3, 64, 192, 3))]
    require_parity(net, open_network("detector", with_metadata(model, {"format": "yolov3"})), images)
