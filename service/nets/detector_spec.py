"""What the ONNX metadata says of a 2D detector: its classes, its input, and the form of its outputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

from service.errors import PackError
from service.nets.canvas import PADDED, InputFit
from service.nets.error_model import ErrorModel

Format = Literal["quadlift", "yolov3", "yolox", "nanodet", "ultralytics", "rtdetr"]
FORMATS: tuple[Format, ...] = get_args(Format)
_ANCHORED: tuple[Format, ...] = ("quadlift", "yolov3")
_STRIDED: tuple[Format, ...] = (*_ANCHORED, "yolox", "nanodet")
_ANY_SIZE: tuple[Format, ...] = _ANCHORED
"""Formats whose outputs tell the canvas' size; the others need a fit of fixed size."""
LAYOUTS: dict[Format, tuple[str, ...]] = {"ultralytics": ("v8", "v5", "end2end"), "rtdetr": ("unit", "pixels")}
"""Variants of a format; ``service.nets.decoding`` says what each means."""
DROPPED = -1
"""In place of a class: boxes of it are left out."""


@dataclass(frozen=True, eq=False)
class DetectorSpec:
    """A detector as its metadata describes it."""

    classes: tuple[str, ...]
    """The pack's classes, which detections are of."""
    strides: tuple[int, ...]
    """Canvas pixels a cell, a scale each; empty where the format has no cells."""
    anchors_px: tuple[tuple[tuple[float, float], ...], ...]
    """Per stride, (width, height) of each anchor in px; empty where the format has no anchors."""
    max_width: int
    """Images are decoded to at most this width, px."""
    sigma_edge_px: ErrorModel
    """Of each edge of a box, px."""
    format: Format = "quadlift"
    """Form of the outputs."""
    layout: str = ""
    """Variant of the format, one of ``LAYOUTS``; empty where it has none."""
    class_of: tuple[int, ...] | None = None
    """Per class of the network, the index in ``classes`` or ``DROPPED``; None: the classes are the network's."""
    cell_center: float = 0.5
    """NanoDet: where in its cell a box's distances begin, cells."""
    is_logit: bool = False
    """NanoDet: the class scores still lack the sigmoid."""
    fit: InputFit = PADDED
    """How the network's canvas is made."""

    @property
    def network_classes(self) -> int:
        """How many classes the network tells apart."""
        return len(self.classes) if self.class_of is None else len(self.class_of)

    @staticmethod
    def from_metadata(metadata: dict[str, Any]) -> DetectorSpec:
        """Read the metadata of an ONNX file. Raises PackError naming what is missing or cannot be."""
        try:
            classes = tuple(metadata["classes"])
            form = metadata.get("format", "quadlift")
            if form not in FORMATS:
                raise ValueError(f"format {form!r} is none of {', '.join(FORMATS)}")
            anchors = metadata["anchors_px"] if form in _ANCHORED else ()
            spec = DetectorSpec(
                classes=classes,
                strides=tuple(int(stride) for stride in metadata["strides"]) if form in _STRIDED else (),
                anchors_px=tuple(tuple((float(w), float(h)) for w, h in scale) for scale in anchors),
                max_width=int(metadata["max_width"]),
                sigma_edge_px=ErrorModel.from_metadata(metadata["sigma_edge_px"]),
                format=form,
                layout=metadata["layout"] if form in LAYOUTS else "",
                class_of=_class_of(metadata, classes),
                cell_center=float(metadata["cell_center"]) if form == "nanodet" else 0.5,
                is_logit=bool(metadata["is_logit"]) if form == "nanodet" else False,
                fit=InputFit.from_metadata(metadata.get("fit")),
            )
            _check(spec)
            return spec
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise PackError(f"metadata is incomplete: {error!r}.", field="detector", remedy="Export the pack again.") from error


def _class_of(metadata: dict[str, Any], classes: tuple[str, ...]) -> tuple[int, ...] | None:
    """From ``network_classes``, a count, and ``class_map``, names of ours by ids of the network's."""
    if "class_map" not in metadata:
        return None
    count = int(metadata["network_classes"])
    ours = {int(key): classes.index(name) for key, name in metadata["class_map"].items()}
    if not ours or not all(0 <= key < count for key in ours):
        raise ValueError(f"class_map {metadata['class_map']!r}: ids must be 0..{count - 1}")
    return tuple(ours.get(key, DROPPED) for key in range(count))


def _check(spec: DetectorSpec) -> None:
    if spec.format in _ANCHORED and len(spec.anchors_px) != len(spec.strides):
        raise ValueError(f"{len(spec.anchors_px)} sets of anchors for {len(spec.strides)} strides")
    if spec.layout not in LAYOUTS.get(spec.format, ("",)):
        raise ValueError(f"layout {spec.layout!r} is none of {', '.join(LAYOUTS[spec.format])}")
    if spec.fit.size is None and spec.format not in _ANY_SIZE:
        raise ValueError(f"format {spec.format} needs a fit of fixed size")
