"""``quadlift scenes``: render datasets, the evaluation set and previews with the simulator."""

from __future__ import annotations

import secrets
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from models_export.scenes.cameras import RIGS
from models_export.scenes.evaluation import (
    SCENES,
    STEPS,
    check_digest,
    drawn_requests,
    evaluation_digest,
    evaluation_folder,
    missing_requests,
)
from models_export.scenes.light import WEATHERS
from models_export.scenes.preview import contact_sheet, write_picture
from models_export.scenes.renderer import Renderer
from models_export.scenes.request import SceneRequest, parse_size, world_of
from models_export.scenes.roads import WORLDS
from models_export.scenes.scenario import SCENARIOS
from models_export.scenes.writer import render_scene
from service.errors import QuadliftError

app = typer.Typer(no_args_is_help=True, help="Render simulated scenes: training data, clips, the evaluation set, previews.")
console = Console(stderr=True)

World = StrEnum("World", {name: name for name in (*WORLDS, "mix")})  # type: ignore[misc]
"""Worlds on the command line; ``mix`` takes them in turn."""
Weather = StrEnum("Weather", {name: name for name in WEATHERS})  # type: ignore[misc]
Scenario = StrEnum("Scenario", {name: name for name in SCENARIOS})  # type: ignore[misc]
Rig = StrEnum("Rig", {name: name for name in (*RIGS, "mix")})  # type: ignore[misc]

WorldOption = Annotated[World, typer.Option(help="Which world.")]
WeatherOption = Annotated[Weather | None, typer.Option(help="Light and weather; drawn if not given.")]
ScenarioOption = Annotated[Scenario | None, typer.Option(help="How hard; everything is drawn if not given.")]
RigOption = Annotated[Rig, typer.Option(help="Camera layout.")]


@app.command()
def render(
    out: Annotated[Path, typer.Option(help="Folder for the scene folders.")],
    world: WorldOption = World.mix,
    scenario: ScenarioOption = None,
    rig: RigOption = Rig.poles,
    weather: WeatherOption = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first scene; the next ones count up.")] = 0,
    scenes: Annotated[int, typer.Option(min=1, help="Number of scenes.")] = 1,
    steps: Annotated[int, typer.Option(min=1, help="Frame sets a scene.")] = 10,
    rate_hz: Annotated[float, typer.Option(min=0.01, max=100, help="Frame sets a second of simulated time.")] = 10.0,
    cameras: Annotated[int, typer.Option(min=1, max=8, help="Cameras a scene.")] = 4,
    size: Annotated[str, typer.Option(help="Picture size such as 1284x384, or mix.")] = "1284x384",
    distorted: Annotated[bool, typer.Option("--distorted", help="Lenses distort.")] = False,
    quality: Annotated[int | None, typer.Option(min=1, max=100, help="JPEG quality; drawn from 30..95 if not given.")] = None,
    vehicles: Annotated[int | None, typer.Option(min=0, max=60, help="Vehicles a scene; drawn if not given.")] = None,
) -> None:
    """Render scenes to disk: JPEG, depth, KITTI labels and calibration, site and world boxes."""
    try:
        requests = [
            SceneRequest(
                seed + k,
                world_of(world.value, k, weather, scenario, rig.value),
                steps,
                rate_hz,
                cameras,
                quality,
                weather and weather.value,
                vehicles,
                scenario and scenario.value,
                RIGS[k % len(RIGS)] if rig is Rig.mix else rig.value,
                parse_size(size),
                distorted,
            )
            for k in range(scenes)
        ]
        for request in requests:
            request.check(reserved=False)
        render_all(requests, [out / f"{r.world}-{r.seed:05d}" for r in requests])
    except QuadliftError as error:
        console.print(f"[red]{error}")
        raise typer.Exit(1) from error


def render_all(requests: Sequence[SceneRequest], folders: Sequence[Path]) -> None:
    """Render scenes into folders with a progress bar, then print the speed. Raises QuadliftError."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    images = sum(r.steps * r.cameras for r in requests)
    renderer = Renderer()
    started = time.perf_counter()
    with Progress(*columns, console=console) as progress, ThreadPoolExecutor(2) as pool:
        task = progress.add_task("images", total=images)
        for request, folder in zip(requests, folders, strict=True):
            for step in render_scene(request, folder, renderer, pool):
                progress.advance(task, len(step.shots))
    seconds = time.perf_counter() - started
    console.print(f"{images} images in {seconds:.1f} s: {images / seconds:.1f} images/s, scene set-up and files included")


@app.command()
def evaluation(
    out: Annotated[Path, typer.Option(help="Cache folder; scenes that it holds already are kept.")],
    scenario: Annotated[Scenario | None, typer.Option(help="Only one of the three sets.")] = None,
    digest: Annotated[bool, typer.Option("--digest", help="Only print this generator's digest.")] = False,
    drawn: Annotated[bool, typer.Option("--random", help="Another set: seeds, worlds and rigs drawn now.")] = False,
    draw: Annotated[int | None, typer.Option(min=0, help="With --random: repeat the draw of this number.")] = None,
    scenes: Annotated[int, typer.Option(min=1, help="With --random: scenes of each scenario.")] = SCENES,
    steps: Annotated[int, typer.Option(min=1, help="With --random: frame sets a scene.")] = STEPS,
) -> None:
    """Render the fixed evaluation set: easy, moderate and hard, 100 frame sets of four cameras each. Or one drawn at random."""
    if digest:
        print(evaluation_digest())
        return
    if drawn:
        number = secrets.randbelow(2**32) if draw is None else draw
        console.print(f"draw {number}: repeat it with --random --draw {number}")
        requests = [r for r in drawn_requests(number, scenes, steps) if scenario in (None, r.scenario)]
        try:
            render_all(requests, [out / evaluation_folder(r) for r in requests])
        except QuadliftError as error:
            console.print(f"[red]{error}")
            raise typer.Exit(1) from error
        return
    try:
        check_digest()
        missing = missing_requests(out, SCENARIOS if scenario is None else (scenario.value,))
        if missing:
            render_all(missing, [out / evaluation_folder(r) for r in missing])
    except QuadliftError as error:
        console.print(f"[red]{error}")
        raise typer.Exit(1) from error
    console.print(f"{out} is complete: {len(missing)} scenes rendered")


@app.command()
def preview(
    out: Annotated[Path, typer.Option(help="PNG or JPG to write.")],
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first scene.")] = 0,
    scenes: Annotated[int, typer.Option(min=1, max=16, help="Rows of the sheet.")] = 4,
    world: WorldOption = World.mix,
    weather: WeatherOption = None,
    scenario: ScenarioOption = None,
    rig: RigOption = Rig.poles,
    cameras: Annotated[int, typer.Option(min=1, max=8, help="Columns of the sheet.")] = 4,
    scale: Annotated[float, typer.Option(min=0.1, max=1, help="Size of each picture.")] = 0.5,
    distorted: Annotated[bool, typer.Option("--distorted", help="Lenses distort.")] = False,
    boxes: Annotated[bool, typer.Option("--boxes", help="Draw the labelled boxes.")] = False,
) -> None:
    """Write a contact sheet: one row a scene, one column a camera, as the cameras would deliver them."""
    try:
        requests = [
            SceneRequest(
                seed + k,
                world_of(world.value, k, weather, scenario, rig.value),
                steps=1,
                cameras=cameras,
                weather=weather and weather.value,
                scenario=scenario and scenario.value,
                rig=RIGS[k % len(RIGS)] if rig is Rig.mix else rig.value,
                distorted=distorted,
            )
            for k in range(scenes)
        ]
        write_picture(out, contact_sheet(requests, Renderer(), scale, boxes=boxes))
    except QuadliftError as error:
        console.print(f"[red]{error}")
        raise typer.Exit(1) from error
    console.print(f"wrote {out}")


if __name__ == "__main__":
    app()
