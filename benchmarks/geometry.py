"""``bench-geometry``: how exact lifting, fusion and tracking are, and how long they take, on real and simulated geometry."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from benchmarks.machine import describe_machine
from service.errors import QuadliftError

app = typer.Typer(help="How exact lifting, fusion and tracking are, and how fast.", invoke_without_command=True)
console = Console()

JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]

Section = dict[str, Any]
"""Tables by name, each with its rows by name, each with its figures."""


def kitti_section() -> Section:
    """Lifting on KITTI's labels."""
    from benchmarks.geometry_kitti import run_kitti

    return run_kitti()


def roadside_section() -> Section:
    """Lifting and two-camera fusion on a real intersection."""
    from benchmarks.geometry_roadside import run_roadside

    return run_roadside()


def rigs_section() -> Section:
    """Lifting and fusion on simulated rigs."""
    from benchmarks.geometry_rigs import run_rigs

    return run_rigs()


def tracking_section() -> Section:
    """Tracking on the real intersection."""
    from benchmarks.geometry_tracking import run_tracking

    return run_tracking()


def speed_section() -> Section:
    """Time of lift, fuse and track."""
    from benchmarks.geometry_speed import run_speed

    return run_speed()


SECTIONS: dict[str, Callable[[], Section]] = {
    "kitti": kitti_section,
    "roadside": roadside_section,
    "rigs": rigs_section,
    "tracking": tracking_section,
    "speed": speed_section,
}
"""Each loads what it needs only when it runs."""


@app.callback()
def everything(context: typer.Context, as_json: JsonOption = False) -> None:
    """All sections when no command is given."""
    if context.invoked_subcommand is None:
        _report(list(SECTIONS), as_json)


def _command(name: str) -> Callable[[bool], None]:
    def run(as_json: JsonOption = False) -> None:
        _report([name], as_json)

    run.__doc__ = SECTIONS[name].__doc__
    return run


for _name in SECTIONS:
    app.command(_name)(_command(_name))


def _report(names: list[str], as_json: bool) -> None:
    results = {name: SECTIONS[name]() for name in names}
    if as_json:
        # Plain print: rich would wrap and colour what a script is to parse.
        print(json.dumps({**results, "machine": describe_machine()}, indent=1))
        return
    for name, section in results.items():
        console.rule(name)
        for title, rows in section.items():
            console.print(_table(title, rows))


def _table(title: str, rows: dict[str, Any]) -> Table:
    """Rows by name; a section may give single figures instead of rows."""
    table = Table(title=title, title_justify="left")
    table.add_column("")
    full = {name: row if isinstance(row, dict) else {"value": row} for name, row in rows.items()}
    columns = list(dict.fromkeys(column for row in full.values() for column in row))
    for column in columns:
        table.add_column(column.replace("_", " "), justify="right")
    for name, row in full.items():
        table.add_row(name, *(str(row.get(column, "")) for column in columns))
    return table


def main() -> None:
    """The ``bench-geometry`` command."""
    try:
        app()
    except QuadliftError as error:
        console.print(f"[red]{error}[/red]")
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
