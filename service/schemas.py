"""The wire contract: what clients send and receive. Additions only.

This module imports nothing heavy, so that clients can share it.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector3 = Annotated[list[Finite], Field(min_length=3, max_length=3)]
Covariance7 = Annotated[list[Annotated[list[Finite], Field(min_length=7, max_length=7)]], Field(min_length=7, max_length=7)]

CAPTURED_AT = "captured_at"
"""Form field with a set's capture time; ``captured_at.<camera>`` is one camera's."""

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_NS = 1_000_000_000
_MAX_NS = 2**63 - 1
_RFC3339 = re.compile(
    r"(\d{4}-\d{2}-\d{2})[Tt ](\d{2}:\d{2}):(\d{2})(?:\.(\d+))?([Zz]|[+-]\d{2}:\d{2})",
    re.ASCII,
)


class _Message(BaseModel):
    # Fields may be added to the contract: a client of today must read the messages of tomorrow.
    model_config = ConfigDict(extra="ignore", populate_by_name=True, use_attribute_docstrings=True)


class Box(_Message):
    """One vehicle in the site's world frame (East, North, up; metres, radians)."""

    track_id: str | None = None
    """Identity over time; null where no stream runs."""
    class_: Annotated[str, Field(alias="class")]
    """For example ``car``."""
    score: Annotated[float, Field(ge=0, le=1)]
    """Confidence."""
    center: Vector3
    """Geometric centre x, y, z, metres."""
    size: Vector3
    """Length, width, height, metres."""
    yaw: Finite
    """Heading, counter-clockwise from East in [-pi, pi), radians."""
    velocity: Vector3 | None = None
    """Metres a second; null where no stream runs."""
    covariance: Covariance7
    """Over x, y, z, length, width, height, yaw."""
    cameras: list[str]
    """Cameras whose detections the box is made of."""


class CameraStatus(_Message):
    """What one camera of the site gave to a frame set."""

    status: Literal["ok", "stale", "missing", "bad"]
    """``stale``: an earlier frame stands in for one that did not come in time. ``missing``: no frame came. ``bad``: it could
    not be used; ``message`` says why."""
    captured_at: str | None = None
    """RFC 3339, UTC."""
    skew_ms: Finite | None = None
    """Its capture time minus the set's, milliseconds."""
    detections: int | None = None
    """Vehicles seen in this frame, before fusion."""
    hard: bool | None = None
    """Whether the depth-guided detector looked at this frame too; only where the service has one."""
    message: str | None = None


class Timing(_Message):
    """Milliseconds that each step took; ``total`` is the whole set's, queueing left out."""

    decode: Finite
    detect: Finite
    orient: Finite
    depth: Finite
    lift: Finite
    guided: Finite | None = None
    """Only where the service has a depth-guided detector."""
    fuse: Finite
    track: Finite
    total: Finite


class IngestHeader(_Message):
    """What a camera's frame says of itself in a message of ``WS /ingest/{site}``."""

    camera: Annotated[str, Field(min_length=1, max_length=64)]
    """The camera's id."""
    captured_at: Annotated[str, Field(max_length=64)]
    """RFC 3339 with a zone."""
    sequence: Annotated[int, Field(ge=0, le=2**63 - 1, strict=True)]
    """Counts the camera's frames."""


class Detections(_Message):
    """The fused boxes of one frame set: the answer of ``POST /detect`` and the message of ``WS /stream/{site}``."""

    site: str
    sequence: int
    """Counts the site's frame sets; a gap means sets that were dropped."""
    captured_at: str
    """RFC 3339, UTC."""
    boxes: list[Box]
    cameras: dict[str, CameraStatus]
    """Every camera of the site."""
    degraded: bool
    """Whether any camera is not ``ok``."""
    timing_ms: Timing
    per_camera: dict[str, list[Box]] | None = None
    """Each camera's own boxes before fusion; only when asked for."""


class ErrorDetail(_Message):
    """What was wrong, where, and what to do about it."""

    code: str
    message: str
    field: str | None = None
    remedy: str | None = None


class ErrorMessage(_Message):
    """The body of every answer that is not a success."""

    error: ErrorDetail


class Health(_Message):
    """The answer of the health checks when all is well."""

    status: Literal["live", "ready"]
    version: str


def rfc3339_from_ns(time_ns: int) -> str:
    """UTC time as RFC 3339 with as many digits as it needs: milliseconds, microseconds or nanoseconds."""
    seconds, rest = divmod(time_ns, _NS)
    digits = f"{rest:09d}"
    while len(digits) > 3 and digits.endswith("000"):
        digits = digits[:-3]
    return f"{_EPOCH + timedelta(seconds=seconds):%Y-%m-%dT%H:%M:%S}.{digits}Z"


def ns_from_rfc3339(text: str) -> int:
    """Nanoseconds since 1970 (UTC) of an RFC 3339 time with a zone; digits beyond nanoseconds are cut.

    Raises ValueError when it is not one, or lies before 1970 or after 2262.
    """
    match = _RFC3339.fullmatch(text)
    if match is None:
        raise ValueError("not an RFC 3339 time with a zone")
    date, minutes, second, fraction, zone = match.groups()
    # Leap seconds are legal in RFC 3339 and unknown to datetime; they count as the second after.
    leap = second == "60"
    moment = datetime.fromisoformat(f"{date}T{minutes}:{'59' if leap else second}{zone.upper().replace('Z', '+00:00')}")
    since = moment - _EPOCH
    time_ns = (since.days * 86400 + since.seconds + leap) * _NS + int((fraction or "0")[:9].ljust(9, "0"))
    if not 0 <= time_ns <= _MAX_NS:
        raise ValueError("outside 1970 to 2262")
    return time_ns
