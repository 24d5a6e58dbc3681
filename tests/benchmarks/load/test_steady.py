"""A steady stream's figures: every set is answered, missing or counted, and its age counts from when it was due."""

from __future__ import annotations

import asyncio
import math
import re

import pytest

from benchmarks.load import stream_generator as streams
from benchmarks.load.steady import drops
from benchmarks.load.stream_generator import OpenLoop, percentiles
from benchmarks.load.target_service import Counters
from benchmarks.load.throughput import MIN_INPROC_RATIO, Turns, figures
from service.schemas import rfc3339_from_ns

SETS = [{"north": b"jpeg"}]


class Link:
    """Answers every set but those whose numbers are in ``silent``; those in ``slow`` after a while."""

    def __init__(self, silent: set[int] = frozenset(), slow: set[int] = frozenset()) -> None:  # type: ignore[assignment]
        self.refusals: list[str] = []
        self.sent: list[int] = []
        self._silent, self._slow = silent, slow
        self._answers: asyncio.Queue[bytes] = asyncio.Queue()

    async def send(self, frames: object, captured_at_ns: int) -> None:
        number = len(self.sent)
        self.sent.append(captured_at_ns)
        answer = f'{{"captured_at":"{rfc3339_from_ns(captured_at_ns)}","degraded":{"true" if number == 2 else "false"}}}'
        if number in self._slow:
            await asyncio.sleep(0.2)
        if number not in self._silent:
            self._answers.put_nowait(answer.encode())

    async def receive(self) -> bytes:
        return await self._answers.get()


def run(link: Link, rate_hz: float = 50.0, seconds: float = 0.2) -> dict[str, object]:
    return asyncio.run(OpenLoop(link, SETS, rate_hz).run(seconds))  # type: ignore[arg-type]


def test_every_set_is_sent_and_answered() -> None:
    link = Link()
    got = run(link)
    assert (got["sent"], got["answered"], got["missing"], got["degraded"], got["unasked"]) == (10, 10, 0, 1, 0)
    assert [b - a for a, b in zip(link.sent, link.sent[1:], strict=False)] == pytest.approx([20_000_000] * 9, abs=1)


def test_a_set_without_an_answer_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "ANSWER_S", 0.05)
    got = run(Link(silent={3, 4}))
    assert (got["answered"], got["missing"]) == (8, 2)


def test_a_sender_that_is_held_up_ages_the_sets_behind_it() -> None:
    got = run(Link(slow={1}))
    latency, behind = got["latency_ms"], got["behind_schedule_ms"]
    assert isinstance(latency, dict)
    assert isinstance(behind, dict)
    # The second set's sending took 0.2 s: the third was due 0.02 s after it, and its age counts from then.
    assert behind["max"] >= 170
    assert latency["max"] >= 190


def test_a_message_that_nobody_asked_for_is_counted_and_nothing_else() -> None:
    loop = OpenLoop(Link(), SETS, 1.0)  # type: ignore[arg-type]
    for message in (b"{}", f'{{"captured_at":"{rfc3339_from_ns(10**18)}"}}'.encode()):
        loop.note(message, 0.0)
    assert loop._figures(0) | {"latency_ms": None, "behind_schedule_ms": None} == {
        "sent": 0, "answered": 0, "missing": 0, "degraded": 0, "unasked": 2, "refused_frames": 0,
        "latency_ms": None, "behind_schedule_ms": None,
    }  # fmt: skip


def test_percentiles_of_nothing_keep_no_limit() -> None:
    assert all(math.isnan(value) and not value <= 66.0 for value in percentiles([]).values())
    assert percentiles([1.0, 2.0, 3.0]) == {"p50": 2.0, "p99": 2.98, "max": 3.0}


def test_a_generator_that_fails_says_why() -> None:
    async def start() -> None:
        async with streams.stream_generator("http://127.0.0.1:9", 1.0, rate_hz=1.0):
            pass

    with pytest.raises(streams.GeneratorError, match=re.escape("http://127.0.0.1:9")):
        asyncio.run(start())


def counters(**dropped: int) -> Counters:
    return Counters({("quadlift_dropped_total", (("reason", reason),)): float(count) for reason, count in dropped.items()})


def test_only_drops_in_between_count() -> None:
    assert drops(counters(late=3), counters(late=3)) == {}
    assert drops(counters(late=3), counters(late=5, expired=1)) == {"late": 2, "expired": 1}


def test_throughput_of_turns_is_that_of_all_their_time_together() -> None:
    bare, inproc, http, ws = Turns(), Turns(), Turns(), Turns()
    for sets, seconds in ((100, 1.0), (20, 1.0)):
        bare.add(sets, seconds)
        inproc.add(sets // 2, seconds)
        http.add(sets // 4, seconds, 0.02)
        ws.add(sets // 5, seconds, 0.04)
    got = figures({"bare": bare, "inproc": inproc, "http": http, "ws": ws})
    assert got["ways"]["bare"] == {"sets_per_second": 60.0, "rounds": [100.0, 20.0]}
    assert got["ways"]["ws"]["client_cpu_cores"] == 0.04
    assert got["ratios"]["inproc_over_bare"] == 0.5
    assert got["ratios"]["ws_over_inproc"] == 0.4
    assert not got["passed"]
    assert got["min_inproc_over_bare"] == MIN_INPROC_RATIO
