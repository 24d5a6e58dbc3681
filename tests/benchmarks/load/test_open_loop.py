"""The generator against a small server: its schedule, its counts, and latencies from the time when a request was due."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress

import pytest

from benchmarks.load.open_loop import ENDED, Poster, PostJob, PostOutcome, due_times, read_answer

Reply = Callable[[int], Awaitable[bytes]]
OK = b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nok"
BUSY = b"HTTP/1.1 503 No\r\nRetry-After: 1\r\ncontent-length: 0\r\nConnection: close\r\n\r\n"


def post(reply: Reply, seconds: float = 0.3, **options: float) -> PostOutcome:
    async def run() -> PostOutcome:
        counted = 0
        serving = set[asyncio.Task[None]]()

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            nonlocal counted
            serving.add(asyncio.current_task())  # type: ignore[arg-type]
            while await reader.read(4):
                counted += 1
                answer = await reply(counted)
                writer.write(answer)
                if not answer or b"Connection: close" in answer:
                    break
            writer.close()
            with suppress(OSError):
                await writer.wait_closed()

        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        job = PostJob(f"http://127.0.0.1:{port}", "/", {}, **options)  # type: ignore[arg-type]
        async with server:
            outcome = await Poster(job, [b"ping"]).run(time.perf_counter(), seconds)
            await asyncio.gather(*serving)
            return outcome

    return asyncio.run(run())


def test_times_of_requests() -> None:
    assert list(due_times(4, 1)) == [0, 0.25, 0.5, 0.75]
    drawn = list(due_times(1000, 20, poisson_seed=1))
    assert drawn == list(due_times(1000, 20, poisson_seed=1))
    assert drawn == sorted(drawn)
    assert len(drawn) == pytest.approx(20_000, rel=0.05)


def test_what_was_offered_was_sent() -> None:
    async def at_once(number: int) -> bytes:
        return OK

    outcome = post(at_once, rate_hz=50)
    assert outcome.offered == outcome.answered == len(outcome.latencies_ms) == 15
    assert outcome.goodput_hz == pytest.approx(50)


def test_a_wait_for_a_connection_counts() -> None:
    async def slow(number: int) -> bytes:
        await asyncio.sleep(0.1)
        return OK

    outcome = post(slow, rate_hz=20, connections=1)
    assert outcome.answered == 6
    # The last one was due at 250 ms, and its turn began after five others, at 500 ms.
    assert max(outcome.latencies_ms) >= 300


def test_in_a_closed_loop_a_connection_waits_for_its_answer() -> None:
    async def slow(number: int) -> bytes:
        await asyncio.sleep(0.1)
        return OK

    outcome = post(slow, connections=2)
    assert 2 <= outcome.answered <= 6
    assert outcome.answered == outcome.offered


def test_refusals_and_silence_are_counted_and_the_client_goes_on() -> None:
    async def mixed(number: int) -> bytes:
        return (BUSY, BUSY.replace(b"Retry-After: 1\r\n", b""), b"", OK)[number % 4]

    outcome = post(mixed, rate_hz=40, connections=1)
    assert outcome.offered == 12
    assert sum(outcome.statuses.values()) == 12
    assert outcome.statuses == {200: 3, 503: 6, ENDED: 3}
    assert outcome.busy_without_retry_after == 3


def test_a_server_that_never_answers_is_given_up() -> None:
    async def never(number: int) -> bytes:
        await asyncio.sleep(0.3)
        return OK

    outcome = post(never, rate_hz=20, connections=2, timeout_s=0.1)
    assert outcome.statuses == {ENDED: 6}


def test_a_response_without_a_length_is_none_that_can_be_read() -> None:
    async def read() -> None:
        reader = asyncio.StreamReader()
        reader.feed_data(b"HTTP/1.1 200 OK\r\n\r\n")
        with pytest.raises(ValueError, match="without a length"):
            await read_answer(reader)

    asyncio.run(read())


def test_turns_are_counted_together() -> None:
    first = PostOutcome(offered=5, statuses={200: 3, 503: 1}, latencies_ms=[1.0], in_time=3, seconds=2.0, cpu_s=0.5)
    first.add(PostOutcome(offered=2, statuses={200: 2}, latencies_ms=[2.0], busy_without_retry_after=1, in_time=1, seconds=2.0))
    assert first == PostOutcome(7, {200: 5, 503: 1}, [1.0, 2.0], 1, 4, 4.0, 0.5)
    assert first.goodput_hz == 1.0
