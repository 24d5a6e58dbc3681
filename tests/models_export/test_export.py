"""What is exported computes what was trained, says what it is, and holds nothing it should not."""

from __future__ import annotations

import getpass
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from models_export.export import Exported, fixed_batch, to_onnx, with_metadata, write_pack
from models_export.half import to_half
from models_export.int8.quantize import for_onnxruntime, quantize
from models_export.nets.depth import DepthConfig, EdgeDepth
from models_export.nets.detector import DetectorConfig, EdgeDetector
from models_export.nets.multibin import EdgeMultibin, MultibinConfig
from models_export.verify import parity, require_parity
from service.errors import PackError
from service.nets.detector import Detector
from service.nets.pack import load_pack, open_network

DETECTOR = DetectorConfig(width=8, blocks=(1, 1, 1, 1), neck=16)
METADATA = {
    "classes": list(DETECTOR.classes),
    "strides": list(DETECTOR.strides),
    "anchors_px": DETECTOR.anchors_px,
    "max_width": 672,
    "sigma_edge_px": [0.5, 0.02, 1.0, 1.5],
}
HEADS = ("p8", "p16", "p32")


def street_like(height: int, width: int, batch: int = 2) -> np.ndarray:
    """Smooth shapes and edges, uint8 (B, H, W, 3): what a frame looks like to a convolution."""
    y, x = np.mgrid[:height, :width]
    base = 90 + 60 * np.sin(x / 23.0) + 40 * (y > height / 2)
    rng = np.random.default_rng(height)
    noise = rng.normal(0, 6, (batch, height, width, 3))
    return np.clip(base[None, ..., None] + noise, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def detector() -> tuple[EdgeDetector, bytes]:
    torch.manual_seed(0)
    net = EdgeDetector(DETECTOR).eval()
    return net, with_metadata(to_onnx(net, "detector", (96, 160), HEADS, dynamic_hw=True), METADATA)


def test_the_detector_agrees_on_any_canvas(detector: tuple[EdgeDetector, bytes]) -> None:
    net, model = detector
    worst = require_parity(net, open_network("detector", model), [street_like(96, 160), street_like(64, 224, 1)])
    assert worst < 1e-3


def test_the_multibin_head_agrees_on_any_batch() -> None:
    net = EdgeMultibin(MultibinConfig(crop_px=32, channels=(8, 16, 16), residuals=(1, 1), squeezed=16)).eval()
    model = with_metadata(to_onnx(net, "multibin", (32, 32), tuple("abcde"), dynamic_hw=False), {})
    require_parity(net, open_network("multibin", model), [street_like(32, 32, 1), street_like(32, 32, 7)])


def test_the_depth_net_agrees_on_any_canvas() -> None:
    net = EdgeDepth(DepthConfig(stem=(8, 16, 16), width=32, blocks=1, heads=2, decoder=8)).eval()
    model = with_metadata(to_onnx(net, "depth", (96, 160), ("d",), dynamic_hw=True), {})
    require_parity(net, open_network("depth", model), [street_like(96, 160), street_like(64, 224, 1)])


def test_another_network_does_not_pass_the_gate(detector: tuple[EdgeDetector, bytes]) -> None:
    torch.manual_seed(1)
    stranger = EdgeDetector(DETECTOR).eval()
    with pytest.raises(PackError, match="differ by"):
        require_parity(stranger, open_network("detector", detector[1]), [street_like(96, 160)])


def test_an_exported_file_names_no_file_or_user_of_its_maker(detector: tuple[EdgeDetector, bytes]) -> None:
    model = detector[1]
    assert str(Path(__file__).resolve().parents[2]).encode() not in model
    assert b"site-packages" not in model
    assert f"/home/{getpass.getuser()}".encode() not in model


def test_metadata_is_replaced_not_added(detector: tuple[EdgeDetector, bytes]) -> None:
    model = with_metadata(with_metadata(detector[1], {"a": 1}), {"b": 2})
    assert open_network("n", model).metadata == {"b": 2}
    assert len([p for p in onnx.load_from_string(model).metadata_props if p.key == "quadlift"]) == 1


def test_int8_is_smaller_and_near(detector: tuple[EdgeDetector, bytes]) -> None:
    net, model = detector
    batches = [street_like(96, 160)]
    small = with_metadata(for_onnxruntime(quantize(model, batches, keep_float=HEADS), HEADS), METADATA)
    types = {node.op_type for node in onnx.load_from_string(small).graph.node}
    assert "QuantizeLinear" in types
    assert len(small) < len(model)
    assert 0 < parity(net, open_network("detector", small), batches) < 0.2


def test_a_written_pack_loads_and_runs(detector: tuple[EdgeDetector, bytes], tmp_path: Path) -> None:
    head = with_metadata(detector[1], METADATA)
    networks = [Exported(name, head, "fp32", 7) for name in ("detector", "multibin", "depth")]
    manifest = write_pack(
        tmp_path, networks, name="toy", version="0", classes=DETECTOR.classes, training={"seed": 1}, scores={"none": 0}
    )
    pack = load_pack(str(tmp_path))
    assert pack.manifest == manifest
    found = Detector(pack.networks["detector"]).detect([street_like(70, 150)[0], street_like(96, 160)[0]])
    assert [len(f) for f in found] == [0, 0]


def test_a_network_without_metadata_is_refused(detector: tuple[EdgeDetector, bytes]) -> None:
    bare = onnx.load_from_string(detector[1])
    del bare.metadata_props[:]
    with pytest.raises(PackError, match="metadata"):
        open_network("detector", bare.SerializeToString())


def test_half_precision_is_half_as_large_and_passes_its_gate(detector: tuple[EdgeDetector, bytes]) -> None:
    net, model = detector
    half = to_half(model)
    graph = onnx.load_from_string(half).graph
    # What is left in float are scales of a Resize, which the operator wants so.
    assert all(int(np.prod(entry.dims)) <= 4 for entry in graph.initializer if entry.data_type == onnx.TensorProto.FLOAT)
    assert len(half) < 0.6 * len(model)
    network = open_network("detector", half)
    assert network.session.get_inputs()[0].type == "tensor(uint8)"
    assert {output.type for output in network.session.get_outputs()} == {"tensor(float)"}
    batches = [street_like(96, 160), street_like(64, 224, 1)]
    assert 1e-6 < require_parity(net, network, batches, "fp16") < 1e-2


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_a_fixed_batch_serves_any_number_of_images(detector: tuple[EdgeDetector, bytes], count: int) -> None:
    net, model = detector
    network = open_network("detector", fixed_batch(model, 2))
    assert network.session.get_inputs()[0].shape[0] == 2
    assert all(output.shape[0] == 2 for output in network.session.get_outputs())
    require_parity(net, network, [street_like(64, 96, count)])


def test_a_fixed_batch_of_quantized_and_half_models(detector: tuple[EdgeDetector, bytes]) -> None:
    net, model = detector
    batches = [street_like(96, 160)]
    for lowered in (
        with_metadata(for_onnxruntime(quantize(model, batches, keep_float=HEADS), HEADS), METADATA),
        to_half(model),
    ):
        network = open_network("detector", fixed_batch(lowered, 3))
        assert network.session.get_inputs()[0].shape[0] == 3
        assert parity(net, network, batches) < 0.2
