"""Int8 networks written another way give what they gave before."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch
from torch import nn

from models_export.export import to_onnx
from models_export.int8.float_results import multiply_in_int8
from models_export.int8.pixel_reading import read_as_quantized, read_in_groups
from models_export.int8.quantize import for_onnxruntime, quantize
from models_export.int8.upsampling import repeat_cells
from models_export.nets.blocks import Normalise
from models_export.nets.depth import DepthConfig, EdgeDepth
from models_export.nets.detector import DetectorConfig, EdgeDetector
from models_export.nets.multibin import EdgeMultibin, MultibinConfig


class Reader(nn.Module):
    """One convolution of the pixels, and one behind it."""

    def __init__(self, kernel: tuple[int, int], stride: int, pad: tuple[int, int], bias: bool = True) -> None:
        super().__init__()
        self.normalise = Normalise()
        self.first = nn.Conv2d(3, 5, kernel, stride, pad, bias=bias)
        self.second = nn.Conv2d(5, 4, 1)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """(B, H, W, 3) uint8 to (B, 4, h, w)."""
        result: torch.Tensor = self.second(torch.relu(self.first(self.normalise(images))))
        return result


@pytest.fixture
def plain() -> Callable[[nn.Module, np.ndarray, tuple[str, ...]], onnx.ModelProto]:
    """Quantizes, and writes nothing another way but the pixels' conversion."""

    def make(net: nn.Module, images: np.ndarray, outputs: tuple[str, ...]) -> onnx.ModelProto:
        model = to_onnx(net.eval(), "net", images.shape[1:3], outputs, dynamic_hw=images.shape[1] % 32 == 0)
        quantized = onnx.load_from_string(quantize(model, [images], keep_float=outputs))
        read_as_quantized(quantized.graph)
        return quantized

    return make


def pictures(height: int, width: int, batch: int = 3) -> np.ndarray:
    return np.random.default_rng(width).integers(0, 256, (batch, height, width, 3), dtype=np.uint8)


def run(model: onnx.ModelProto, images: np.ndarray) -> list[np.ndarray]:
    onnx.checker.check_model(model, full_check=True)
    return list(ort.InferenceSession(model.SerializeToString()).run(None, {"images": images}))


def kinds(model: onnx.ModelProto) -> list[str]:
    return [node.op_type for node in model.graph.node]


@pytest.mark.parametrize(
    ("kernel", "stride", "pad", "bias"),
    [
        ((3, 3), 2, (1, 1), True),
        ((6, 6), 4, (1, 1), False),
        ((5, 7), 4, (2, 3), True),
        ((2, 2), 2, (0, 0), True),
        ((1, 3), 1, (0, 1), True),
        ((12, 12), 8, (4, 4), True),
        ((3, 9), 2, (0, 4), True),
    ],
)
def test_pixels_read_in_groups_give_the_same_bits(
    plain: Callable[..., onnx.ModelProto], kernel: tuple[int, int], stride: int, pad: tuple[int, int], bias: bool
) -> None:
    torch.manual_seed(stride)
    model = plain(Reader(kernel, stride, pad, bias), pictures(64, 96), ("out",))
    grouped = onnx.ModelProto.FromString(model.SerializeToString())
    read_in_groups(grouped.graph)
    assert kinds(grouped) != kinds(model)
    # Any canvas, not only the one that was calibrated on.
    for images in (pictures(64, 96), pictures(32, 160, 1)):
        before, after = run(model, images), run(grouped, images)
        assert np.ptp(before[0]) > 0
        np.testing.assert_array_equal(after[0], before[0])


@pytest.mark.parametrize(
    ("net", "images"),
    [
        (Reader((3, 3), 2, (0, 0)), pictures(64, 96)),  # one output less than strides
        (Reader((3, 3), 4, (1, 1)), pictures(30, 44)),  # 44 px are five and a half groups
        (nn.Sequential(Normalise(), nn.AvgPool2d(2), nn.Conv2d(3, 4, 3, 2, 1)), pictures(64, 96)),
    ],
)
def test_what_cannot_be_read_in_groups_stays(plain: Callable[..., onnx.ModelProto], net: nn.Module, images: np.ndarray) -> None:
    model = plain(net, images, ("out",))
    before = model.SerializeToString()
    read_in_groups(model.graph)
    assert model.SerializeToString() == before


def test_reading_in_groups_twice_is_reading_in_groups(plain: Callable[..., onnx.ModelProto]) -> None:
    model = plain(Reader((3, 3), 2, (1, 1)), pictures(64, 96), ("out",))
    read_in_groups(model.graph)
    once = model.SerializeToString()
    read_in_groups(model.graph)
    assert model.SerializeToString() == once


def test_a_last_layer_multiplied_in_int8_is_off_by_its_weights_rounding(plain: Callable[..., onnx.ModelProto]) -> None:
    torch.manual_seed(0)
    net, images = Reader((3, 3), 2, (1, 1)), pictures(64, 96)
    model = plain(net, images, ("out",))
    before = run(model, images)[0]
    multiply_in_int8(model.graph, ("out",))
    after = run(model, images)[0]
    assert kinds(model)[-1] == "Transpose"
    assert after.shape == before.shape
    with torch.no_grad():
        hidden = torch.relu(net.first(net.normalise(torch.from_numpy(images)))).amax().item()
    step = net.second.weight.detach().abs().amax().item() / 127
    assert 0 < np.abs(after - before).max() <= 0.5 * step * net.second.in_channels * hidden * 1.05


@pytest.mark.parametrize("outputs", [16, 27])
def test_products_have_whole_blocks_of_columns(plain: Callable[..., onnx.ModelProto], outputs: int) -> None:
    """ONNX Runtime before 1.25 computes garbage on processors with AMX where they have not."""
    torch.manual_seed(0)
    net, images = Reader((3, 3), 2, (1, 1)), pictures(64, 96)
    net.second = nn.Conv2d(net.second.in_channels, outputs, 1)
    model = plain(net, images, ("out",))
    multiply_in_int8(model.graph, ("out",))
    (product,) = (node for node in model.graph.node if node.op_type == "MatMul")
    assert run(model, images)[0].shape[1] == outputs
    del model.graph.output[:]
    model.graph.output.append(onnx.helper.make_tensor_value_info(product.input[1], onnx.TensorProto.FLOAT, ["a", "b"]))
    factors = run(model, images)[0]
    assert factors.shape[1] == 16 * -(-outputs // 16)
    assert not factors[:, outputs:].any()


def test_doubled_cells_are_the_same_bits(plain: Callable[..., onnx.ModelProto]) -> None:
    torch.manual_seed(0)
    net, images = EdgeDetector(DetectorConfig(width=8, blocks=(1, 1, 1, 1), neck=16)), pictures(64, 96)
    model = plain(net, images, ("p8", "p16", "p32"))
    copied = onnx.ModelProto.FromString(model.SerializeToString())
    repeat_cells(copied.graph)
    assert kinds(model).count("Resize") == 2
    assert "Resize" not in kinds(copied)
    for pixels in (images, pictures(96, 64, 1)):
        for before, after in zip(run(model, pixels), run(copied, pixels), strict=True):
            np.testing.assert_array_equal(after, before)


def test_smooth_upsampling_stays(plain: Callable[..., onnx.ModelProto]) -> None:
    net = nn.Sequential(
        Normalise(), nn.Conv2d(3, 4, 3, 2, 1), nn.UpsamplingBilinear2d(scale_factor=2), nn.Conv2d(4, 4, 1), nn.Conv2d(4, 2, 1)
    )
    model = plain(net, pictures(64, 96), ("out",))
    before = model.SerializeToString()
    repeat_cells(model.graph)
    assert "Resize" in kinds(model)
    assert model.SerializeToString() == before


@pytest.mark.parametrize(
    ("net", "size", "outputs"),
    [
        (EdgeDetector(DetectorConfig(width=8, blocks=(1, 1, 1, 1), neck=16)), (64, 96), ("p8", "p16", "p32")),
        (
            EdgeMultibin(MultibinConfig(crop_px=32, channels=(8, 16, 16), residuals=(1, 1), squeezed=16)),
            (32, 32),
            tuple("abcde"),
        ),
        (EdgeDepth(DepthConfig(stem=(8, 16, 16), width=32, blocks=1, heads=2, decoder=8)), (64, 96), ("d",)),
    ],
)
def test_the_edge_networks_read_their_pixels_in_groups(net: nn.Module, size: tuple[int, int], outputs: tuple[str, ...]) -> None:
    images = pictures(*size)
    model = to_onnx(net.eval(), "net", size, outputs, dynamic_hw=size != (32, 32))
    quantized = quantize(model, [images], keep_float=outputs)
    small = onnx.load_from_string(for_onnxruntime(quantized, outputs))
    assert kinds(small).count("Reshape") >= 2
    assert all(np.isfinite(result).all() for result in run(small, images))
