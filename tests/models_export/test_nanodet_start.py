"""The edge detector starts from NanoDet-g's weights: each where it belongs, for pixels as our networks see them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch
from onnx import helper, numpy_helper
from torch import nn

from models_export.data.nanodet import MEAN_BGR, SIDE_PX, STD_BGR, WEIGHTS
from models_export.data.samples import Sample
from models_export.nets.detector import DetectorConfig, EdgeDetector
from models_export.train.detector import DetectorTask
from models_export.train.exported import is_ours
from models_export.train.nanodet_start import load_nanodet, nanodet_values
from service.errors import InputError
from service.nets.pack import MODELS_DIR

CONFIG = DetectorConfig(width=8, blocks=(1, 2, 1, 1), neck=16)
TEACHER = Path(__file__).resolve().parents[3] / "shared" / "data" / WEIGHTS
ORDER = (
    "stem", "stage4.first", "stage4.inner.0.first", "stage4.inner.0.second", "stage4.last",
    "stage8.first", "stage8.inner.0.first", "stage8.inner.0.second", "stage8.inner.1.first", "stage8.inner.1.second",
    "stage8.last", "stage16.first", "stage16.inner.0.first", "stage16.inner.0.second", "stage16.last", "stage32.first",
    "stage32.inner.0.first", "stage32.inner.0.second", "stage32.last", "lateral32", "lateral16", "lateral8",
    "heads.2.0", None, "heads.1.0", None, "heads.0.0", None,
)  # fmt: skip
"""The convolutions of a small NanoDet as its file has them: of each scale the hidden map, then the outputs."""


def _file(path: Path, order: tuple[str | None, ...] = ORDER) -> Path:
    """A file whose n-th convolution holds weights of 0.01 n and biases of n."""
    net, nodes, weights = EdgeDetector(CONFIG), [], []
    for number, name in enumerate(order):
        shape = net.get_submodule(f"{name}.0").weight.shape if name else (124, CONFIG.neck, 1, 1)  # type: ignore[union-attr]
        for part, value in (("w", np.full(shape, 0.01 * number)), ("b", np.full(shape[0], float(number)))):
            weights.append(numpy_helper.from_array(value.astype(np.float32), f"{part}{number}"))
        nodes.append(helper.make_node("Conv", [f"x{number}", f"w{number}", f"b{number}"], [f"x{number + 1}"]))
    onnx.save(helper.make_model(helper.make_graph(nodes, "nanodet", [], [], weights)), path)
    return path


def test_every_convolution_gets_its_own_weights(tmp_path: Path) -> None:
    values = nanodet_values(onnx.load(_file(tmp_path / "nanodet.onnx")).graph, CONFIG)
    for number, name in enumerate(ORDER[1:], 1):
        if name is not None:
            assert np.allclose(values[f"{name}.0.weight"], 0.01 * number)
            assert np.allclose(values[f"{name}.0.weight_bias"], number)


def test_what_the_heads_say_is_new_and_all_else_is_there(toy_samples: list[Sample], tmp_path: Path) -> None:
    torch.manual_seed(1)
    task = DetectorTask(toy_samples, CONFIG)
    outputs = {name: value.clone() for name, value in task.net.state_dict().items() if name.startswith("heads.0.1")}
    record = load_nanodet(task, _file(tmp_path / "nanodet.onnx"))
    assert "NanoDet-g" in record["taken_from"]
    after = task.net.state_dict()
    assert outputs
    assert all(torch.equal(after[name], value) for name, value in outputs.items())
    assert torch.allclose(after["heads.0.0.0.weight"], torch.tensor(0.01 * ORDER.index("heads.0.0")))
    assert task.net.training


def test_other_files_are_refused(toy_samples: list[Sample], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="27 convolutions"):
        load_nanodet(DetectorTask(toy_samples, CONFIG), _file(tmp_path / "short.onnx", ORDER[:-1]))
    wider = DetectorTask(toy_samples, DetectorConfig(width=16, blocks=CONFIG.blocks, neck=16))
    with pytest.raises(InputError, match=r"stem\.0\.weight"):
        load_nanodet(wider, _file(tmp_path / "narrow.onnx"))


def test_a_packs_file_is_told_from_others(tmp_path: Path) -> None:
    assert is_ours(MODELS_DIR / "edge" / "detector.onnx")
    assert not is_ours(_file(tmp_path / "nanodet.onnx"))


def test_the_first_convolution_sees_the_same_pixels() -> None:
    if not TEACHER.is_file():
        pytest.skip(f"no {TEACHER}")
    model = onnx.load(TEACHER)
    first = next(node for node in model.graph.node if node.op_type == "Conv")
    model.graph.output.append(helper.make_empty_tensor_value_info(first.output[0]))
    pixels = np.random.default_rng(0).integers(0, 256, (1, SIDE_PX, SIDE_PX, 3), dtype=np.uint8)
    session = ort.InferenceSession(model.SerializeToString())
    bgr = ((pixels[..., ::-1] - MEAN_BGR) / STD_BGR).transpose(0, 3, 1, 2).astype(np.float32)
    (theirs,) = session.run([first.output[0]], {session.get_inputs()[0].name: np.ascontiguousarray(bgr)})
    net = EdgeDetector(DetectorConfig())
    values = nanodet_values(model.graph, net.config)
    weight, bias = (torch.tensor(values[f"stem.0.{part}"]).float() for part in ("weight", "weight_bias"))
    ours = nn.functional.conv2d(net.normalise(torch.from_numpy(pixels)), weight, bias, stride=2, padding=1)
    assert (ours - torch.from_numpy(theirs))[:, :, 1:-1, 1:-1].abs().max() < 1e-3
