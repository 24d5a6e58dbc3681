"""The fuzzers: the same seed gives the same inputs, whole inputs are accepted, a crash is seen and kept."""

from __future__ import annotations

import base64

import pytest

from benchmarks.load.mutation import MAX_INPUT, FuzzResult, fuzz
from benchmarks.load.parser_fuzz import SHARES
from benchmarks.load.parsers import ParserTarget, parser_targets
from benchmarks.load.raw_http import seeds
from service.errors import InputError

TARGETS = parser_targets()


def first(target: ParserTarget, seed: int, count: int = 50) -> list[bytes]:
    maker = target.maker(seed)
    return [maker.make() for _ in range(count)]


@pytest.mark.parametrize("target", TARGETS.values(), ids=lambda target: target.name)
def test_inputs_follow_from_the_seed(target: ParserTarget) -> None:
    assert first(target, 3) == first(target, 3)
    assert first(target, 3) != first(target, 4)


@pytest.mark.parametrize("target", TARGETS.values(), ids=lambda target: target.name)
def test_most_inputs_are_broken_in_ways_of_their_own_and_none_grows_without_end(target: ParserTarget) -> None:
    inputs = first(target, 5, 200)
    assert len(set(inputs)) > 150
    assert target.documents or max(map(len, inputs)) <= MAX_INPUT


def test_parsers_take_the_whole_inputs() -> None:
    # Two ingest messages and most pictures are whole; the others are broken on purpose only after mutation.
    for target in TARGETS.values():
        for data in target.corpus:
            target.run(data)


@pytest.mark.parametrize("target", TARGETS.values(), ids=lambda target: target.name)
def test_parsers_refuse_broken_inputs_with_errors_of_the_tree_only(target: ParserTarget) -> None:
    result = fuzz(target.name, target.run, target.maker(11), 200, seconds=60)
    assert result.crashes == []
    assert result.refused > 50
    assert result.runs == result.accepted + result.refused == 200


def test_a_crash_is_kept_once_with_its_input() -> None:
    def parser(data: bytes) -> None:
        if data[0] == 0xFF:
            raise InputError("as it should be.")
        raise KeyError(len(data))

    result = fuzz("brittle", parser, TARGETS["frame"].maker(1), 100, seconds=60)
    assert result.refused > 10
    assert result.refused < 100
    assert len(result.crashes) == 1
    with pytest.raises(KeyError):
        parser(base64.b64decode(result.crashes[0].input_base64))


def test_the_time_ends_a_run() -> None:
    result = fuzz("any", lambda data: None, TARGETS["frame"].maker(1), 10**9, seconds=0.0)
    assert result.runs < 10**9


def test_shares_of_the_runs_are_of_all_parsers_and_make_one() -> None:
    assert SHARES.keys() == TARGETS.keys()
    assert sum(SHARES.values()) == pytest.approx(1)


def test_figures_without_a_run_divide_by_nothing() -> None:
    assert FuzzResult("any", "mutation").document()["runs_per_second"] == 0


def test_raw_requests_announce_the_length_that_they_have() -> None:
    for request in seeds("localhost:1"):
        head, _, body = request.partition(b"\r\n\r\n")
        lengths = [line.split(b": ")[1] for line in head.split(b"\r\n") if line.startswith(b"Content-Length")]
        assert b"chunked" in head or all(int(length) == len(body) for length in lengths)
