"""Command line ``quadlift import-detector``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape

from models_export.foreign.formats import read_anchors
from models_export.foreign.names import read_class_map, read_classes
from models_export.import_detector import UNKNOWN_LICENCE, ImportRequest, import_detector
from service.errors import InputError, QuadliftError
from service.nets.error_model import ErrorModel

app = typer.Typer(help="Wrap an ONNX detector of your own into a pack.")
console = Console()

Triple = tuple[float, float, float]


@app.command()
def import_command(
    model: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="The detector's ONNX file.")],
    form: Annotated[
        Literal["yolov3", "yolox", "nanodet", "ultralytics", "rtdetr"], typer.Option("--format", help="Form of its outputs.")
    ],
    classes: Annotated[str, typer.Option(help="Its classes in order: a,b,c, a text file with one a line, or 'coco'.")],
    out: Annotated[Path, typer.Option(help="Folder of the new pack.")],
    class_map: Annotated[
        list[str] | None, typer.Option(help="theirs=ours[,theirs=ours...]; equal names if left out. Repeatable.")
    ] = None,
    base: Annotated[str, typer.Option(help="Pack that gives the other networks.")] = "edge",
    size: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT of the input, where the file leaves it open.")] = None,
    mean: Annotated[str | None, typer.Option(help="Three numbers of 0..255, in the network's channel order.")] = None,
    std: Annotated[str | None, typer.Option(help="Three numbers of 0..255, in the network's channel order.")] = None,
    channels: Annotated[Literal["rgb", "bgr"] | None, typer.Option(help="Order of the network's channels.")] = None,
    place: Annotated[Literal["corner", "center"] | None, typer.Option(help="Where the picture lies on the input.")] = None,
    pad: Annotated[int | None, typer.Option(min=0, max=255, help="Grey of the rest of the input.")] = None,
    layout: Annotated[str | None, typer.Option(help="v8, v5 or end2end, where shapes leave it open.")] = None,
    anchors: Annotated[str | None, typer.Option(help="YOLOv3: '10,13 16,30 / 30,61 62,45', finest scale first, px.")] = None,
    cell_center: Annotated[float | None, typer.Option(help="NanoDet: 0.5, or 0 for NanoDet-Plus.")] = None,
    sigma_edge: Annotated[
        str | None, typer.Option(help="Errors of box edges: floor,slope,growth,cut; the base detector's if left out.")
    ] = None,
    licence: Annotated[str, typer.Option(help="Of the model.")] = UNKNOWN_LICENCE,
    image: Annotated[Path | None, typer.Option(exists=True, dir_okay=False, help="A picture for the checks.")] = None,
) -> None:
    """Wrap an ONNX detector into a pack: presets of its format, overridden by options; checked against the model itself."""
    try:
        request = ImportRequest(
            model=model,
            format=form,
            out=out,
            classes=read_classes(classes),
            class_map=read_class_map(class_map or []),
            base=base,
            size=None if size is None else _read_size(size),
            mean=_read_triple(mean, "--mean"),
            std=_read_triple(std, "--std"),
            is_bgr=None if channels is None else channels == "bgr",
            place=place,
            pad_value=pad,
            layout=layout,
            anchors_px=None if anchors is None else read_anchors(anchors),
            cell_center=cell_center,
            sigma_edge_px=None if sigma_edge is None else _read_sigma(sigma_edge),
            licence=licence,
            image=None if image is None else _read_image(image),
        )
        manifest = import_detector(request)
    except QuadliftError as error:
        console.print(f"[red]{escape(str(error))}[/red]")
        raise typer.Exit(1) from None
    entry = manifest.networks["detector"]
    console.print(
        f"pack '{manifest.name}' in {out}: detector {entry.precision}, {entry.parameters} parameters,"
        f" differs by {manifest.scores['detector']['parity_with_original']:.0e} of its range from the model itself"
    )


def _read_size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise InputError(f"'{text}'", field="--size", remedy="Write WIDTHxHEIGHT, as in 640x384.")
    return int(width), int(height)


def _read_triple(text: str | None, name: str) -> Triple | None:
    if text is None:
        return None
    first, second, third = _read_numbers(text, name, 3)
    return first, second, third


def _read_sigma(text: str) -> ErrorModel:
    try:
        return ErrorModel.from_metadata(_read_numbers(text, "--sigma-edge", 4))
    except ValueError as error:
        raise InputError(str(error), field="--sigma-edge") from None


def _read_numbers(text: str, name: str, count: int) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise InputError(f"'{text}'", field=name, remedy=f"Write {count} numbers, separated by commas.")
    return numbers


def _read_image(path: Path) -> NDArray[np.uint8]:
    image: Any = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
    if image is None:
        raise InputError("not a picture.", field="--image", remedy="Give a JPEG or PNG file.")
    return np.asarray(image, dtype=np.uint8)


if __name__ == "__main__":
    app()
