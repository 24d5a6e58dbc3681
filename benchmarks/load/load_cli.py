"""``bench-load``: a steady load, throughput, other ways to serve the same networks, overload, many sites, many cameras."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Coroutine
from typing import Annotated, Any

import typer
from rich.console import Console

from benchmarks.load.open_loop import LoadError
from benchmarks.load.overload import measure_overload
from benchmarks.load.readers import UNREACHABLE
from benchmarks.load.report import Json, finish
from benchmarks.load.scaling import measure_cameras, measure_sites
from benchmarks.load.steady import Via, measure_steady
from benchmarks.load.stream_generator import GeneratorError
from benchmarks.load.throughput import measure_throughput
from clients.client import ServiceError
from clients.clip import ClipError
from clients.local_service import LocalServiceError
from service.errors import QuadliftError

app = typer.Typer(add_completion=False, no_args_is_help=True, help=__doc__)
console = Console(stderr=True)

_FAILURES = (LocalServiceError, ServiceError, ClipError, QuadliftError, GeneratorError, LoadError, *UNREACHABLE)
_WAYS: dict[str, list[Via]] = {"both": ["ws", "http"], "ws": ["ws"], "http": ["http"]}

Seconds = Annotated[float, typer.Option(min=1, help="Time of the measurement, starts aside.")]


@app.command()
def streams(
    via: Annotated[str, typer.Option(help="ws, http or both.")] = "both",
    rate: Annotated[float, typer.Option(min=0.5, max=240, help="Frame sets a second.")] = 30.0,
    seconds: Annotated[float, typer.Option(min=1, help="Time of each way.")] = 600,
    as_json: Json = False,
) -> None:
    """Four cameras at a steady rate: sets lost, latency, memory, threads, files, and the sender's share."""
    if via not in _WAYS:
        raise typer.BadParameter("ws, http or both", param_hint="--via")
    _finish({f"streams_{way}": _run(measure_steady(way, rate, seconds)) for way in _WAYS[via]}, as_json)


@app.command()
def throughput(seconds: Seconds = 80, as_json: Json = False) -> None:
    """The bare loop, the service's workers alone, POST and streams, in turns."""
    _finish({"throughput": _run(measure_throughput(seconds))}, as_json)


@app.command()
def peers(seconds: Seconds = 300, as_json: Json = False) -> None:
    """Plain FastAPI, LitServe and mosec with the same networks, in turns with the service. Needs the extra `dev`."""
    # Its frameworks are no part of the service.
    from benchmarks.load.peers import measure_peers

    _finish({"peers": _run(measure_peers(seconds))}, as_json)


@app.command()
def overload(seconds: Seconds = 120, as_json: Json = False) -> None:
    """Twice and five times what the service can do."""
    _finish({"overload": _run(measure_overload(seconds))}, as_json)


@app.command()
def sites(seconds: Seconds = 240, as_json: Json = False) -> None:
    """The same load from 1 to 32 sites: throughput and fairness."""
    _finish({"sites": _run(measure_sites(seconds))}, as_json)


@app.command()
def cameras(seconds: Seconds = 90, as_json: Json = False) -> None:
    """Sites of 1 to 16 cameras: what a camera costs."""
    _finish({"cameras": _run(measure_cameras(seconds))}, as_json)


def _run(measurement: Coroutine[Any, Any, dict[str, Any]]) -> dict[str, Any]:
    try:
        return asyncio.run(measurement)
    except _FAILURES as error:
        console.print(f"{type(error).__name__}: {error}", style="red", markup=False)
        raise typer.Exit(2) from None


def _finish(figures: dict[str, Any], as_json: bool) -> None:
    finish(figures, as_json, passed=all(part["passed"] for part in figures.values()))


def main() -> None:
    """Console entry point."""
    # As Ctrl-C does: the services that were started are stopped on the way out.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    app()


if __name__ == "__main__":
    main()
