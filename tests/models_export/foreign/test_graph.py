"""Files that cannot be wrapped are refused by what is wrong with them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from models_export.foreign.graph import Normalisation, read_graph
from service.errors import InputError


def edit_input(path: Path, dims: list[int | str], element: int = TensorProto.FLOAT) -> Path:
    model = onnx.load(path)
    del model.graph.input[:]
    model.graph.input.append(helper.make_tensor_value_info("images", element, dims))
    onnx.save(model, path)
    return path


@pytest.mark.parametrize(
    ("dims", "element", "match"),
    [
        ([1, 64, 96, 3], TensorProto.FLOAT, "B, 3, H, W"),
        ([1, 3, 64, 96], TensorProto.UINT8, "float or half"),
        ([4, 3, 64, 96], TensorProto.FLOAT, "exactly 4 images"),
        ([1, 3, "h", "w"], TensorProto.FLOAT, "--size"),
        ([1, 3, 64, 100_000], TensorProto.FLOAT, "100000x64"),
        ([1, 3, 64], TensorProto.FLOAT, "its inputs are images"),
    ],
)
def test_inputs_that_do_not_fit(write_model: Any, dims: list[int | str], element: int, match: str) -> None:
    with pytest.raises(InputError, match=match):
        read_graph(edit_input(write_model("v8"), dims, element), None)


def test_an_open_size_is_given_by_the_user(write_model: Any) -> None:
    graph = read_graph(edit_input(write_model("v8"), ["b", 3, "h", "w"]), (96, 64))
    assert (graph.size, graph.is_batched) == ((96, 64), True)


def test_external_data_is_refused(write_model: Any) -> None:
    path = write_model("v8")
    onnx.save(onnx.load(path), path, save_as_external_data=True, location="weights.bin", size_threshold=0)
    with pytest.raises(InputError, match=r"external data.*one file"):
        read_graph(path, None)


def test_a_file_that_is_no_model_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.onnx"
    path.write_bytes(b"\x00 not a model")
    with pytest.raises(InputError, match="not an ONNX file"):
        read_graph(path, None)


def test_precision_is_read_from_the_tensors(write_model: Any) -> None:
    path = write_model("v8")
    assert read_graph(path, None).precision == "fp32"
    model = onnx.load(path)
    for tensor in model.graph.initializer:
        if tensor.data_type == TensorProto.FLOAT:
            half = numpy_helper.to_array(tensor).astype(np.float16)
            tensor.CopyFrom(numpy_helper.from_array(half, tensor.name))
    onnx.save(model, path)
    assert read_graph(path, None).precision == "fp16"


def test_normalisation_is_what_it_says() -> None:
    canvases = np.array([[[[10, 20, 30]]]], np.uint8)
    plain = Normalisation().apply(canvases)
    np.testing.assert_allclose(plain[0, :, 0, 0], np.array([10, 20, 30]) / 255, rtol=1e-6)
    swapped = Normalisation((1.0, 2.0, 3.0), (2.0, 4.0, 8.0), is_bgr=True).apply(canvases)
    np.testing.assert_allclose(swapped[0, :, 0, 0], [29 / 2, 18 / 4, 7 / 8])
