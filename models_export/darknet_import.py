"""``quadlift import-darknet``: a pack around YOLOv3 or YOLOv3-tiny weights in Darknet's own file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console

from models_export.darknet_weights import read_weights
from models_export.detector_pack import UNMEASURED_EDGE_SIGMA, class_map, network_classes, write_detector_pack
from models_export.export import Exported, to_onnx, with_metadata
from models_export.nets.blocks import parameter_count
from models_export.nets.yolov3 import Yolov3, Yolov3Config, tiny_config
from models_export.verify import require_parity
from service.errors import InputError, QuadliftError
from service.nets.pack import Manifest, load_pack, open_network

app = typer.Typer(help="A pack around YOLOv3 weights in Darknet's file.")
console = Console()
_EXAMPLE_HW = (96, 160)
_PARITY_SHAPES = ((2, 96, 160, 3), (1, 160, 64, 3))


def import_darknet(
    weights: Path, config: Yolov3Config, out: Path, *, base: str = "edge", renamed: Mapping[str, str] | None = None
) -> Manifest:
    """Read a weight file, export the network, and write a pack with it as detector and pack ``base`` for the rest.

    config: the network as it was trained, with its own classes. renamed: names of the base pack's classes by names of the
    network's, beside those that both have. Raises InputError for a file that does not fit, PackError when ONNX Runtime and
    torch disagree.
    """
    manifest = load_pack(base).manifest
    classes = manifest.classes
    mapped = class_map(config.classes, classes, renamed or {})
    net = Yolov3(config).eval()
    seen = read_weights(net, weights)
    metadata = {**metadata_of(config), "classes": classes, "network_classes": len(config.classes), "class_map": mapped}
    model = with_metadata(to_onnx(net, "detector", _EXAMPLE_HW, config.outputs, dynamic_hw=True), metadata)
    difference = require_parity(net, open_network("detector", model), [_pictures(shape) for shape in _PARITY_SHAPES])
    return write_detector_pack(
        out,
        base,
        Exported("detector", model, "fp32", parameter_count(net)),
        name=weights.stem,
        licence=f"detector: as its weights; the rest: {manifest.licence}",
        training={"darknet": weights.name, "images_seen": seen, "classes": list(config.classes)},
        scores={"parity_with_torch": float(f"{difference:.2e}")},
    )


def metadata_of(config: Yolov3Config) -> dict[str, Any]:
    """What the service needs to know to decode the network's heads as Darknet does."""
    return {
        "format": "yolov3",
        "classes": list(config.classes),
        "strides": list(config.strides),
        "anchors_px": config.anchors_px,
        "max_width": config.max_width,
        "sigma_edge_px": list(UNMEASURED_EDGE_SIGMA),
    }


def config_of(metadata: Mapping[str, Any]) -> Yolov3Config:
    """The published network that an imported detector's metadata describes; its classes are numbered."""
    strides = tuple(metadata["strides"])
    return Yolov3Config(
        classes=tuple(str(number) for number in range(metadata["network_classes"])),
        strides=strides,
        anchors_px=tuple(tuple((float(w), float(h)) for w, h in scale) for scale in metadata["anchors_px"]),
        max_width=metadata["max_width"],
        residuals=tiny_config().residuals if strides == tiny_config().strides else Yolov3Config().residuals,
    )


def parse_anchors(text: str, scales: int) -> tuple[tuple[tuple[float, float], ...], ...]:
    """Anchors from a cfg's line ``10,13, 16,30, ...``, smallest first, shared out over the scales, finest first."""
    try:
        sides = np.array([float(word) for word in text.split(",")]).reshape(scales, -1, 2)
    except ValueError:
        raise InputError(
            f"'{text}'.", field="anchors", remedy=f"Give widths and heights with commas, as many a scale ({scales} scales)."
        ) from None
    return tuple(tuple((float(w), float(h)) for w, h in scale) for scale in sides)


@app.command()
def command(
    weights: Annotated[Path, typer.Argument(help="Darknet .weights file.")],
    out: Annotated[Path, typer.Option(help="Folder of the pack.")],
    tiny: Annotated[bool, typer.Option("--tiny/--yolov3", help="YOLOv3-tiny, or YOLOv3.")] = False,
    classes: Annotated[str, typer.Option(help="'coco', a file of names, or names with commas, in order.")] = "coco",
    renames: Annotated[list[str] | None, typer.Option("--map", help="THEIRS=OURS, e.g. truck=car. Repeatable.")] = None,
    anchors: Annotated[str | None, typer.Option(help="Anchors as in the cfg; those of the COCO weights if left out.")] = None,
    max_width: Annotated[int, typer.Option(min=32, help="Widest image that the detector is given, px.")] = 416,
    base: Annotated[str, typer.Option(help="Pack whose other networks are taken.")] = "edge",
) -> None:
    """Write a pack whose detector is YOLOv3 or YOLOv3-tiny with weights from Darknet."""
    try:
        config = replace(tiny_config() if tiny else Yolov3Config(), classes=network_classes(classes), max_width=max_width)
        if anchors is not None:
            config = replace(config, anchors_px=parse_anchors(anchors, len(config.strides)))
        manifest = import_darknet(weights, config, out, base=base, renamed=parse_renames(renames or []))
    except QuadliftError as error:
        console.print(f"[red]{error}[/red]")
        raise typer.Exit(1) from None
    entry = manifest.networks["detector"]
    console.print(f"pack '{manifest.name}' in {out}: {entry.parameters:,} parameters; {manifest.scores['detector']}")


def parse_renames(words: list[str]) -> dict[str, str]:
    """``THEIRS=OURS`` words as a mapping. Raises InputError."""
    pairs = [word.partition("=") for word in words]
    if not all(theirs and ours for theirs, _, ours in pairs):
        raise InputError(f"{words}.", field="map", remedy="Write THEIRS=OURS, e.g. truck=car.")
    return {theirs: ours for theirs, _, ours in pairs}


def _pictures(shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Smooth shapes with noise: what a frame looks like to a convolution."""
    batch, height, width, _ = shape
    y, x = np.mgrid[:height, :width]
    smooth = 90 + 60 * np.sin(x / 23.0) + 40 * (y > height / 2)
    noise = np.random.default_rng(height).normal(0, 6, (batch, height, width, 3))
    return np.clip(smooth[None, ..., None] + noise, 0, 255).astype(np.uint8)
