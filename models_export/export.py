"""Trained networks to a pack: ONNX files with metadata, checked against torch, quantized, scored, and a manifest."""

from __future__ import annotations

import hashlib
import json
import logging
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import onnx
import torch
from torch import Tensor, nn
from torch.export import Dim

from service.nets.canvas import ALIGN_PX
from service.nets.pack import METADATA_KEY, Manifest, NetworkEntry, Pack, StoredFile, open_network

OPSET = 20
"""ONNX operator set of every exported graph; ONNX Runtime runs it since 1.17."""
_EXAMPLE_BATCH = 2
MAX_TILES = 60
"""Longest side of a dynamic canvas over ``ALIGN_PX``."""


@dataclass(frozen=True, eq=False)
class Exported:
    """One network ready to be written."""

    name: str
    model: bytes
    """In the form for ONNX Runtime."""
    precision: str
    parameters: int
    openvino: bytes | None = None
    """The same network in the form for OpenVINO, where that is worth it."""

    @staticmethod
    def of_pack(pack: Pack, name: str) -> Exported:
        """A network of a pack as it is."""
        entry = pack.manifest.networks[name]
        openvino = None if entry.openvino is None else (pack.path / entry.openvino.file).read_bytes()
        return Exported(name, (pack.path / entry.file).read_bytes(), entry.precision, entry.parameters, openvino)


def to_onnx(net: nn.Module, name: str, example_hw: tuple[int, int], outputs: Sequence[str], *, dynamic_hw: bool) -> bytes:
    """One self-contained ONNX file of a network in eval mode, input ``images`` (B, H, W, 3) uint8, B dynamic.

    With ``dynamic_hw`` height and width are dynamic too, in multiples of 32 px.
    """
    example = torch.zeros((_EXAMPLE_BATCH, *example_hw, 3), dtype=torch.uint8)
    shape: dict[int, Any] = {0: Dim("batch")}
    if dynamic_hw:
        shape |= {1: ALIGN_PX * Dim("rows", min=1, max=MAX_TILES), 2: ALIGN_PX * Dim("columns", min=1, max=MAX_TILES)}
    return trace(net, name, {"images": example}, (shape,), outputs)


def trace(
    net: nn.Module, name: str, examples: Mapping[str, Tensor], shapes: Sequence[Mapping[int, Any]], outputs: Sequence[str]
) -> bytes:
    """One self-contained ONNX file of a network in eval mode, with the named inputs; ``shapes``: dynamic axes of each."""
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        # The exporter's own deprecations of its internals; nothing of ours.
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            net, tuple(examples.values()), dynamo=True, dynamic_shapes=tuple(shapes), input_names=list(examples),
            output_names=list(outputs), opset_version=OPSET, verbose=False,
        )  # fmt: skip
    assert program is not None, "the dynamo exporter returns a program"
    model: onnx.ModelProto = program.model_proto
    model.graph.name = name
    _strip_source_paths(model)
    return bytes(model.SerializeToString())


def fixed_batch(model: bytes, size: int) -> bytes:
    """A copy of an exported model that takes ``size`` images a run, no more and no fewer."""
    proto = onnx.load_from_string(model)
    symbol = proto.graph.input[0].type.tensor_type.shape.dim[0].dim_param
    for value in [*proto.graph.input, *proto.graph.output, *proto.graph.value_info]:
        for dim in value.type.tensor_type.shape.dim:
            if dim.dim_param == symbol:
                dim.dim_value = size
    return bytes(proto.SerializeToString())


def with_metadata(model: bytes, metadata: Mapping[str, Any]) -> bytes:
    """The model with ``metadata`` as JSON under the pack's key, replacing what was there."""
    proto = onnx.load_from_string(model)
    kept = [p for p in proto.metadata_props if p.key != METADATA_KEY]
    del proto.metadata_props[:]
    proto.metadata_props.extend(kept)
    entry = proto.metadata_props.add()
    entry.key, entry.value = METADATA_KEY, json.dumps(metadata)
    return bytes(proto.SerializeToString())


def write_pack(
    out: Path,
    exported: Sequence[Exported],
    *,
    name: str,
    version: str,
    classes: Sequence[str],
    training: Mapping[str, Any],
    scores: Mapping[str, Any],
    licence: str = "Apache-2.0",
) -> Manifest:
    """Write files and manifest of a pack, after each file was opened once as the service will open it."""
    out.mkdir(parents=True, exist_ok=True)
    entries = {}
    for network in exported:
        stored = _store(out / f"{network.name}.onnx", network.name, network.model)
        openvino = None
        if network.openvino is not None:
            openvino = _store(out / f"{network.name}.openvino.onnx", network.name, network.openvino)
        entries[network.name] = NetworkEntry(
            file=stored.file,
            sha256=stored.sha256,
            precision=network.precision,
            parameters=network.parameters,
            openvino=openvino,
        )
    manifest = Manifest(
        name=name,
        version=version,
        licence=licence,
        classes=list(classes),
        networks=entries,
        training=dict(training),
        scores=dict(scores),
    )
    (out / "manifest.json").write_text(json.dumps(manifest.model_dump(), indent=1) + "\n", encoding="utf-8")
    return manifest


def _store(path: Path, name: str, model: bytes) -> StoredFile:
    open_network(name, model)
    path.write_bytes(model)
    return StoredFile(file=path.name, sha256=hashlib.sha256(model).hexdigest())


def _strip_source_paths(model: onnx.ModelProto) -> None:
    """Drop the exporter's stack traces: they name files of the machine, and weigh more than the graph."""
    for node in model.graph.node:
        del node.metadata_props[:]
        node.doc_string = ""
    del model.graph.metadata_props[:]
    for value in [*model.graph.value_info, *model.graph.input, *model.graph.output]:
        del value.metadata_props[:]
