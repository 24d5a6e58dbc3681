"""``bench-robust``: the service with slow readers, under faults, and under attack."""

from __future__ import annotations

import asyncio
import signal
from typing import Annotated, Any

import typer
from rich.console import Console

from benchmarks.load.attacks import ATTACKS, run_attacks
from benchmarks.load.faults import SIGTERM, FaultResult, run_faults
from benchmarks.load.injections import KINDS
from benchmarks.load.parser_fuzz import fuzz_parsers
from benchmarks.load.readers import UNREACHABLE, measure_readers
from benchmarks.load.report import Json, finish
from clients.client import ServiceError
from clients.clip import ClipError
from clients.local_service import LocalServiceError

app = typer.Typer(add_completion=False, no_args_is_help=True, help=__doc__)
console = Console(stderr=True)
PARSERS = "parsers"


@app.command()
def readers(
    count: Annotated[int, typer.Option("--readers", min=2, max=1000, help="Stream readers.")] = 100,
    rate: Annotated[float, typer.Option(min=0.5, max=60, help="Frame sets a second.")] = 10.0,
    seconds: Annotated[float, typer.Option(min=1, help="Time of the measurement.")] = 64.0,
    as_json: Json = False,
) -> None:
    """Many stream readers, then one that stalls: the others' p99, and when the stalled one is cut."""
    try:
        figures = asyncio.run(measure_readers(count, rate, seconds))
    except (LocalServiceError, ServiceError, ClipError, *UNREACHABLE) as error:
        console.print(f"[red]{type(error).__name__}: {error}[/red]")
        raise typer.Exit(2) from None
    finish(figures, as_json, passed=figures["passed"])


@app.command()
def faults(
    times: Annotated[int, typer.Option(min=1, help="Faults of each kind.")] = 20,
    seconds: Annotated[float, typer.Option(min=5, help="Time of each kind at most.")] = 240.0,
    kind: Annotated[list[str] | None, typer.Option(help=f"Only these: {', '.join([*KINDS, SIGTERM])}.")] = None,
    as_json: Json = False,
) -> None:
    """Inject faults under load: what the service survives, whose answers go astray, what is lost uncounted."""
    chosen = _chosen(kind, [*KINDS, SIGTERM])

    def say(result: FaultResult) -> None:
        outcome = f"{result.survived} of {result.asked} survived, {result.lost_uncounted} lost"
        console.print(f"{result.kind}: {outcome}, {result.account.wrong_owner} to a wrong owner", highlight=False)

    results = asyncio.run(run_faults(chosen, times, seconds, say))
    figures = {"faults": [result.document() for result in results]}
    finish(figures, as_json, passed=all(result.passed for result in results))


@app.command()
def attacks(
    runs: Annotated[int, typer.Option(min=1, help="Runs of the parsers' fuzzers, all together.")] = 1_000_000,
    seconds: Annotated[float, typer.Option(min=1, help="Time of each attack on the service.")] = 60.0,
    fuzz_seconds: Annotated[float, typer.Option(min=1, help="Time of the parsers' fuzzers at most.")] = 1200.0,
    seed: Annotated[int, typer.Option(min=0, help="Of everything that is drawn.")] = 1,
    only: Annotated[list[str] | None, typer.Option(help=f"Only these: {', '.join([PARSERS, *ATTACKS])}.")] = None,
    as_json: Json = False,
) -> None:
    """Fuzz the parsers, and attack a running service beside an honest client."""
    chosen = _chosen(only, [PARSERS, *ATTACKS])
    figures: dict[str, Any] = asyncio.run(run_attacks([name for name in chosen if name != PARSERS], seconds, seed))
    if PARSERS in chosen:
        parsers = fuzz_parsers(runs, fuzz_seconds, seed)
        figures[PARSERS] = parsers | {"passed": not parsers["crashes"]}
    finish(figures, as_json, passed=all(part["passed"] for part in figures.values()))


def _chosen(wanted: list[str] | None, known: list[str]) -> list[str]:
    strange = set(wanted or ()) - set(known)
    if strange:
        console.print(f"[red]{', '.join(sorted(strange))}: not one of {', '.join(known)}[/red]")
        raise typer.Exit(2)
    return [name for name in known if not wanted or name in wanted]


def main() -> None:
    """Console entry point."""
    # As Ctrl-C does: the services that were started are stopped on the way out.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    app()


if __name__ == "__main__":
    main()
