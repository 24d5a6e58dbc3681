"""Every cell of a depth map lies where the map says, whatever canvas the net takes."""

from __future__ import annotations

import json

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from service.depth_scale import cell_pixels
from service.errors import PackError
from service.nets.canvas import InputFit
from service.nets.depth import DepthNet, InverseDepth
from service.nets.pack import METADATA_KEY, open_network

STRIDE = 8


def depth_net(fit: dict[str, object] | None, batch: int | str = "batch") -> DepthNet:
    """A net whose inverse depth is the mean red of a cell."""
    sides: list[int | str] = [fit["height"], fit["width"]] if fit else ["h", "w"]  # type: ignore[list-item]
    nodes = [
        helper.make_node("Cast", ["images"], ["real"], to=TensorProto.FLOAT),
        helper.make_node("Transpose", ["real"], ["planes"], perm=[0, 3, 1, 2]),
        helper.make_node("Gather", ["planes", "zero"], ["red"], axis=1),
        helper.make_node("AveragePool", ["red"], ["cells"], kernel_shape=[STRIDE] * 2, strides=[STRIDE] * 2),
        helper.make_node("Squeeze", ["cells", "one"], ["map"]),
    ]
    constants = [
        numpy_helper.from_array(np.array([0], np.int64), "zero"),
        numpy_helper.from_array(np.array([1], np.int64), "one"),
    ]
    images = helper.make_tensor_value_info("images", TensorProto.UINT8, [batch, *sides, 3])
    out = helper.make_tensor_value_info("map", TensorProto.FLOAT, [None, None, None])
    graph = helper.make_graph(nodes, "depth", [images], [out], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    metadata = {"stride": STRIDE, "bias_relative": 0.0, "sigma_relative": 0.1, "fit": fit}
    helper.set_model_props(model, {METADATA_KEY: json.dumps(metadata)})
    onnx.checker.check_model(model)
    return DepthNet(open_network("depth", model.SerializeToString()))


def ramp(width: int, height: int) -> np.ndarray:
    """An image whose red is 100 + column - row."""
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    return np.stack([100 + column - row] * 3, -1).astype(np.uint8)


@pytest.mark.parametrize("batch", [1, "batch"])
@pytest.mark.parametrize("size", [None, (96, 64), (200, 96), (160, 160)])
def test_cells_lie_where_the_map_says(size: tuple[int, int] | None, batch: int | str) -> None:
    net = depth_net(InputFit(size).to_metadata(), batch)
    images = [ramp(130, 70), ramp(70, 90)]
    for image, inverse in zip(images, net.infer(images), strict=True):
        pixels = cell_pixels(inverse.values.shape, inverse.stride)
        # A cell that the image's border cuts shows padding too.
        whole = np.all(pixels + 0.5 + inverse.stride / 2 <= image.shape[1::-1], axis=-1)
        assert whole.sum() > 20
        np.testing.assert_allclose(inverse.values[whole], (100 + pixels[..., 0] - pixels[..., 1])[whole], atol=0.5)
        # The map covers the image, and no whole cell more.
        assert np.all(np.array(inverse.values.shape) * inverse.stride >= np.array(image.shape[:2]) - 1.0)
        assert np.all((np.array(inverse.values.shape) - 1) * inverse.stride <= np.array(image.shape[:2]) + 1.0)


def test_images_in_the_middle_of_their_canvas_are_refused() -> None:
    with pytest.raises(PackError, match="corner"):
        depth_net(InputFit((96, 64), "center").to_metadata())


@pytest.mark.parametrize(("stride", "shape"), [(8.0, (12, 20)), (15.0, (7, 11)), (24.0, (4, 6))])
def test_a_map_on_other_cells_says_the_same_of_every_pixel(stride: float, shape: tuple[int, int]) -> None:
    pixels = cell_pixels((12, 20), 8.0)
    plane = InverseDepth((0.01 * pixels[..., 0] - 0.03 * pixels[..., 1]).astype(np.float32), 8.0)
    moved = plane.on_cells(shape, stride)
    assert (moved.values.shape, moved.stride) == (shape, stride)
    x, y = np.moveaxis(cell_pixels(shape, stride), -1, 0)
    inside = (x >= 3.5) & (x <= 155.5) & (y >= 3.5) & (y <= 91.5)
    assert inside.sum() > 20
    # Positions are rounded to a 32nd of a cell by the resampler.
    np.testing.assert_allclose(moved.values[inside], (0.01 * x - 0.03 * y)[inside], atol=0.04 * 8 / 32)


def test_a_map_of_an_image_twice_as_wide_has_cells_twice_as_wide() -> None:
    assert InverseDepth(np.zeros((2, 3), np.float32), 8.0).at_width(642, 1284).stride == 16.0
