"""The limit of a run: fixed, or following what sets take."""

from __future__ import annotations

import pytest

from service.run_limit import RUNS, SLOWER, RunLimit


@pytest.mark.parametrize(("frames", "limit_s"), [(0, 1.5), (1, 1.5), (4, 1.5), (8, 3.0), (16, 6.0)])
def test_many_frames_may_take_longer(frames: int, limit_s: float) -> None:
    assert RunLimit(1.5).seconds(frames) == pytest.approx(limit_s)


def test_a_machine_that_becomes_slow_raises_the_limit_and_one_that_recovers_lowers_it() -> None:
    limit, fixed = RunLimit(1.5, adapts=True), RunLimit(1.5)
    for took_s, expected in ((0.06, 1.5), (1.0, SLOWER * 1.0), (0.06, 1.5)):
        for _ in range(RUNS):
            limit.note(took_s, 4)
            fixed.note(took_s, 4)
        assert limit.seconds(4) == pytest.approx(expected, rel=1e-3)
        assert fixed.seconds(4) == 1.5


def test_sets_of_all_sizes_count_alike() -> None:
    small, large = RunLimit(0.1, adapts=True), RunLimit(0.1, adapts=True)
    for _ in range(5):
        small.note(0.5, 4)
        large.note(2.0, 16)
    assert small.seconds(8) == pytest.approx(large.seconds(8)) == pytest.approx(2 * SLOWER * 0.5)


def test_some_that_hung_and_came_back_change_nothing() -> None:
    limit = RunLimit(1.5, adapts=True)
    for took_s in [0.06] * RUNS + [30.0] * (RUNS // 2 - 1):
        limit.note(took_s, 4)
        assert limit.seconds(4) == 1.5
