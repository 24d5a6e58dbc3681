"""One message of ``WS /ingest/{site}``: 4-byte big-endian header length, JSON header, then the frame's file."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from pydantic import ValidationError

from service.errors import InputError, TooLargeError
from service.schemas import IngestHeader, ns_from_rfc3339

_LENGTH = struct.Struct(">I")
_FORM = 'Send 4 bytes header length (big-endian), the header {"camera", "captured_at", "sequence"} as JSON, then the JPEG.'


@dataclass(frozen=True, eq=False)
class IngestMessage:
    """A parsed message; the frame itself is not looked at yet."""

    camera_id: str
    captured_at_ns: int
    """Nanoseconds since 1970 (UTC)."""
    sequence: int
    """Counts the camera's frames, as the sender does."""
    data: bytes
    """What should be a JPEG or PNG file."""


def parse_message(message: bytes, *, max_header_bytes: int, max_frame_bytes: int) -> IngestMessage:
    """The parts of a message. Raises InputError and TooLargeError; the frame is copied only when the rest is right."""
    if len(message) < _LENGTH.size:
        raise InputError(f"{len(message)} bytes; a message begins with 4.", field="message", remedy=_FORM)
    (length,) = _LENGTH.unpack_from(message)
    if length > max_header_bytes:
        raise TooLargeError(f"a header of {length} bytes; {max_header_bytes} are allowed.", field="header", remedy=_FORM)
    end = _LENGTH.size + length
    if end > len(message):
        raise InputError(f"a header of {length} bytes in a message of {len(message)}.", field="header", remedy=_FORM)
    if len(message) - end > max_frame_bytes:
        raise TooLargeError(
            f"a frame of {len(message) - end} bytes; {max_frame_bytes} are allowed.",
            field="frame",
            remedy="Compress it more, or raise QUADLIFT_MAX_FRAME_BYTES.",
        )
    header, captured_at_ns = _parse_header(message[_LENGTH.size : end])
    return IngestMessage(header.camera, captured_at_ns, header.sequence, message[end:])


def _parse_header(data: bytes) -> tuple[IngestHeader, int]:
    try:
        header = IngestHeader.model_validate_json(data)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        place = ".".join(str(part) for part in first["loc"]) or "header"
        raise InputError(f"{first['msg'][:200]}.", field=place[:80], remedy=_FORM) from None
    try:
        return header, ns_from_rfc3339(header.captured_at)
    except ValueError as error:
        raise InputError(
            f"'{header.captured_at}': {error}.",
            field="captured_at",
            remedy="Give RFC 3339 with a zone, for example 2026-11-22T01:02:03.040Z.",
        ) from None
