"""The parser of ingest messages: exact on what is right, InputError and nothing else on everything that is not."""

from __future__ import annotations

import json
import struct
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.api.ingest_message import IngestMessage, parse_message
from service.errors import InputError, TooLargeError
from service.schemas import rfc3339_from_ns

HEADER = {"camera": "north", "captured_at": "2026-11-22T01:02:03.040Z", "sequence": 7}
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


def message(header: Any, data: bytes = b"jpeg", length: int | None = None) -> bytes:
    encoded = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack(">I", len(encoded) if length is None else length) + encoded + data


def parse(data: bytes) -> IngestMessage:
    return parse_message(data, max_header_bytes=256, max_frame_bytes=1000)


@given(st.integers(0, 2**63 - 1), st.integers(0, 2**63 - 1), st.binary(max_size=100))
def test_what_was_sent_comes_back(time_ns: int, sequence: int, data: bytes) -> None:
    header = {"camera": "north", "captured_at": rfc3339_from_ns(time_ns), "sequence": sequence, "added_later": [1]}
    parsed = parse(message(header, data))
    assert (parsed.camera_id, parsed.captured_at_ns, parsed.sequence) == ("north", time_ns, sequence)
    assert parsed.data == data


@pytest.mark.parametrize(
    ("wrong", "field"),
    [
        (b"", "message"),
        (b"\0\0\0", "message"),
        (message(HEADER, b"", length=len(json.dumps(HEADER)) + 1), "header"),
        (message(b""), "header"),
        (message(b"[" * 200), "header"),
        (message(b"[]"), "header"),
        (message(b"\xff\xfe"), "header"),
        (message({**HEADER, "camera": ""}), "camera"),
        (message({**HEADER, "camera": 5}), "camera"),
        (message({**HEADER, "camera": "x" * 65}), "camera"),
        (message({"camera": "north", "sequence": 7}), "captured_at"),
        (message({**HEADER, "captured_at": "2026-11-22T01:02:03"}), "captured_at"),
        (message({**HEADER, "captured_at": 5}), "captured_at"),
        (message({**HEADER, "sequence": -1}), "sequence"),
        (message({**HEADER, "sequence": "7"}), "sequence"),
        (message({**HEADER, "sequence": True}), "sequence"),
        (message({**HEADER, "sequence": 2**63}), "sequence"),
    ],
)
def test_what_is_wrong_is_named(wrong: bytes, field: str) -> None:
    with pytest.raises(InputError) as caught:
        parse(wrong)
    assert caught.value.field == field
    assert caught.value.remedy


@pytest.mark.parametrize(
    ("large", "field"), [(message(b" " * 257), "header"), (b"\xff" * 8, "header"), (message(HEADER, bytes(1001)), "frame")]
)
def test_limits_come_before_parsing(large: bytes, field: str) -> None:
    with pytest.raises(TooLargeError) as caught:
        parse(large)
    assert caught.value.field == field


def parses_or_refuses(data: bytes) -> None:
    try:
        parsed = parse(data)
    except InputError:
        return
    assert 0 <= parsed.captured_at_ns < 2**63
    assert data.endswith(parsed.data)


@settings(max_examples=2000, deadline=None)
@given(st.binary(max_size=300))
def test_no_bytes_crash_it(data: bytes) -> None:
    parses_or_refuses(data)


@settings(max_examples=1000, deadline=None)
@given(JSON, JSON, JSON, st.binary(max_size=10))
def test_no_header_crashes_it(camera: Any, captured_at: Any, sequence: Any, data: bytes) -> None:
    for header in ({"camera": camera, "captured_at": captured_at, "sequence": sequence}, camera):
        parses_or_refuses(message(header, data))


@settings(max_examples=1000, deadline=None)
@given(st.integers(0, len(message(HEADER)) - 1), st.integers(0, 255))
def test_no_single_wrong_byte_crashes_it(place: int, value: int) -> None:
    data = bytearray(message(HEADER))
    data[place] = value
    parses_or_refuses(bytes(data))
