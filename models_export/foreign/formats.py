"""What each format's networks expect and give: presets of the input, and outputs told apart by their shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from models_export.foreign.graph import Normalisation
from models_export.nets.yolov3 import Yolov3Config, tiny_config
from service.errors import InputError
from service.nets.decoding import BOX_FIELDS
from service.nets.detector_spec import Format

_DARKNET_ANCHORS = {
    len(config.strides): [[list(pair) for pair in scale] for scale in config.anchors_px]
    for config in (Yolov3Config(), tiny_config())
}
"""Published anchors of YOLOv3 and YOLOv3-tiny, px, by the number of scales."""
_STRIDES = ((8, 16, 32), (8, 16, 32, 64))
_NANODET_PLUS_SCALES = 4
_LEAST_BINS = 2


@dataclass(frozen=True)
class Preset:
    """How a format's networks want their pictures, unless their author changed it."""

    normalisation: Normalisation
    place: Literal["corner", "center"]
    pad_value: int


PRESETS: dict[Format, Preset] = {
    "yolov3": Preset(Normalisation(), "center", 127),
    "yolox": Preset(Normalisation(std=(1.0, 1.0, 1.0), is_bgr=True), "corner", 114),
    "nanodet": Preset(Normalisation((103.53, 116.28, 123.675), (57.375, 57.12, 58.395), is_bgr=True), "corner", 0),
    "ultralytics": Preset(Normalisation(), "center", 114),
    "rtdetr": Preset(Normalisation(), "center", 114),
}


@dataclass(frozen=True, eq=False)
class Output:
    """One output of a network for one image."""

    name: str
    values: NDArray[np.generic]
    """Without the batch dimension."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Of ``values``."""
        return self.values.shape


@dataclass(frozen=True, eq=False)
class Reading:
    """What a network's outputs are."""

    outputs: tuple[str, ...]
    """Names in the order in which ``service.nets.decoding`` takes them."""
    metadata: dict[str, Any] = field(default_factory=dict)
    """The format's own fields."""


@dataclass(frozen=True, eq=False)
class Question:
    """A network whose outputs are to be read."""

    outputs: Sequence[Output]
    classes: int
    size: tuple[int, int]
    """Width and height of the input, px."""
    has_size_input: bool = False
    layout: str | None = None
    """The user's word where shapes leave it open."""
    anchors_px: list[list[list[int]]] | None = None
    cell_center: float | None = None

    def refused(self, expected: str, remedy: str = "Check --format and --classes.") -> InputError:
        """An error that shows what there is beside what was expected."""
        shapes = ", ".join(f"{output.name} {output.shape}" for output in self.outputs)
        return InputError(f"outputs for one image are {shapes}; expected {expected}.", field="outputs", remedy=remedy)


def read_outputs(form: Format, question: Question) -> Reading:
    """Tell what a network's outputs are. Raises InputError where they do not fit the format."""
    return _READERS[form](question)


def _yolov3(q: Question) -> Reading:
    heads = sorted(q.outputs, key=lambda output: -output.values.size)
    fields = BOX_FIELDS + q.classes
    expected = f"heads (A * {fields}, h, w) of whole strides"
    if not all(len(head.shape) == 3 and head.shape[0] % fields == 0 for head in heads):
        raise q.refused(expected)
    strides = [q.size[1] // head.shape[1] for head in heads]
    if any((head.shape[1] * s, head.shape[2] * s) != q.size[::-1] for head, s in zip(heads, strides, strict=True)):
        raise q.refused(expected)
    anchors = q.anchors_px or _DARKNET_ANCHORS.get(len(heads))
    counts = [head.shape[0] // fields for head in heads]
    if anchors is None or [len(scale) for scale in anchors] != counts:
        raise q.refused(
            f"as many anchors as the heads have ({counts})",
            "Give --anchors, a group a scale, finest first: '10,13 16,30 / ...'.",
        )
    return Reading(_names(heads), {"strides": strides, "anchors_px": anchors})


def _yolox(q: Question) -> Reading:
    if len(q.outputs) != 1 or len(q.outputs[0].shape) != 2 or q.outputs[0].shape[1] != BOX_FIELDS + q.classes:
        raise q.refused(f"one (N, {BOX_FIELDS + q.classes})")
    strides = _strides_of_cells(q, q.outputs[0].shape[0])
    _require_probabilities(q, q.outputs[0].values[:, 4:])
    return Reading(_names(q.outputs), {"strides": strides})


def _nanodet(q: Question) -> Reading:
    if not all(len(output.shape) == 2 for output in q.outputs):
        raise q.refused("outputs (N, ...)")
    if len(q.outputs) == 1:
        ordered, scores = list(q.outputs), q.outputs[0].values[:, : q.classes]
        width, strides = q.outputs[0].shape[1] - q.classes, _strides_of_cells(q, q.outputs[0].shape[0])
    else:
        ordered, strides, width = _nanodet_scales(q)
        scores = np.concatenate([output.values for output in ordered[: len(strides)]])
    if width % 4 or width < 4 * _LEAST_BINS:
        raise q.refused(f"{q.classes} class scores and 4 x B distances, not {width}")
    # NanoDet-Plus has a fourth scale, and measures from a cell's corner; the others from its middle.
    center = 0.0 if len(strides) == _NANODET_PLUS_SCALES else 0.5
    fields = {"cell_center": center if q.cell_center is None else q.cell_center, "is_logit": not _are_probabilities(scores)}
    return Reading(_names(ordered), {"strides": strides, **fields})


def _nanodet_scales(q: Question) -> tuple[list[Output], list[int], int]:
    """Outputs in order, strides, and columns of distances, from a pair of outputs a stride."""
    by_cells = sorted(q.outputs, key=lambda output: -output.shape[0])
    scores = [output for output in by_cells if output.shape[1] == q.classes]
    distances = [output for output in by_cells if output.shape[1] != q.classes]
    widths = {output.shape[1] for output in distances}
    if len(widths) != 1 or [o.shape[0] for o in scores] != [o.shape[0] for o in distances]:
        raise q.refused(f"a stride, scores (n, {q.classes}) and distances (n, 4 B)")
    strides = _strides_of_cells(q, sum(output.shape[0] for output in scores))
    return [*scores, *distances], strides, widths.pop()


def _ultralytics(q: Question) -> Reading:
    if len(q.outputs) != 1 or len(q.outputs[0].shape) != 2:
        raise q.refused("one output of two dimensions")
    rows, columns = q.outputs[0].shape
    fits = {"v8": rows == 4 + q.classes, "v5": columns == BOX_FIELDS + q.classes, "end2end": columns == 6}
    possible = [layout for layout, fit in fits.items() if fit and q.layout in (None, layout)]
    if len(possible) != 1:
        raise q.refused(
            f"({4 + q.classes}, N) for v8, (N, {BOX_FIELDS + q.classes}) for v5, or (N, 6) for end2end",
            "Check --classes; where several fit, say which by --layout." if possible else "Check --format and --classes.",
        )
    values = q.outputs[0].values
    _require_probabilities(q, {"v8": values[4:], "v5": values[:, 4:], "end2end": values[:, 4]}[possible[0]])
    return Reading(_names(q.outputs), {"layout": possible[0]})


def _rtdetr(q: Question) -> Reading:
    if len(q.outputs) == 1:
        if len(q.outputs[0].shape) != 2 or q.outputs[0].shape[1] != 4 + q.classes:
            raise q.refused(f"one (N, {4 + q.classes}), or labels, boxes and scores")
        _require_probabilities(q, q.outputs[0].values[:, 4:])
        return Reading(_names(q.outputs), {"layout": "unit"})
    boxes = [output for output in q.outputs if output.shape[1:] == (4,)]
    flat = [output for output in q.outputs if len(output.shape) == 1]
    # Labels are whole numbers, if not by type then by place: they come first.
    flat.sort(key=lambda output: not np.issubdtype(output.values.dtype, np.integer))
    if len(q.outputs) != 3 or len(boxes) != 1 or len(flat) != 2:
        raise q.refused("labels (N,), boxes (N, 4) and scores (N,)")
    _require_probabilities(q, flat[1].values)
    return Reading(_names([flat[0], boxes[0], flat[1]]), {"layout": "pixels" if q.has_size_input else "unit"})


_READERS = {"yolov3": _yolov3, "yolox": _yolox, "nanodet": _nanodet, "ultralytics": _ultralytics, "rtdetr": _rtdetr}


def _strides_of_cells(q: Question, cells: int) -> list[int]:
    """The strides whose cells on the input are so many."""
    counts = {strides: sum(-(-q.size[0] // s) * -(-q.size[1] // s) for s in strides) for strides in _STRIDES}
    for strides, count in counts.items():
        if count == cells:
            return list(strides)
    known = " or ".join(f"{count} (strides {'/'.join(map(str, strides))})" for strides, count in counts.items())
    raise q.refused(f"{known} cells on {q.size[0]}x{q.size[1]} px")


def _require_probabilities(q: Question, scores: NDArray[np.generic]) -> None:
    if not _are_probabilities(scores):
        raise q.refused(
            f"scores in 0..1, not {float(scores.min()):.2f}..{float(scores.max()):.2f}",
            "Export the model with its sigmoid, and check --format.",
        )


def _are_probabilities(scores: NDArray[np.generic]) -> bool:
    return bool(scores.min() >= 0.0 and scores.max() <= 1.0)


def _names(outputs: Sequence[Output]) -> tuple[str, ...]:
    return tuple(output.name for output in outputs)


def read_anchors(text: str) -> list[list[list[int]]]:
    """Anchors from ``'10,13 16,30 / 30,61 62,45'``: a group a scale, finest first. Raises InputError."""
    try:
        return [[[int(side) for side in pair.split(",", 1)] for pair in scale.split()] for scale in text.split("/")]
    except ValueError:
        raise InputError(f"'{text}'", field="--anchors", remedy="Write '10,13 16,30 / 30,61 62,45', in px.") from None
