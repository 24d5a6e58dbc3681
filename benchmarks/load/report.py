"""How a measurement's figures are printed, and how its command ends."""

from __future__ import annotations

import json
import math
from typing import Annotated, Any

import typer
from rich.console import Console

from benchmarks.machine import describe_machine

Json = Annotated[bool, typer.Option("--json", help="Print JSON alone.")]


def finish(figures: dict[str, Any], as_json: bool, *, passed: bool) -> None:
    """Print, and end with 1 where a limit was not kept."""
    figures = plain(figures | {"machine": describe_machine(), "passed": passed})
    if as_json:
        typer.echo(json.dumps(figures, indent=1))
    else:
        Console().print_json(data=figures)
    if not passed:
        raise typer.Exit(1)


def plain(value: Any) -> Any:
    """The same without NaN and infinities, which JSON has not: what could not be measured is null."""
    if isinstance(value, dict):
        return {key: plain(part) for key, part in value.items()}
    if isinstance(value, list):
        return [plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
