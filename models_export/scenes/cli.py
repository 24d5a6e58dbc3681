"""``quadlift scenes``: render datasets and previews with the simulator."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from models_export.scenes.generate import SceneMaker, SceneRequest, new_renderer, render_scene
from models_export.scenes.roads import WORLDS
from service.errors import QuadliftError

app = typer.Typer(no_args_is_help=True, help="Render simulated scenes: training data, clips, previews.")
console = Console(stderr=True)


class World(StrEnum):
    """Worlds on the command line; ``mix`` takes them in turn."""

    INTERSECTION = "intersection"
    STRAIGHT = "straight"
    MIX = "mix"


class Condition(StrEnum):
    """``light.CONDITIONS`` on the command line."""

    DAY = "day"
    OVERCAST = "overcast"
    DUSK = "dusk"


def world_of(world: World, index: int) -> str:
    """The world of the scene number ``index``; a mix has two intersections for each straight road."""
    return str(world.value) if world is not World.MIX else WORLDS[int(index % 3 == 2)]


@app.command()
def render(
    out: Annotated[Path, typer.Option(help="Folder for the scene folders.")],
    world: Annotated[World, typer.Option(help="Which world.")] = World.MIX,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first scene; the next ones count up.")] = 0,
    scenes: Annotated[int, typer.Option(min=1, help="Number of scenes.")] = 1,
    steps: Annotated[int, typer.Option(min=1, help="Frame sets a scene.")] = 10,
    rate_hz: Annotated[float, typer.Option(min=0.01, max=100, help="Frame sets a second of simulated time.")] = 10.0,
    cameras: Annotated[int, typer.Option(min=1, max=8, help="Cameras a scene.")] = 4,
    quality: Annotated[int | None, typer.Option(min=1, max=100, help="JPEG quality; drawn from 75..95 if not given.")] = None,
    vehicles: Annotated[
        int | None, typer.Option(min=0, max=60, help="Vehicles a scene; drawn from 4..25 if not given.")
    ] = None,
    condition: Annotated[Condition | None, typer.Option(help="Light; drawn if not given.")] = None,
) -> None:
    """Render scenes to disk: JPEG, depth, KITTI labels and calibration, site and world boxes."""
    requests = [
        SceneRequest(seed + k, world_of(world, k), steps, rate_hz, cameras, quality, condition, vehicles) for k in range(scenes)
    ]
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    try:
        renderer = new_renderer()
        started = time.perf_counter()
        with Progress(*columns, console=console) as progress, ThreadPoolExecutor(2) as pool:
            task = progress.add_task("images", total=scenes * steps * cameras)
            for request in requests:
                folder = out / f"{request.world}-{request.seed:05d}"
                for step in render_scene(request, folder, renderer, pool):
                    progress.advance(task, len(step.shots))
    except QuadliftError as error:
        console.print(f"[red]{error}")
        raise typer.Exit(1) from error
    seconds = time.perf_counter() - started
    images = scenes * steps * cameras
    console.print(f"{images} images in {seconds:.1f} s: {images / seconds:.1f} images/s, scene set-up and files included")


@app.command()
def preview(
    out: Annotated[Path, typer.Option(help="PNG to write.")],
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first scene.")] = 0,
    scenes: Annotated[int, typer.Option(min=1, max=16, help="Rows of the sheet.")] = 4,
    world: Annotated[World, typer.Option(help="Which world.")] = World.MIX,
) -> None:
    """Write a contact sheet: one row a scene, one column a camera."""
    try:
        renderer = new_renderer()
    except QuadliftError as error:
        console.print(f"[red]{error}")
        raise typer.Exit(1) from error
    rows = []
    for k in range(scenes):
        maker = SceneMaker(SceneRequest(seed + k, world_of(world, k), steps=1), renderer)
        step = next(maker.steps())
        rows.append(
            np.hstack([cv2.resize(shot.image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for shot in step.shots])
        )
    encoded, png = cv2.imencode(".png", cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR))
    assert encoded
    out.write_bytes(png.tobytes())
    console.print(f"wrote {out}")


if __name__ == "__main__":
    app()
