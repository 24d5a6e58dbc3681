"""Growth of a process tree: of the largest window over the first, after the warm-up; a passing peak is none."""

from __future__ import annotations

import asyncio
import os

from hypothesis import given
from hypothesis import strategies as st

from benchmarks.load.process_tree import TreeUsage
from benchmarks.load.usage_course import MAX_GROWTH_BYTES, WINDOWS, UsageCourse, course_figures

_MIB = 2**20
_SECONDS = 100.0


def usage(at_s: float, *, mib: float = 300.0, threads: int = 19, fds: int = 69) -> tuple[float, TreeUsage]:
    return at_s, TreeUsage(3, int(mib * _MIB), int(2 * mib * _MIB), threads, fds, 1.5 * at_s)


def test_a_flat_course_passes_and_names_its_cores() -> None:
    figures = course_figures([usage(float(s)) for s in range(101)], _SECONDS)
    assert figures["passed"]
    assert figures["memory_growth_mib"] == 0.0
    assert figures["memory_mib"] == [300.0] * WINDOWS
    assert figures["warm_up_s"] == 20.0
    assert figures["cpu_cores"] == 1.5


def test_what_grows_in_the_warm_up_does_not_count_and_what_grows_later_does() -> None:
    early = [usage(float(s), mib=300 + min(s, 20)) for s in range(101)]
    assert course_figures(early, _SECONDS)["passed"]
    late = [usage(float(s), mib=300 if s < 60 else 320) for s in range(101)]
    figures = course_figures(late, _SECONDS)
    assert (figures["memory_growth_mib"], figures["passed"]) == (20.0, False)


def test_a_peak_of_a_moment_is_no_growth_but_is_told() -> None:
    figures = course_figures([usage(float(s), threads=25 if s == 70 else 19) for s in range(101)], _SECONDS)
    assert figures["passed"]
    assert figures["threads_peak"] == 25


def test_one_thread_or_file_more_for_good_fails() -> None:
    for more in ({"threads": 20}, {"fds": 70}):
        samples = [usage(float(s), **(more if s > 80 else {})) for s in range(101)]
        assert not course_figures(samples, _SECONDS)["passed"]


@given(st.lists(st.floats(100, 1000), min_size=40, max_size=80))
def test_growth_is_never_below_zero_and_decides_by_its_limit(mib: list[float]) -> None:
    samples = [usage(_SECONDS * n / (len(mib) - 1), mib=value) for n, value in enumerate(mib)]
    figures = course_figures(samples, _SECONDS)
    assert figures["memory_growth_mib"] >= 0
    assert figures["passed"] == (max(figures["memory_mib"]) - figures["memory_mib"][0] <= MAX_GROWTH_BYTES / _MIB + 0.1) or (
        abs(figures["memory_growth_mib"] - MAX_GROWTH_BYTES / _MIB) <= 0.1
    )


def test_a_course_watches_a_real_process() -> None:
    async def watch() -> UsageCourse:
        course = UsageCourse(os.getpid())
        watching = asyncio.create_task(course.watch(1.0))
        while len(course.samples) < 2:
            await asyncio.sleep(0.01)
        watching.cancel()
        await asyncio.gather(watching, return_exceptions=True)
        return course

    (first_s, first), (second_s, _) = asyncio.run(watch()).samples[:2]
    assert first_s < second_s
    assert first.pss_bytes > _MIB
    assert first.threads >= 1
