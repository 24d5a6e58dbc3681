"""The search for the highest rate, and the comparison with the best of the others."""

from __future__ import annotations

import asyncio
import os
import time
from contextlib import suppress
from pathlib import Path

import msgpack
import pytest

from benchmarks.load.open_loop import MSGPACK, PostJob, bodies_of, post_load
from benchmarks.load.peers import OURS, Score, figures, highest_rate, peer
from clients.clip import open_clip
from service.site import parse_site, save_site


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


@pytest.mark.parametrize(
    ("module", "framework", "options"),
    [
        ("peer_fastapi", "fastapi", ["--processes", "2", "--threads", "1"]),
        ("peer_litserve", "litserve", ["--processes", "1"]),
        ("peer_mosec", "mosec", ["--processes", "1"]),
    ],
)
def test_a_peer_answers_and_leaves_no_process_behind(module: str, framework: str, options: list[str], tmp_path: Path) -> None:
    pytest.importorskip(framework)
    site_file = tmp_path / "site.json"
    save_site(parse_site(open_clip().site), site_file)
    with peer(framework, module, options, site_file) as contender:
        (done,) = asyncio.run(post_load([contender.posting(0.0, 1)], 0.2))
        group = os.getpgid(contender.pid)
    assert done.statuses == {200: done.offered}
    # What was killed needs a moment to be gone.
    for _ in range(50):
        if not running(group):
            break
        time.sleep(0.1)
    assert not running(group)


def running(group: int) -> list[str]:
    """States of a process group's members that have not ended."""
    stats = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            stats.append(path.read_text("utf-8", "replace").rpartition(")")[2].split())
    return [state for state, _parent, own, *_ in stats if int(own) == group and state != "Z"]
