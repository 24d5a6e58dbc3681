"""bench-fps prints what its contract says. How fast it is, is for the benchmark to say, not for a test."""

from __future__ import annotations

import itertools
import json

import pytest
import typer
from typer.testing import CliRunner

from benchmarks.clip_sets import clip_frame_sets
from benchmarks.fps import Via, bench_fps, run_inproc
from benchmarks.measured import Measured
from service.nets.pack import load_pack
from service.pipeline import Pipeline
from service.scheduler import Scheduler

KEYS = {
    "sets_per_second",
    "target",
    "latency_ms",
    "stages",
    "dropped",
    "bare_sets_per_second",
    "ratio_to_bare",
    "machine",
    "pack",
    "provider",
}


def run(*arguments: str) -> tuple[int, dict[str, object]]:
    app = typer.Typer()
    app.command()(bench_fps)
    result = CliRunner().invoke(app, [*arguments, "--json"])
    return result.exit_code, json.loads(result.stdout)


@pytest.mark.parametrize("via", ["inproc", "http", "ws"])
def test_the_figures_of_the_contract(via: str) -> None:
    code, figures = run("--seconds", "1", "--via", via, "--target", "0.1")
    assert code == 0
    assert set(figures) >= KEYS
    stages = figures["stages"]
    assert isinstance(stages, dict)
    assert {"decode", "detect", "orient", "depth", "lift", "fuse", "total"} <= set(stages)
    assert all(stage["p50_ms"] <= stage["p99_ms"] for stage in stages.values())


def test_below_the_target_it_exits_with_1() -> None:
    code, figures = run("--seconds", "0.5", "--cameras", "1", "--target", "1e6", "--provider", "cpu")
    assert code == 1
    assert figures["cameras"] == 1
    assert figures["provider"] == "cpu"


def test_every_set_of_a_closed_loop_is_answered() -> None:
    scheduler = Scheduler(Pipeline(load_pack("edge")), workers=2)
    measured = Measured()
    try:
        run_inproc(scheduler, itertools.cycle(clip_frame_sets()[:5]), 0.5, 3, measured)
    finally:
        scheduler.stop()
    assert measured.sets == len(measured.latency_ms) > 0
    assert measured.dropped == 0


def test_via_names_its_ways() -> None:
    assert [way.value for way in Via] == ["inproc", "http", "ws"]
