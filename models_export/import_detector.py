"""A user's own ONNX detector to a pack: wrapped, checked against itself, and put beside the other networks of a base pack."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from models_export.detector_pack import open_base, write_detector_pack
from models_export.export import Exported, with_metadata
from models_export.foreign.formats import PRESETS, Output, Question, Reading, read_outputs
from models_export.foreign.graph import ForeignGraph, Normalisation, read_graph, wrap
from models_export.foreign.names import class_ids
from models_export.verify import relative_difference, require_small
from service.errors import InputError
from service.nets.canvas import InputFit
from service.nets.detector_spec import DetectorSpec, Format
from service.nets.error_model import ErrorModel
from service.nets.pack import Manifest, Pack, open_network, session_options
from service.nets.quiet_onnxruntime import ort

UNKNOWN_LICENCE = "unknown: as the model's author says"
_TEST_IMAGE_SIZE = (640, 360)

Pixels = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class ImportRequest:
    """What is to be imported, and what its author knows of it; None and empty fields are found out or taken from the format."""

    model: Path
    """ONNX file."""
    format: Format
    out: Path
    """Folder of the new pack."""
    classes: tuple[str, ...]
    """The detector's classes, in its order."""
    class_map: Mapping[str, str] = field(default_factory=dict)
    """The pack's classes by the detector's; empty: equal names."""
    base: str = "edge"
    """Pack whose other networks, classes and decoding width the new one takes over: a shipped one's name, or a folder."""
    size: tuple[int, int] | None = None
    """Width and height of the input, px, where the file leaves them open."""
    mean: tuple[float, float, float] | None = None
    std: tuple[float, float, float] | None = None
    is_bgr: bool | None = None
    place: Literal["corner", "center"] | None = None
    pad_value: int | None = None
    layout: str | None = None
    anchors_px: list[list[list[int]]] | None = None
    cell_center: float | None = None
    sigma_edge_px: ErrorModel | None = None
    """Of the edges of boxes; None: the base detector's."""
    licence: str = UNKNOWN_LICENCE
    """Of the model."""
    image: Pixels | None = None
    """A picture (H, W, 3) RGB for the checks; None: a drawn one."""


def import_detector(request: ImportRequest) -> Manifest:
    """Wrap a detector into a pack in ``request.out``, after the wrapped network gave what the model itself gives.

    Raises InputError for a model, or options, that do not fit together; PackError for a base pack that cannot be used or a
    wrapping that changes the outputs.
    """
    base = open_base(request.base, request.out)
    detector, scores, origin = _wrapped(request, base)
    return write_detector_pack(request.out, base, detector, licence=request.licence, origin=origin, scores=scores)


def _wrapped(request: ImportRequest, base: Pack) -> tuple[Exported, dict[str, float], dict[str, Any]]:
    """The wrapped and checked detector, its scores, and where it comes from."""
    ids = class_ids(request.classes, base.manifest.classes, request.class_map)
    graph = read_graph(request.model, request.size)
    normalisation, fit = _input(request, graph.size)
    image = drawn_image() if request.image is None else request.image
    canvases = fit.batches([image, np.ascontiguousarray(image[::-1])])[0].pixels
    pixels = normalisation.apply(canvases)
    original = _Original(request.model, graph)
    reading = _read(request, graph, original, pixels[:1])
    metadata = _metadata(request, base, ids, fit, reading)
    batched = graph.is_batched and original.keeps_batches(pixels, reading.outputs)
    model = with_metadata(wrap(graph, normalisation, reading.outputs, batched=batched), metadata)
    checked = len(canvases) if batched else 1
    expected = original.run(pixels[:checked], reading.outputs)
    difference = relative_difference(expected, open_network("detector", model).run(canvases[:checked]), "detector")
    require_small(difference, "detector", "The wrapping changed the network")
    scores = {"parity_with_original": float(f"{difference:.2e}")}
    return Exported("detector", model, graph.precision, graph.parameters), scores, _origin(request, normalisation)


def _metadata(request: ImportRequest, base: Pack, ids: Mapping[int, str], fit: InputFit, reading: Reading) -> dict[str, Any]:
    """The detector's metadata, as the service's own reader accepts it."""
    base_spec = DetectorSpec.from_metadata(base.networks["detector"].metadata)
    metadata = {
        "format": request.format,
        "classes": list(base.manifest.classes),
        "network_classes": len(request.classes),
        "class_map": {str(index): name for index, name in ids.items()},
        "max_width": base_spec.max_width,
        "sigma_edge_px": (request.sigma_edge_px or base_spec.sigma_edge_px).to_metadata(),
        "fit": fit.to_metadata(),
        **reading.metadata,
    }
    DetectorSpec.from_metadata(metadata)
    return metadata


class _Original:
    """The model as it came, run by ONNX Runtime."""

    def __init__(self, path: Path, graph: ForeignGraph) -> None:
        self._graph = graph
        try:
            self._session = ort.InferenceSession(path.read_bytes(), session_options(1), providers=["CPUExecutionProvider"])
        except Exception as error:  # ONNX Runtime raises a dozen unrelated types
            raise InputError(
                f"ONNX Runtime cannot load it: {error}", field=str(path), remedy="Export the model again."
            ) from error
        self.names = [output.name for output in self._session.get_outputs()]

    def run(self, pixels: NDArray[np.float32], names: Sequence[str]) -> list[NDArray[Any]]:
        """Outputs by name for normalised pixels (B, 3, H, W). Raises InputError where the model cannot run on them."""
        try:
            outputs: list[NDArray[Any]] = self._session.run(list(names), self._graph.feeds(pixels))
        except Exception as error:  # as above
            raise InputError(f"the model does not run on input {pixels.shape}: {error}", field="model") from error
        return outputs

    def keeps_batches(self, pixels: NDArray[np.float32], names: Sequence[str]) -> bool:
        """Whether the model takes two pictures at once and answers for two; a declared batch is often only declared."""
        try:
            return all(len(output) == len(pixels) for output in self.run(pixels, names))
        except InputError:
            return False


def _read(request: ImportRequest, graph: ForeignGraph, original: _Original, pixels: NDArray[np.float32]) -> Reading:
    """What the outputs are, told from those for one picture."""
    values = dict(zip(original.names, original.run(pixels, original.names), strict=True))
    question = Question(
        outputs=[Output(name, output[0]) for name, output in values.items() if output.ndim and len(output) == 1],
        classes=len(request.classes),
        size=graph.size,
        has_size_input=graph.size_input is not None,
        layout=request.layout,
        anchors_px=request.anchors_px,
        cell_center=request.cell_center,
    )
    if len(question.outputs) != len(values):
        shapes = ", ".join(f"{name} {output.shape}" for name, output in values.items())
        raise InputError(f"outputs for one image are {shapes}.", field="outputs", remedy="All must begin with the batch.")
    return read_outputs(request.format, question)


def _input(request: ImportRequest, size: tuple[int, int]) -> tuple[Normalisation, InputFit]:
    """The format's preset with what the request knows better."""
    preset = PRESETS[request.format]
    given = {"mean": request.mean, "std": request.std, "is_bgr": request.is_bgr}
    normalisation = replace(preset.normalisation, **{name: value for name, value in given.items() if value is not None})
    if not all(abs(value) > 0 for value in normalisation.std):
        raise InputError(f"{normalisation.std}", field="--std", remedy="Pixels are divided by it: no zero.")
    pad_value = preset.pad_value if request.pad_value is None else request.pad_value
    return normalisation, InputFit(size, request.place or preset.place, pad_value)


def _origin(request: ImportRequest, normalisation: Normalisation) -> dict[str, Any]:
    """Where the detector comes from, for the manifest."""
    return {
        "origin": request.model.name,
        "sha256": hashlib.sha256(request.model.read_bytes()).hexdigest(),
        "format": request.format,
        "licence": request.licence,
        "classes": list(request.classes),
        "mean": list(normalisation.mean),
        "std": list(normalisation.std),
        "channels": "bgr" if normalisation.is_bgr else "rgb",
    }


def drawn_image() -> Pixels:
    """A picture with soft ground, edges and colours, the same each time."""
    rng = np.random.default_rng(1)
    width, height = _TEST_IMAGE_SIZE
    image = cv2.resize(rng.integers(60, 160, (9, 16, 3), dtype=np.uint8), (width, height), interpolation=cv2.INTER_CUBIC)
    for left, top, columns, rows in rng.integers([0, 0, 20, 15], [width - 120, height - 80, 120, 80], (12, 4)).tolist():
        color = tuple(int(value) for value in rng.integers(0, 256, 3))
        cv2.rectangle(image, (left, top), (left + columns, top + rows), color, -1)
    return np.asarray(image, dtype=np.uint8)
