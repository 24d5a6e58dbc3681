"""Networks that OpenVINO computes: the same results, from any number of threads, and clear words where it cannot."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from service.errors import PackError
from service.nets.detector import Detector
from service.nets.pack import METADATA_KEY, MODELS_DIR, load_pack

pytest.importorskip("openvino", reason="quadlift[openvino] is not installed")


@pytest.fixture
def pack_copy(tmp_path: Path) -> Path:
    return Path(shutil.copytree(MODELS_DIR / "edge", tmp_path / "edge"))


def edit_form(folder: Path, data: bytes | None) -> None:
    """Replace the detector's form for OpenVINO, or take it out of the manifest."""
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    entry = manifest["networks"]["detector"]
    if data is None:
        entry["openvino"] = None
    else:
        (folder / entry["openvino"]["file"]).write_bytes(data)
        entry["openvino"]["sha256"] = hashlib.sha256(data).hexdigest()
    path.write_text(json.dumps(manifest))


def street(height: int = 192, width: int = 640, images: int = 1) -> np.ndarray:
    rng = np.random.default_rng(height + width)
    coarse = rng.integers(0, 256, (images, height // 8, width // 8, 3), dtype=np.uint8)
    return coarse.repeat(8, 1).repeat(8, 2)


def test_the_detector_runs_on_it_and_the_rest_on_onnx_runtime() -> None:
    pack = load_pack("edge", provider="openvino")
    assert {name: network.provider for name, network in pack.networks.items()} == {
        "detector": "openvino",
        "multibin": "cpu",
        "depth": "cpu",
    }
    assert pack.provider == "cpu, openvino"
    assert load_pack("edge").provider == "cpu, openvino"


def test_both_runtimes_give_the_same_within_a_step_of_int8() -> None:
    ours, theirs = (load_pack("edge", provider=provider).networks["detector"] for provider in ("openvino", "cpu"))
    assert ours.metadata == theirs.metadata
    for pixels in (street(), street(96, 224, 3)):
        for mine, other in zip(ours.run(pixels), theirs.run(pixels), strict=True):
            assert mine.shape == other.shape
            assert mine.dtype == np.float32
            # A rounding that falls the other way moves everything behind it by about a step.
            assert np.abs(mine - other).mean() < 0.02 * np.ptp(other)
            assert np.corrcoef(mine.ravel(), other.ravel())[0, 1] > 0.99


def test_results_outlive_the_next_run() -> None:
    network = load_pack("edge", provider="openvino").networks["detector"]
    first = network.run(street())
    kept = [output.copy() for output in first]
    network.run(255 - street())
    assert all(np.array_equal(output, copy) for output, copy in zip(first, kept, strict=True))


def test_threads_do_not_mix_their_results() -> None:
    network = load_pack("edge", provider="openvino", concurrent_runs=2).networks["detector"]
    pictures = [street(64, 32 * width) for width in (2, 3, 4, 5)] * 6
    alone = [network.run(picture) for picture in pictures[:4]] * 6
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(network.run, pictures))
    for mine, other in zip(together, alone, strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(mine, other, strict=True))


def test_a_pack_without_the_form_stays_with_onnx_runtime(pack_copy: Path) -> None:
    edit_form(pack_copy, None)
    assert load_pack(str(pack_copy)).provider == "cpu"
    with pytest.raises(PackError, match=r"no network has a form for OpenVINO.*set 'auto'"):
        load_pack(str(pack_copy), provider="openvino")


def test_a_broken_installation_is_named_where_it_was_asked_for_and_passed_by_elsewhere(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    # So importing it fails, as where a library that OpenVINO needs is missing.
    monkeypatch.setitem(sys.modules, "service.nets.openvino_session", None)
    assert load_pack("edge").provider == "cpu"
    assert "OpenVINO does not start" in caplog.text
    with pytest.raises(PackError, match="OpenVINO does not start"):
        load_pack("edge", provider="openvino")


def test_a_form_that_is_no_model_is_refused(pack_copy: Path) -> None:
    edit_form(pack_copy, b"not a network")
    with pytest.raises(PackError, match="OpenVINO cannot load it"):
        load_pack(str(pack_copy))


def test_a_form_without_our_metadata_is_refused(pack_copy: Path) -> None:
    import onnx

    model = onnx.load(pack_copy / "detector.openvino.onnx")
    kept = [entry for entry in model.metadata_props if entry.key != METADATA_KEY]
    del model.metadata_props[:]
    model.metadata_props.extend(kept)
    edit_form(pack_copy, model.SerializeToString())
    with pytest.raises(PackError, match="no 'quadlift' metadata"):
        load_pack(str(pack_copy))


@pytest.mark.parametrize("provider", ["cpu", "openvino"])
def test_a_flipped_bit_in_either_form_is_refused(pack_copy: Path, provider: str) -> None:
    path = pack_copy / ("detector.openvino.onnx" if provider == "cpu" else "detector.onnx")
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))
    with pytest.raises(PackError, match=r"SHA-256.*altered or damaged"):
        load_pack(str(pack_copy), provider=provider)  # type: ignore[arg-type]


def test_a_detector_finds_nothing_in_grey() -> None:
    detector = Detector(load_pack("edge", provider="openvino").networks["detector"])
    assert [len(found) for found in detector.detect([np.full((100, 200, 3), 114, np.uint8)] * 2)] == [0, 0]
