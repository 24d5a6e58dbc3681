"""The queue in front of the workers: turns between sites, the newest of a stream, nothing lost."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.fair_queue import FairQueue, Job
from service.frames import FrameSet
from service.site import Site

SITES = {name: Site(name) for name in "abcd"}


def job(site: str, sequence: int = 0, newest_wins: bool = False) -> Job:
    return Job(FrameSet(SITES[site], (), 0, sequence), 0.0, newest_wins)


def drain(queue: FairQueue) -> list[Job]:
    taken = []
    while (next_one := queue.take()) is not None:
        taken.append(next_one)
    return taken


def test_sites_take_turns_and_each_keeps_its_order() -> None:
    queue = FairQueue()
    for number in range(4):
        queue.add(job("a", number))
    queue.add(job("b", 0))
    queue.add(job("c", 0))
    queue.add(job("c", 1))
    assert [(j.site_id, j.frame_set.sequence) for j in drain(queue)] == [
        ("a", 0), ("b", 0), ("c", 0), ("a", 1), ("c", 1), ("a", 2), ("a", 3),
    ]  # fmt: skip


def test_a_newer_set_of_a_stream_takes_the_older_ones_place() -> None:
    queue = FairQueue()
    first, newer, posted = job("a", 1, True), job("a", 2, True), job("a", 3)
    assert queue.add(first) is None
    assert queue.add(posted) is None
    assert queue.add(job("b", 9, True)) is None
    assert queue.add(newer) is first
    assert queue.posted == 1
    assert drain(queue)[0] is newer


def test_with_a_free_worker_both_sets_of_a_stream_wait() -> None:
    queue = FairQueue()
    first, second, third = (job("a", i, True) for i in range(3))
    queue.add(first)
    assert queue.add(second, is_worker_free=True) is None
    assert queue.add(third) is second
    assert drain(queue) == [first, third]


@pytest.mark.parametrize(
    ("waiting", "site", "evicted"),
    [("aaab", "c", "a"), ("aaab", "b", "a"), ("aab", "b", None), ("ab", "c", None), ("aaa", "a", None), ("", "a", None)],
)
def test_the_heaviest_site_makes_room_where_that_is_fair(waiting: str, site: str, evicted: str | None) -> None:
    queue = FairQueue()
    jobs = [job(name, number) for number, name in enumerate(waiting)]
    for one in jobs:
        queue.add(one)
    gone = queue.evict_for(site)
    assert (gone and gone.site_id) == evicted
    assert len(queue) == len(jobs) - (gone is not None)
    if gone is not None:
        assert gone is [one for one in jobs if one.site_id == evicted][-1]


OPERATIONS = st.lists(
    st.one_of(
        st.tuples(st.just("add"), st.sampled_from("abcd"), st.booleans(), st.booleans()),
        st.tuples(st.just("take"), st.none(), st.none(), st.none()),
        st.tuples(st.just("evict"), st.sampled_from("abcd"), st.none(), st.none()),
    ),
    max_size=60,
)


@given(OPERATIONS)
def test_every_job_leaves_once_and_in_turn(operations: list[tuple[str, str, bool, bool]]) -> None:
    queue = FairQueue()
    added: list[Job] = []
    gone: list[Job] = []
    taken: list[Job] = []
    for number, (what, site, newest_wins, is_free) in enumerate(operations):
        if what == "add":
            added.append(job(site, number, newest_wins))
            gone += filter(None, [queue.add(added[-1], is_worker_free=is_free)])
        else:
            one = queue.take() if what == "take" else queue.evict_for(site)
            (taken if what == "take" else gone).extend(filter(None, [one]))
    waiting = len(queue)
    lanes = Counter(one.site_id for one in added) - Counter(one.site_id for one in gone + taken)
    assert queue.posted == sum(not o.newest_wins for o in added) - sum(not o.newest_wins for o in gone + taken)
    rest = drain(queue)
    assert len(rest) == waiting
    assert sorted(map(id, gone + taken + rest)) == sorted(map(id, added))
    # Turns: as long as n sites have something waiting, the next n are of n sites.
    left = Counter(lanes)
    while left:
        turn, rest = rest[: len(left)], rest[len(left) :]
        assert {one.site_id for one in turn} == set(left)
        left -= Counter(one.site_id for one in turn)
    for name in "abcd":
        posted = [o.frame_set.sequence for o in taken if o.site_id == name and not o.newest_wins]
        assert posted == sorted(posted)


def test_removing_keeps_the_others_turns() -> None:
    queue = FairQueue()
    jobs = [job(name, number) for number, name in enumerate("aabbc")]
    for one in jobs:
        queue.add(one)
    assert queue.remove(lambda one: one.frame_set.sequence in (0, 4)) == [jobs[0], jobs[4]]
    assert queue.posted == 3
    assert drain(queue) == [jobs[1], jobs[2], jobs[3]]


def test_a_job_is_answered_once() -> None:
    one = job("a")
    assert one.fail(ValueError("first"))
    assert not one.fail(ValueError("second"))
    assert not one.succeed(None)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="first"):
        one.future.result(0)
    gone = job("a")
    gone.future.cancel()
    assert not gone.succeed(None)  # type: ignore[arg-type]
