"""``quadlift carla``: capture scenes from a CARLA server."""

from __future__ import annotations

import signal
from contextlib import closing
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar

from models_export.data.carla_capture import CaptureRequest, Progress, capture
from models_export.data.carla_rig import load_rig
from models_export.data.carla_session import ServerOptions, import_carla
from models_export.data.carla_weather import Weather
from service.errors import QuadliftError

app = typer.Typer(no_args_is_help=True, help="Capture scenes from a CARLA server.")
console = Console(stderr=True)
_INTERRUPTED = 130


@app.callback()
def main() -> None:
    """Capture scenes from a CARLA server."""


@app.command("capture")
def capture_command(
    rig: Annotated[Path, typer.Option(help="Rig file: the cameras, and where they stand in the map.")],
    out: Annotated[Path, typer.Option(help="Folder of the new scene.")],
    map_name: Annotated[str | None, typer.Option("--map", help="Map to load; the rig's, else the one shown.")] = None,
    steps: Annotated[int, typer.Option(min=1, help="Frame sets.")] = CaptureRequest.steps,
    rate_hz: Annotated[float, typer.Option(min=0.1, max=100, help="Frame sets a simulated second.")] = CaptureRequest.rate_hz,
    weather: Annotated[Weather, typer.Option(help="Weather.")] = CaptureRequest.weather,
    vehicles: Annotated[int, typer.Option(min=0, max=500, help="Vehicles near the rig.")] = CaptureRequest.vehicles,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of the traffic.")] = CaptureRequest.seed,
    warmup_s: Annotated[float, typer.Option(min=0, help="Simulated seconds before the first.")] = CaptureRequest.warmup_s,
    quality: Annotated[int, typer.Option(min=1, max=100, help="JPEG quality.")] = CaptureRequest.quality,
    host: Annotated[str, typer.Option(help="The server's host.")] = ServerOptions.host,
    port: Annotated[int, typer.Option(min=1, max=65535, help="The server's port.")] = ServerOptions.port,
    traffic_port: Annotated[
        int, typer.Option(min=1, max=65535, help="Port for the traffic manager.")
    ] = ServerOptions.traffic_port,
    timeout: Annotated[float, typer.Option(min=0.1, help="Seconds to wait for an answer.")] = ServerOptions.timeout_s,
    picture_timeout: Annotated[
        float, typer.Option(min=0.1, help="Seconds to wait for a frame's pictures.")
    ] = ServerOptions.picture_timeout_s,
) -> None:
    """Capture one scene: JPEG, depth, KITTI labels and calibration, site and world boxes."""
    options = ServerOptions(host, port, traffic_port, timeout, picture_timeout)
    request = CaptureRequest(steps, rate_hz, weather, vehicles, seed, warmup_s, quality, map_name)
    # A capture that is told to stop must still restore the server, which else waits for ticks for ever.
    before = signal.signal(signal.SIGTERM, _interrupt)
    last = None
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    try:
        found = load_rig(rig)
        with (
            ProgressBar(*columns, console=console) as bar,
            closing(capture(import_carla(), options, found, request, out)) as course,
        ):
            task = bar.add_task("frame sets", total=steps)
            for last in course:
                bar.update(task, completed=last.written)
    except QuadliftError as error:
        console.print(f"[red]{escape(str(error))}", highlight=False, soft_wrap=True)
        console.print(_summary(last, out))
        raise typer.Exit(1) from error
    except KeyboardInterrupt:
        console.print(f"interrupted; the server is as it was found. {_summary(last, out)}")
        raise typer.Exit(_INTERRUPTED) from None
    finally:
        signal.signal(signal.SIGTERM, before)
    console.print(_summary(last, out))


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _summary(progress: Progress | None, out: Path) -> str:
    if progress is None:
        return "Nothing was written."
    return (
        f"{progress.written} frame sets in {out}; {progress.dropped} dropped for missing pictures; "
        f"{progress.vehicles} vehicles spawned; {progress.without_box} actors without a bounding box left out."
    )


if __name__ == "__main__":
    app()
