"""Tuning: turns, limits, and the choice, on runners whose time is known."""

from __future__ import annotations

from typing import Any

import pytest

from service.errors import InputError
from service.frames import FrameSet
from service.site import Site
from service.tuning import Candidate, Trial, best, candidates, measure, with_settings

SETS = [FrameSet(Site("demo"), (), 0, number) for number in range(3)]


class Clock:
    """Goes on only when somebody works."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


class Runner:
    """Takes a known time for a set."""

    def __init__(self, clock: Clock, seconds: float) -> None:
        self.clock, self.seconds, self.runs = clock, seconds, 0

    def warm_up(self) -> None: ...

    def run(self, frame_set: FrameSet) -> Any:
        self.runs += 1
        self.clock.now += self.seconds


def trial(workers: int, rate: float, latency_ms: float) -> Trial:
    return Trial(Candidate(workers, 1), round(10 * rate), 10.0, [latency_ms] * 100)


@pytest.mark.parametrize("cores", [1, 2, 3, 4, 6, 16])
def test_candidates_fill_the_cores_and_no_more(cores: int) -> None:
    found = candidates(cores)
    assert len(set(found)) == len(found)
    assert {Candidate(cores, 1), Candidate(1, cores), Candidate(1, 1), Candidate(cores + 1, 1)} <= set(found)
    assert all(c.workers * c.intra_op_threads <= cores for c in found if c != Candidate(cores + 1, 1))


def test_two_cores() -> None:
    assert candidates(2) == [Candidate(1, 1), Candidate(1, 2), Candidate(2, 1), Candidate(3, 1)]


def test_a_known_rate_is_found_in_the_time_that_was_given() -> None:
    clock = Clock()
    runners = {Candidate(1, 1): Runner(clock, 0.02), Candidate(1, 2): Runner(clock, 0.01)}
    asked = []

    def load(candidate: Candidate) -> Runner:
        asked.append(candidate)
        return runners[candidate]

    trials = measure(load, SETS, list(runners), 8.0, clock)
    assert asked == list(runners)
    assert [t.sets_per_second for t in trials] == [pytest.approx(50), pytest.approx(100)]
    assert [t.latency_percentile_ms(99) for t in trials] == [pytest.approx(20), pytest.approx(10)]
    assert clock.now == pytest.approx(8.0, abs=0.2)
    assert [t.sets for t in trials] == [runner.runs for runner in runners.values()]


def test_networks_slower_than_a_turn_are_measured_all_the_same() -> None:
    clock = Clock()
    (slow,) = measure(lambda _: Runner(clock, 60.0), SETS, [Candidate(1, 1)], 1.0, clock)
    assert slow.sets == 8
    assert slow.sets_per_second == pytest.approx(1 / 60)


def test_the_most_sets_within_the_limit_win() -> None:
    trials = [trial(1, 20, 50), trial(2, 30, 66), trial(3, 31, 100)]
    assert best(trials, 66) == (trials[1], True)
    assert best(trials, 200) == (trials[2], True)
    assert best(trials, 10) == (trials[0], False)
    with pytest.raises(InputError):
        best([], 10)


def test_settings_go_into_a_file_beside_what_stands_there() -> None:
    settings = Candidate(2, 1).settings()
    once = with_settings("# ours\nQUADLIFT_TOKENS_FILE=tokens\nQUADLIFT_WORKERS=7\n", settings)
    assert once == "# ours\nQUADLIFT_TOKENS_FILE=tokens\nQUADLIFT_WORKERS=2\nQUADLIFT_INTRA_OP_THREADS=1\n"
    assert with_settings(once, settings) == once
    assert with_settings("", settings).count("\n") == 2


def test_the_service_takes_the_settings_that_tuning_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    from service.settings import Settings

    for name, value in Candidate(3, 2).settings().items():
        monkeypatch.setenv(name, value)
    assert (Settings().workers, Settings().intra_op_threads) == (3, 2)
