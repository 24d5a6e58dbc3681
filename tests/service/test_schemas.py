"""The wire contract's messages, and its times."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from service.schemas import Detections, ns_from_rfc3339, rfc3339_from_ns


def message() -> dict[str, Any]:
    """The example of the contract."""
    return {
        "site": "demo",
        "sequence": 41,
        "captured_at": "2026-11-22T01:02:03.040Z",
        "boxes": [
            {
                "track_id": "17",
                "class": "car",
                "score": 0.93,
                "center": [1.0, 2.0, 0.8],
                "size": [4.2, 1.8, 1.5],
                "yaw": 0.12,
                "velocity": [1.0, 0.0, 0.0],
                "covariance": [[0.0] * 7 for _ in range(7)],
                "cameras": ["north", "east"],
            }
        ],
        "cameras": {
            "north": {"status": "ok", "captured_at": "2026-11-22T01:02:03.043Z", "skew_ms": 3.1, "detections": 5},
            "west": {"status": "missing"},
        },
        "degraded": True,
        "timing_ms": dict.fromkeys(("decode", "detect", "orient", "depth", "lift", "fuse", "track", "total"), 1.0),
    }


def test_the_contracts_example_round_trips() -> None:
    parsed = Detections.model_validate(message())
    assert parsed.boxes[0].class_ == "car"
    assert parsed.model_dump(by_alias=True, exclude_unset=True) == message()


@pytest.mark.parametrize("wrong", [math.nan, math.inf, None, "x"])
def test_boxes_hold_finite_numbers_only(wrong: object) -> None:
    document = message()
    document["boxes"][0]["center"] = [0.0, wrong, 0.0]
    with pytest.raises(ValidationError):
        Detections.model_validate(document)


@given(st.integers(0, 2**63 - 1))
def test_times_round_trip_to_the_nanosecond(time_ns: int) -> None:
    assert ns_from_rfc3339(rfc3339_from_ns(time_ns)) == time_ns


def test_known_times() -> None:
    assert rfc3339_from_ns(0) == "1970-01-01T00:00:00.000Z"
    assert rfc3339_from_ns(1_500_000_001) == "1970-01-01T00:00:01.500000001Z"
    base = ns_from_rfc3339("2026-11-22T01:02:03.040Z")
    assert rfc3339_from_ns(base) == "2026-11-22T01:02:03.040Z"
    for same in ("2026-11-22T02:02:03.04+01:00", "2026-11-21t20:32:03.040000000999-04:30", "2026-11-22 01:02:03.040z"):
        assert ns_from_rfc3339(same) == base
    assert ns_from_rfc3339("2016-12-31T23:59:60Z") == ns_from_rfc3339("2017-01-01T00:00:00Z")


@pytest.mark.parametrize(
    "text",
    ["", "now", "2026-11-22", "2026-11-22T01:02:03", "2026-02-30T00:00:00Z", "2026-11-22T25:00:00Z", "1969-12-31T23:59:59Z",
     "9999-12-31T23:59:59Z", "2026-11-22T01:02:03+99:00", "٢٠٢٦-11-22T01:02:03Z", "2026-11-22T01:02:03Z "],
)  # fmt: skip
def test_other_texts_are_no_times(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        ns_from_rfc3339(text)
