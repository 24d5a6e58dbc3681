"""The search for the highest rate, and the comparison with the best of the others."""

from __future__ import annotations

import asyncio

import msgpack
import pytest

from benchmarks.load.open_loop import MSGPACK, PostJob, bodies_of
from benchmarks.load.peers import OURS, Score, figures, highest_rate
from clients.clip import open_clip


@pytest.mark.parametrize("limit", [3.0, 20.0, 39.9, 100.0])
def test_the_highest_rate_is_found_within_a_step(limit: float) -> None:
    asked = []

    async def keeps(rate: float) -> bool:
        asked.append(rate)
        return rate <= limit

    found = asyncio.run(highest_rate(keeps, 40.0, steps=6))
    assert found == pytest.approx(min(limit, 40.0), abs=40 / 2**6)
    assert found <= limit
    assert len(asked) == 6


def score(peak: float, kept: float, p99: float) -> Score:
    return Score({2: [peak, peak], 4: [peak - 1]}, [kept], [p99] * 10, generator_cores=[0.1])


def test_ours_is_held_against_the_best_of_the_others_in_each_respect() -> None:
    scores = {OURS: score(44, 36, 50), "a": score(40, 20, 100), "b": score(42, 30, 200)}
    found = figures(scores)
    assert found["throughput_ratio"] == pytest.approx(44 / 42, abs=1e-3)
    assert (found["best_peer_within_latency"], found["ratio_to_best"]) == ("b", 1.2)
    assert (found["best_peer_p99"], found["p99_ratio"]) == ("a", 0.5)
    assert found["passed"]
    assert not figures(scores | {"c": score(41, 34, 300)})["passed"]


def test_a_peer_that_reads_no_forms_gets_the_same_frames() -> None:
    clip = open_clip()
    job = PostJob("http://x", "/", {"north": clip.camera_ids[0]}, content_type=MSGPACK)
    assert msgpack.unpackb(bodies_of(job)[3]) == {"north": clip.frame(clip.camera_ids[0], 3)}
