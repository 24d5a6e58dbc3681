"""Command line ``quadlift teach``."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from models_export.data import roadside_train, traffic_videos
from models_export.data.detection import decode_picture
from models_export.data.nanodet import WEIGHTS, open_nanodet
from models_export.data.teacher import Candidates, candidates, read_candidates, write_candidates
from service.errors import QuadliftError

app = typer.Typer(help="Pseudo labels of real pictures by a public detector.")
console = Console()
MAX_WIDTH = 1280
"""Pictures are decoded to at most this width for the teacher, px: its tiles want more than the pupil gets."""
_SAVE_EVERY = 25


@app.callback(invoke_without_command=True)
def teach(
    data: Annotated[Path, typer.Option(help="Folder of the recordings and of the teacher's weights.")],
    out: Annotated[Path, typer.Option(help="JSON file of what the teacher saw. Pictures in it already are left alone.")],
) -> None:
    """Look at the roadside frames that train and at the traffic videos, and write down where vehicles seem to be."""
    try:
        seen = read_candidates(out) if out.exists() else {}
        _teach(data, out, seen)
    except QuadliftError as error:
        console.print(f"[red]{error}[/red]")
        raise typer.Exit(2) from None
    console.print(f"{len(seen)} pictures, {sum(len(c.score) for c in seen.values())} candidates in {out}")


def _teach(data: Path, out: Path, seen: dict[str, Candidates]) -> None:
    teacher = open_nanodet(data / WEIGHTS)
    new = 0
    for name, picture in _pictures(data):
        if name in seen:
            continue
        seen[name] = candidates(teacher, decode_picture(picture, MAX_WIDTH, name))
        new += 1
        if new % _SAVE_EVERY == 0:
            write_candidates(out, seen)
    write_candidates(out, seen)


def _pictures(data: Path) -> Iterator[tuple[str, bytes]]:
    yield from traffic_videos.read_frames(data / traffic_videos.ARCHIVE)
    archive = data / roadside_train.ARCHIVE
    with zipfile.ZipFile(archive) as stored:
        for frame in roadside_train.read_frames(archive):
            if frame.clip not in roadside_train.VALIDATION_CLIPS:
                yield frame.image, stored.read(frame.image)


if __name__ == "__main__":
    app()
