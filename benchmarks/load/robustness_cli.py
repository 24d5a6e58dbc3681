"""``bench-robust``: the service with slow readers, under faults, and under attack."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer
from rich.console import Console

from benchmarks.load.parser_fuzz import fuzz_parsers
from benchmarks.machine import describe_machine

app = typer.Typer(add_completion=False, no_args_is_help=True, help=__doc__)
console = Console(stderr=True)

Json = Annotated[bool, typer.Option("--json", help="Print JSON alone.")]


@app.command()
def attacks(
    runs: Annotated[int, typer.Option(min=1, help="Runs of the parsers' fuzzers, all together.")] = 1_000_000,
    seconds: Annotated[float, typer.Option(min=1, help="Time of the parsers' fuzzers at most.")] = 900.0,
    seed: Annotated[int, typer.Option(min=0, help="Of the fuzzers.")] = 1,
    as_json: Json = False,
) -> None:
    """Fuzz the parsers."""
    figures: dict[str, Any] = {"parsers": fuzz_parsers(runs, seconds, seed)}
    _finish(figures, as_json, failed=figures["parsers"]["crashes"] > 0)


def _finish(figures: dict[str, Any], as_json: bool, *, failed: bool) -> None:
    figures = figures | {"machine": describe_machine()}
    if as_json:
        typer.echo(json.dumps(figures, indent=1))
    else:
        Console().print_json(data=figures)
    if failed:
        raise typer.Exit(1)


def main() -> None:
    """Console entry point."""
    app()


if __name__ == "__main__":
    main()
