"""All parsers through the fuzzers, within a number of runs and a time."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from benchmarks.load.guided_fuzz import guided_fuzz, has_atheris
from benchmarks.load.mutation import FuzzResult, fuzz
from benchmarks.load.parsers import parser_targets

SHARES = {"frame": 0.4, "ingest_header": 0.4, "site": 0.12, "multipart": 0.08}
"""Of the runs: the parsers of headers are quick, and see the most strangers."""
_GUIDED_SHARE = 0.5
"""Of the time, for the fuzzer that is guided by coverage; half as many runs as the other has."""


def fuzz_parsers(runs: int, seconds: float, seed: int) -> dict[str, Any]:
    """Every parser by seeded mutation and, where it is installed, by Atheris. Together at least ``runs`` if time allows."""
    results: list[FuzzResult] = []
    guided = has_atheris()
    time_left = seconds * (1 - _GUIDED_SHARE if guided else 1)
    with _quiet_libraries():
        for target in parser_targets().values():
            share = SHARES[target.name]
            results.append(fuzz(target.name, target.run, target.maker(seed), round(runs * share), time_left))
            time_left = max(1.0, time_left - results[-1].seconds)
    if guided:
        for target in parser_targets().values():
            share = SHARES[target.name]
            results.append(guided_fuzz(target, round(runs * share / 2), seconds * _GUIDED_SHARE / len(SHARES), seed))
    total, took = sum(result.runs for result in results), sum(result.seconds for result in results)
    return {
        "runs": total,
        "runs_per_second": round(total / took) if took else 0,
        "crashes": sum(len(result.crashes) for result in results),
        "seed": seed,
        "parsers": [result.document() for result in results],
    }


@contextmanager
def _quiet_libraries() -> Iterator[None]:
    """Parsers' libraries warn of every broken input; a million lines would say nothing."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(before)
