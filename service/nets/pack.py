"""A pack: a folder of ONNX networks with a ``manifest.json``, checked before anything of it runs.

A network's normalisation lies inside its graph; sizes and priors lie in its ONNX metadata under the key ``quadlift`` as
JSON. So the ONNX file and its SHA-256 in the manifest are all that a pack is. A network may lie in a pack twice: what one
runtime computes fastest, another may not.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from service.errors import PackError
from service.nets.providers import Choice, Provider, choose, offered, session_providers, settled
from service.nets.quiet_onnxruntime import ort

logger = logging.getLogger(__name__)

MODELS_DIR = Path(__file__).resolve().parent.parent / "models"
METADATA_KEY = "quadlift"
REQUIRED_NETWORKS = ("detector", "multibin", "depth")
_ON_CPU = Choice("cpu", True)
# A tensor stored outside the file carries a StringStringEntryProto whose key is "location": field 1, 8 bytes.
_EXTERNAL_DATA_MARK = b"\x0a\x08location"


class StoredFile(BaseModel):
    """A file of a pack."""

    model_config = ConfigDict(extra="forbid")

    file: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*\.onnx$")]
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class NetworkEntry(StoredFile):
    """One network of a pack; the file is in the form for ONNX Runtime."""

    precision: str
    """fp32, fp16 or int8."""
    parameters: Annotated[int, Field(ge=0)]
    openvino: StoredFile | None = None
    """The same network in the form for OpenVINO; None where that is not worth it: ONNX Runtime computes it then."""


class Manifest(BaseModel):
    """The form of ``manifest.json``."""

    model_config = ConfigDict(extra="forbid")

    name: str
    version: str
    licence: str
    classes: Annotated[list[str], Field(min_length=1)]
    networks: dict[str, NetworkEntry]
    training: dict[str, Any]
    """Data, seeds and configuration that the weights come from."""
    scores: dict[str, Any]
    """Validation scores of the networks, by network."""


class Session(Protocol):
    """What is needed of ``onnxruntime.InferenceSession``."""

    def get_inputs(self) -> Sequence[Any]:
        """The graph's inputs, each with its ``name`` and its ``shape``, of which open sizes are no integers."""

    def run(self, _: None, feeds: dict[str, NDArray[Any]]) -> list[NDArray[np.float32]]:
        """All outputs for inputs by name."""


@dataclass(frozen=True, eq=False)
class Network:
    """A network that a runtime has loaded, and the metadata of its file. Safe to run from several threads at once."""

    name: str
    session: Session
    metadata: dict[str, Any]
    provider: Provider = "cpu"
    """What it computes on."""

    def run(self, *batch: NDArray[Any]) -> list[NDArray[np.float32]]:
        """All outputs, in the graph's order, for one batch of each input, in the graph's order too.

        A network that was exported for batches of one size gets the batch in parts of it, the last filled up with zeros.
        """
        size, count = self.session.get_inputs()[0].shape[0], len(batch[0])
        if not isinstance(size, int) or count == size:
            return self._run(batch)
        parts = []
        for start in range(0, count, size):
            filled = [np.zeros((size, *part.shape[1:]), part.dtype) for part in batch]
            for target, part in zip(filled, batch, strict=True):
                target[: count - start] = part[start : start + size]
            parts.append(self._run(filled))
        return [np.concatenate(outputs)[:count] for outputs in zip(*parts, strict=True)]

    def _run(self, batch: Sequence[NDArray[Any]]) -> list[NDArray[np.float32]]:
        names = [entry.name for entry in self.session.get_inputs()]
        return self.session.run(None, dict(zip(names, batch, strict=True)))


@dataclass(frozen=True, eq=False)
class Pack:
    """A loaded pack."""

    path: Path
    manifest: Manifest
    networks: dict[str, Network]

    @property
    def provider(self) -> str:
        """What the networks compute on, comma-separated where they differ."""
        return ", ".join(sorted({network.provider for network in self.networks.values()}))


def resolve_pack(name_or_path: str) -> Path:
    """The folder of a shipped pack by name, or of any pack by path. Raises PackError when there is none."""
    for folder in (MODELS_DIR / name_or_path, Path(name_or_path)):
        if (folder / "manifest.json").is_file():
            return folder
    shipped = ", ".join(sorted(p.parent.name for p in MODELS_DIR.glob("*/manifest.json"))) or "none"
    raise PackError(
        f"no manifest.json in '{name_or_path}'.",
        field="pack",
        remedy=f"Give a folder that holds one, or the name of a shipped pack ({shipped}).",
    )


def load_pack(name_or_path: str, *, provider: Provider = "auto", intra_op_threads: int = 1, concurrent_runs: int = 1) -> Pack:
    """Check and load a pack.

    provider: what to compute on; one asked for by name must be there, ``auto`` takes the best there is. With OpenVINO, networks
    of which the pack has no form for it stay with ONNX Runtime.
    intra_op_threads: threads that one network run may use. With one, every thread that calls ``run`` works on its own,
    and workers scale with cores. concurrent_runs: how many will at the same time; OpenVINO lets more wait.

    Raises PackError when the manifest is malformed, or a file is missing, altered, or keeps tensors outside itself, or the
    provider does not start; InputError when it is not installed.
    """
    choice = choose(provider, offered())
    folder = resolve_pack(name_or_path)
    manifest = read_manifest(folder / "manifest.json")
    for name in REQUIRED_NETWORKS:
        if name not in manifest.networks:
            raise PackError(f"no network '{name}'.", field=f"{folder.name}/manifest.json", remedy="Export the pack again.")
    if choice.provider == "openvino":
        choice = _openvino_or_cpu(choice, folder, manifest)
    networks = {}
    for name, entry in manifest.networks.items():
        model = _read_file(folder, entry)
        form = None if entry.openvino is None else _read_file(folder, entry.openvino)
        if choice.provider != "openvino":
            networks[name] = open_network(name, model, intra_op_threads, choice)
        elif form is None:
            networks[name] = open_network(name, model, intra_op_threads)
        else:
            networks[name] = open_with_openvino(name, form, intra_op_threads, concurrent_runs)
    pack = Pack(folder, manifest, networks)
    logger.info("pack %s runs on %s (asked for: %s)", manifest.name, pack.provider, provider)
    return pack


def _openvino_or_cpu(choice: Choice, folder: Path, manifest: Manifest) -> Choice:
    """The choice of OpenVINO, or the CPU where ``auto`` made it and the pack has nothing for it, or it does not start.

    Raises PackError where it was asked for by name.
    """
    try:
        # Imported here: an optional dependency, and large.
        import service.nets.openvino_session  # noqa: F401

        fault = None
    except ImportError as error:
        fault = f"OpenVINO does not start: {error}."
        logger.warning("%s", fault)
    if fault is None and not any(entry.openvino for entry in manifest.networks.values()):
        fault = "no network has a form for OpenVINO."
    if fault is None:
        return choice
    if choice.is_required:
        remedy = "Mend the installation or the pack (`quadlift export`), or set 'auto'."
        raise PackError(fault, field=f"{folder.name}/manifest.json", remedy=remedy)
    return _ON_CPU


def session_options(intra_op_threads: int) -> ort.SessionOptions:
    """Options for the service: threads set, and no spinning, which starves the other workers of a small machine."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = intra_op_threads
    options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    return options


def open_network(name: str, model: bytes, intra_op_threads: int = 1, choice: Choice = _ON_CPU) -> Network:
    """A network from the bytes of an ONNX file.

    Raises PackError when it is no self-contained Quadlift network, or the provider does not start.
    """
    _require_self_contained(name, model)
    try:
        providers = session_providers(choice, ort.get_available_providers())
        session = ort.InferenceSession(model, session_options(intra_op_threads), providers=providers)
    except Exception as error:  # ONNX Runtime raises a dozen unrelated types
        raise PackError(f"ONNX Runtime cannot load it: {error}", field=name, remedy="Export the pack again.") from error
    metadata = _own_metadata(name, session.get_modelmeta().custom_metadata_map)
    return Network(name, session, metadata, settled(choice, session.get_providers(), name))


def open_with_openvino(name: str, model: bytes, intra_op_threads: int, concurrent_runs: int) -> Network:
    """A network from the bytes of an ONNX file, computed by OpenVINO. Raises PackError as :func:`open_network` does."""
    # Imported here: an optional dependency.
    from service.nets.openvino_session import OpenVinoSession

    _require_self_contained(name, model)
    try:
        session = OpenVinoSession(model, intra_op_threads, concurrent_runs)
    except RuntimeError as error:
        raise PackError(f"OpenVINO cannot load it: {error}", field=name, remedy="Set the provider to 'cpu'.") from error
    return Network(name, session, _own_metadata(name, session.metadata), "openvino")


def _require_self_contained(name: str, model: bytes) -> None:
    if _EXTERNAL_DATA_MARK in model:
        raise PackError(
            "the file keeps tensors outside itself (external data).",
            field=name,
            remedy="Save the model as one file; a pack vouches for every byte that it loads.",
        )


def _own_metadata(name: str, stored: Mapping[str, str]) -> dict[str, Any]:
    try:
        metadata: dict[str, Any] = json.loads(stored[METADATA_KEY])
    except (KeyError, json.JSONDecodeError) as error:
        raise PackError(
            f"no '{METADATA_KEY}' metadata.", field=name, remedy="Export the network with `quadlift export`."
        ) from error
    return metadata


def read_manifest(path: Path) -> Manifest:
    """The manifest in a file. Raises PackError naming the field that is wrong."""
    try:
        return Manifest.model_validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise PackError(f"{where}: {first['msg']}.", field=str(path), remedy="Export the pack again.") from None


def _read_file(folder: Path, entry: StoredFile) -> bytes:
    path = folder / entry.file
    try:
        model = path.read_bytes()
    except OSError as error:
        raise PackError(f"cannot be read: {error}.", field=str(path), remedy="Install or export the pack again.") from error
    digest = hashlib.sha256(model).hexdigest()
    if digest != entry.sha256:
        raise PackError(
            f"SHA-256 is {digest}, the manifest says {entry.sha256}.",
            field=str(path),
            remedy="The file was altered or damaged: install or export the pack again.",
        )
    return model
