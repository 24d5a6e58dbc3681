"""Training goes on from an exported network: what is read back gives what the file gives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest
import torch
from torch import nn

from models_export.data.samples import Sample
from models_export.export import to_onnx, with_metadata
from models_export.int8.quantize import for_onnxruntime, quantize
from models_export.metadata import detector_metadata
from models_export.nets.detector import DetectorConfig
from models_export.train.detector import DetectorTask
from models_export.train.exported import load_exported, provenance
from service.errors import InputError
from service.nets.pack import MODELS_DIR

CONFIG = DetectorConfig(width=8, blocks=(1, 1, 1, 1), neck=16)
HEADS = ("p8", "p16", "p32")
ANCHORS = tuple(tuple((8.0 * (3 * s + a + 1), 6.0 * (3 * s + a + 1)) for a in range(3)) for s in range(3))


def _trained(samples: list[Sample]) -> DetectorTask:
    """A task whose norms have statistics, scales and shifts of their own, as training would have left them."""
    torch.manual_seed(3)
    task = DetectorTask(samples, CONFIG)
    for norm in (m for m in task.net.modules() if isinstance(m, nn.BatchNorm2d)):
        nn.init.normal_(norm.running_mean, 0.0, 0.3)
        nn.init.uniform_(norm.running_var, 0.5, 2.0)
        nn.init.uniform_(norm.weight, 0.5, 1.5)
        nn.init.normal_(norm.bias, 0.2, 0.2)
    task.net.eval()
    return task


def _file(task: DetectorTask, path: Path, *, int8: bool) -> Path:
    model = to_onnx(task.net, "detector", (96, 160), HEADS, dynamic_hw=True)
    if int8:
        model = for_onnxruntime(quantize(model, [_pictures(task)], keep_float=HEADS), HEADS)
    path.write_bytes(with_metadata(model, {**detector_metadata(task.config), "anchors_px": ANCHORS}))
    return path


def _pictures(task: DetectorTask) -> np.ndarray:
    images: np.ndarray = task.batch(np.arange(4), np.random.default_rng(0))["images"].numpy()
    return images


@pytest.mark.parametrize(("int8", "tolerance"), [(False, 1e-4), (True, 0.05)])
def test_the_network_gives_what_its_file_gives(toy_samples: list[Sample], tmp_path: Path, int8: bool, tolerance: float) -> None:
    path = _file(_trained(toy_samples), tmp_path / "detector.onnx", int8=int8)
    torch.manual_seed(4)
    task = DetectorTask(toy_samples, CONFIG)
    load_exported(task, path)
    assert task.net.training
    images = _pictures(task)
    with torch.no_grad():
        ours = task.net.eval()(torch.from_numpy(images))
    theirs = ort.InferenceSession(path).run(None, {"images": images})
    for a, b in zip(ours, theirs, strict=True):
        assert np.abs(a.numpy() - b).max() <= tolerance * np.ptp(b)


def test_the_priors_that_the_weights_are_bound_to_come_along(toy_samples: list[Sample], tmp_path: Path) -> None:
    path = _file(_trained(toy_samples), tmp_path / "detector.onnx", int8=False)
    task = DetectorTask(toy_samples, CONFIG)
    assert task.config.anchors_px != ANCHORS
    load_exported(task, path)
    assert task.config.anchors_px == task.net.config.anchors_px == ANCHORS


def test_a_convolution_of_zeros_starts_anew_and_learns(toy_samples: list[Sample], tmp_path: Path) -> None:
    trained = _trained(toy_samples)
    dead = trained.net.stage8.inner[0].second
    for values in (dead[0].weight, dead[1].bias, dead[1].running_mean):
        nn.init.zeros_(values)
    path = _file(trained, tmp_path / "detector.onnx", int8=False)
    task = DetectorTask(toy_samples, CONFIG)
    load_exported(task, path)
    block = task.net.stage8.inner[0].second
    task.loss(task.net, task.batch(np.arange(4), np.random.default_rng(0)))["total"].backward()
    assert block[0].weight.any()
    assert block[0].weight.grad.any()


def test_a_file_that_does_not_fit_is_refused(toy_samples: list[Sample], tmp_path: Path) -> None:
    path = _file(_trained(toy_samples), tmp_path / "detector.onnx", int8=False)
    wider = DetectorTask(toy_samples, DetectorConfig(width=8, blocks=(1, 1, 1, 1), neck=24))
    with pytest.raises(InputError, match="no weights of this network"):
        load_exported(wider, path)
    deeper = DetectorTask(toy_samples, DetectorConfig(width=8, blocks=(1, 2, 1, 1), neck=16))
    with pytest.raises(InputError, match="stage8"):
        load_exported(deeper, path)
    path.write_bytes(b"no network")
    with pytest.raises(InputError, match="not ONNX"):
        load_exported(wider, path)
    with pytest.raises(InputError, match="cannot be read"):
        load_exported(wider, tmp_path / "absent.onnx")


def test_a_shipped_network_brings_its_own_past_along() -> None:
    before = provenance(MODELS_DIR / "edge" / "multibin.onnx")
    assert before is not None
    assert before["taken_from"].startswith("edge ")
    assert before["data"]
    assert before["training"]


def test_a_file_outside_a_pack_has_no_past(tmp_path: Path) -> None:
    assert provenance(tmp_path / "detector.onnx") is None
