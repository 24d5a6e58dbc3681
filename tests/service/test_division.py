"""Division: sets are divided while they could all be, and no longer."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.division import DEAR, MOST_LOAD, Division


def coming(rate_hz: float, cost_s: float, processes: int = 2, sets: int = 200) -> Division:
    times = (number / rate_hz for number in itertools.count())
    division = Division(processes, lambda: next(times))
    for _ in range(sets):
        division.arrived()
        division.took(cost_s, divided=False)
    return division


@given(rate_hz=st.floats(0.1, 200), cost_s=st.floats(0.001, 1.0), processes=st.integers(1, 16))
def test_division_pays_up_to_a_load(rate_hz: float, cost_s: float, processes: int) -> None:
    load = rate_hz * cost_s / processes
    if abs(load - MOST_LOAD) > 0.01:
        assert coming(rate_hz, cost_s, processes).pays() == (load < MOST_LOAD)


def test_divided_sets_are_no_dearer_in_its_eyes() -> None:
    whole, divided = Division(2), Division(2)
    whole.took(0.05, divided=False)
    divided.took(0.05 * DEAR, divided=True)
    assert divided.part_s == pytest.approx(whole.part_s)


def test_it_follows_a_machine_that_slows_down() -> None:
    division = coming(20.0, 0.04)
    assert division.pays()
    for _ in range(50):
        division.took(0.09, divided=False)
    assert not division.pays()


@pytest.mark.parametrize("pause_s", [1.0, 3600.0])
def test_however_long_a_pause_a_rush_after_it_is_soon_seen(pause_s: float) -> None:
    now = 0.0
    division = Division(2, lambda: now)
    for _ in range(30):
        division.arrived()
        division.took(0.05, divided=False)
        now += 0.02
    assert not division.pays()
    now += pause_s
    division.arrived()
    assert division.pays()
    for _ in range(16):
        now += 0.02
        division.arrived()
    assert not division.pays()


def test_the_first_sets_are_divided_before_anything_is_known() -> None:
    division = Division(2)
    assert division.pays()
    assert division.part_s == 0.0
