"""``quadlift import-darknet``: a pack around YOLOv3 or YOLOv3-tiny weights in Darknet's own file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from models_export.darknet_weights import read_weights
from models_export.detector_pack import open_base, write_detector_pack
from models_export.export import Exported, to_onnx, with_metadata
from models_export.foreign.formats import read_anchors
from models_export.foreign.names import class_ids, read_class_map, read_classes
from models_export.import_detector import UNKNOWN_LICENCE, drawn_image
from models_export.metadata import detector_metadata
from models_export.nets.blocks import parameter_count
from models_export.nets.yolov3 import Yolov3, Yolov3Config, tiny_config
from models_export.verify import require_parity
from service.errors import InputError, QuadliftError
from service.nets.canvas import to_canvas
from service.nets.pack import Manifest, open_network

app = typer.Typer(help="A pack around YOLOv3 weights in Darknet's file.")
console = Console()
_EXAMPLE_HW = (96, 160)
_PARITY_HW = ((96, 160), (160, 64))


def import_darknet(
    weights: Path,
    config: Yolov3Config,
    out: Path,
    *,
    base: str = "edge",
    renamed: Mapping[str, str] | None = None,
    licence: str = UNKNOWN_LICENCE,
) -> Manifest:
    """Read a weight file, export the network, and write a pack with it as detector and pack ``base`` for the rest.

    config: the network as it was trained, with its own classes. renamed: the base pack's classes by the network's; empty: equal
    names. licence: of the weights. Raises InputError for a file that does not fit, PackError when ONNX Runtime and torch
    disagree.
    """
    pack = open_base(base, out)
    ids = class_ids(config.classes, pack.manifest.classes, renamed or {})
    net = Yolov3(config).eval()
    seen = read_weights(net, weights)
    metadata = {
        **yolov3_metadata(config),
        "classes": pack.manifest.classes,
        "network_classes": len(config.classes),
        "class_map": {str(index): name for index, name in ids.items()},
        "sigma_edge_px": pack.networks["detector"].metadata["sigma_edge_px"],
    }
    model = with_metadata(to_onnx(net, "detector", _EXAMPLE_HW, config.outputs, dynamic_hw=True), metadata)
    canvases = [to_canvas(drawn_image())[None, :height, :width] for height, width in _PARITY_HW]
    difference = require_parity(net, open_network("detector", model), canvases)
    return write_detector_pack(
        out,
        pack,
        Exported("detector", model, "fp32", parameter_count(net)),
        licence=licence,
        origin={"origin": weights.name, "images_seen": seen, "classes": list(config.classes)},
        scores={"parity_with_torch": float(f"{difference:.2e}")},
    )


def yolov3_metadata(config: Yolov3Config) -> dict[str, Any]:
    """What the service needs to know to decode the network's heads as Darknet does, its errors aside."""
    return {**detector_metadata(config), "format": "yolov3"}


def config_of(metadata: Mapping[str, Any]) -> Yolov3Config:
    """The published network that an imported detector's metadata describes; its classes are numbered."""
    strides = tuple(metadata["strides"])
    return Yolov3Config(
        classes=tuple(str(number) for number in range(metadata["network_classes"])),
        strides=strides,
        anchors_px=as_tuples(metadata["anchors_px"], len(strides)),
        max_width=metadata["max_width"],
        residuals=tiny_config().residuals if strides == tiny_config().strides else Yolov3Config().residuals,
    )


def as_tuples(anchors: Sequence[Sequence[Sequence[float]]], scales: int) -> tuple[tuple[tuple[float, float], ...], ...]:
    """Anchors as a configuration has them. Raises InputError unless every scale has as many."""
    if len(anchors) != scales or len({len(scale) for scale in anchors}) != 1:
        counts = [len(scale) for scale in anchors]
        raise InputError(f"{counts} anchors a scale.", field="--anchors", remedy=f"Give as many for each of {scales} scales.")
    return tuple(tuple((float(width), float(height)) for width, height in scale) for scale in anchors)


@app.command()
def command(
    weights: Annotated[Path, typer.Argument(help="Darknet .weights file.")],
    out: Annotated[Path, typer.Option(help="Folder of the pack.")],
    tiny: Annotated[bool, typer.Option("--tiny/--yolov3", help="YOLOv3-tiny, or YOLOv3.")] = False,
    classes: Annotated[str, typer.Option(help="Its classes in order: a,b,c, a text file with one a line, or 'coco'.")] = "coco",
    class_map: Annotated[
        list[str] | None, typer.Option(help="theirs=ours[,theirs=ours...]; equal names if left out. Repeatable.")
    ] = None,
    anchors: Annotated[
        str | None, typer.Option(help="'10,13 16,30 / 30,61 62,45', finest scale first, px; COCO's if left out.")
    ] = None,
    max_width: Annotated[int, typer.Option(min=32, help="Widest image that the detector is given, px.")] = 416,
    base: Annotated[str, typer.Option(help="Pack that gives the other networks.")] = "edge",
    licence: Annotated[str, typer.Option(help="Of the weights.")] = UNKNOWN_LICENCE,
) -> None:
    """Write a pack whose detector is YOLOv3 or YOLOv3-tiny with weights from Darknet."""
    try:
        config = replace(tiny_config() if tiny else Yolov3Config(), classes=read_classes(classes), max_width=max_width)
        if anchors is not None:
            config = replace(config, anchors_px=as_tuples(read_anchors(anchors), len(config.strides)))
        renamed = read_class_map(class_map or [])
        manifest = import_darknet(weights, config, out, base=base, renamed=renamed, licence=licence)
    except QuadliftError as error:
        console.print(f"[red]{escape(str(error))}[/red]")
        raise typer.Exit(1) from None
    entry = manifest.networks["detector"]
    console.print(f"pack '{manifest.name}' in {out}: {entry.parameters:,} parameters; {manifest.scores['detector']}")
