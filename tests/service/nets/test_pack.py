"""A pack is loaded only when every byte of it is what its manifest says."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from service.errors import PackError
from service.nets.pack import MODELS_DIR, Pack, load_pack


@pytest.fixture
def pack_copy(tmp_path: Path) -> Path:
    return Path(shutil.copytree(MODELS_DIR / "edge", tmp_path / "edge"))


def edit_manifest(folder: Path, **changes: object) -> None:
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["networks"]["detector"].update(changes)
    path.write_text(json.dumps(manifest))


def test_the_shipped_pack_loads() -> None:
    pack = load_pack("edge")
    assert isinstance(pack, Pack)
    assert set(pack.networks) >= {"detector", "multibin", "depth"}
    assert "car" in pack.manifest.classes


def test_the_shipped_pack_is_under_20_mb() -> None:
    assert sum(path.stat().st_size for path in (MODELS_DIR / "edge").iterdir()) < 20e6


def test_an_unknown_pack_is_refused() -> None:
    with pytest.raises(PackError, match=r"no manifest\.json.*name of a shipped pack"):
        load_pack("no-such-pack")


def test_one_flipped_bit_is_refused(pack_copy: Path) -> None:
    path = pack_copy / "detector.onnx"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))
    with pytest.raises(PackError, match=r"SHA-256.*altered or damaged"):
        load_pack(str(pack_copy))


def test_a_missing_file_is_refused(pack_copy: Path) -> None:
    (pack_copy / "depth.onnx").unlink()
    with pytest.raises(PackError, match=r"depth\.onnx.*cannot be read"):
        load_pack(str(pack_copy))


def test_external_data_is_refused(pack_copy: Path) -> None:
    import hashlib

    import onnx

    path = pack_copy / "detector.onnx"
    model = onnx.load(path)
    onnx.save(model, path, save_as_external_data=True, all_tensors_to_one_file=True, location="weights.bin", size_threshold=0)
    edit_manifest(pack_copy, sha256=hashlib.sha256(path.read_bytes()).hexdigest())
    with pytest.raises(PackError, match="external data"):
        load_pack(str(pack_copy), provider="cpu")


def test_a_file_that_is_no_model_is_refused(pack_copy: Path) -> None:
    import hashlib

    path = pack_copy / "detector.onnx"
    path.write_bytes(b"not a network")
    edit_manifest(pack_copy, sha256=hashlib.sha256(path.read_bytes()).hexdigest())
    with pytest.raises(PackError, match="cannot load it"):
        load_pack(str(pack_copy), provider="cpu")


def test_a_manifest_that_leads_out_of_its_folder_is_refused(pack_copy: Path) -> None:
    edit_manifest(pack_copy, file="../detector.onnx")
    with pytest.raises(PackError, match=r"networks\.detector\.file"):
        load_pack(str(pack_copy))


def test_a_manifest_without_a_network_is_refused(pack_copy: Path) -> None:
    path = pack_copy / "manifest.json"
    manifest = json.loads(path.read_text())
    del manifest["networks"]["depth"]
    path.write_text(json.dumps(manifest))
    with pytest.raises(PackError, match="no network 'depth'"):
        load_pack(str(pack_copy))
