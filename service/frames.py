"""Frames as they arrive: their headers, their limits, and the one way they become pixels.

A header is parsed here, without a codec, so that a frame's size is known before a byte of it is decoded.
"""

from __future__ import annotations

import itertools
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np
import simplejpeg

from service.errors import FrameError, TooLargeError
from service.geometry.camera import Camera, UInt8Image
from service.site import Site

MAX_JPEG_SCANS = 100
"""A progressive JPEG may repeat the whole picture in every scan; common encoders write about ten."""

DECODE_SLACK_PX = 32
"""A scaled picture may be this much narrower than asked for: 1284 px at 4/8 are 642 where a network takes 672."""

WHOLE_FACTOR_LEAVES = 0.9
"""A picture that is reduced by a whole factor may come out this much narrower than it could be."""

_SCALE_DENOMINATOR = 8
_JPEG_START = b"\xff\xd8"
_JPEG_END = b"\xff\xd9"
_JPEG_TAIL = 1024
_PNG_START = b"\x89PNG\r\n\x1a\n"
_SOF_SUPPORTED = {0xC0, 0xC1, 0xC2}
_SOF_ALL = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_STANDALONE = {0x01, *range(0xD0, 0xD8)}
_START_OF_SCAN, _END_OF_IMAGE = 0xDA, 0xD9
_NOT_AN_IMAGE = "Send a complete JPEG (baseline or progressive) or PNG file."


@dataclass(frozen=True, eq=False)
class EncodedFrame:
    """One camera's picture as received."""

    camera_id: str
    data: bytes
    """A JPEG or PNG file."""
    captured_at_ns: int | None
    """Capture time in nanoseconds since 1970 (UTC), or None when the sender gave none for this camera."""


@dataclass(frozen=True)
class RefusedFrame:
    """A camera's frame that :func:`check_frame` refused."""

    captured_at_ns: int
    """Nanoseconds since 1970 (UTC)."""
    reason: str


@dataclass(frozen=True, eq=False)
class FrameSet:
    """What a site's cameras saw at one moment: one frame of each camera that delivered, 1..N."""

    site: Site
    frames: tuple[EncodedFrame, ...]
    captured_at_ns: int
    """The set's capture time, nanoseconds since 1970 (UTC)."""
    sequence: int
    """Counts a site's sets from 1."""
    stale: frozenset[str] = frozenset()
    """Cameras whose frame is of an earlier moment and stands in for one that did not come in time."""
    refused: Mapping[str, RefusedFrame] = field(default_factory=dict)
    """What cameras without a frame in this set sent instead, by camera id."""

    def split(self, count: int) -> list[FrameSet]:
        """The set in ``count`` parts (no more than it has frames) of about as many frames each, in their order."""
        ends = [len(self.frames) * number // count for number in range(count + 1)]
        return [replace(self, frames=self.frames[start:end]) for start, end in itertools.pairwise(ends)]


@dataclass(frozen=True)
class ImageHeader:
    """What the first bytes of a picture say."""

    kind: Literal["jpeg", "png"]
    width: int
    """px"""
    height: int
    """px"""


@dataclass(frozen=True)
class FrameLimits:
    """What one frame may weigh before anybody decodes it."""

    max_frame_bytes: int = 8 * 2**20
    max_pixels: int = 7680 * 4320


def read_header(data: bytes) -> ImageHeader:
    """Kind and size of a JPEG or PNG from its header alone. Raises FrameError when there is none."""
    if data.startswith(_JPEG_START):
        return _read_jpeg_header(data)
    if data.startswith(_PNG_START):
        return _read_png_header(data)
    shown = data[:8].hex(" ") or "nothing"
    raise FrameError(f"not a JPEG or PNG: {len(data)} bytes that begin with {shown}.", remedy=_NOT_AN_IMAGE)


def check_frame(data: bytes, camera: Camera, limits: FrameLimits) -> None:
    """Refuse a frame that its header or its end already condemns.

    Raises, with the camera's id as field: TooLargeError when it exceeds the limits; FrameError when it is empty, not an
    image, truncated, or not of the camera's size.
    """
    field = camera.id
    if not data:
        raise FrameError("the part is empty (0 bytes).", field=field, remedy=_NOT_AN_IMAGE)
    if len(data) > limits.max_frame_bytes:
        raise TooLargeError(
            f"{len(data)} bytes; a frame may have {limits.max_frame_bytes}.",
            field=field,
            remedy="Compress it more, or raise QUADLIFT_MAX_FRAME_BYTES.",
        )
    try:
        header = read_header(data)
    except FrameError as error:
        raise FrameError(error.message, field=field, remedy=error.remedy) from None
    if header.width * header.height > limits.max_pixels:
        raise TooLargeError(
            f"the header announces {header.width}x{header.height} px; a frame may have {limits.max_pixels} pixels.",
            field=field,
            remedy=f"Send {camera.width}x{camera.height} px, the size this camera is calibrated for.",
        )
    if (header.width, header.height) != (camera.width, camera.height):
        raise FrameError(
            f"{header.width}x{header.height} px, but the camera is calibrated for {camera.width}x{camera.height} px.",
            field=field,
            remedy="Send the camera's own size, or change its calibration with PUT /sites/{id}/cameras/{camera}.",
        )
    _check_end(data, header, field)


def decoded_size(width: int, height: int, max_width: int) -> tuple[int, int]:
    """Size (w, h) in px that :func:`decode` gives a picture of ``width`` x ``height``.

    A picture no wider than ``max_width`` keeps its size; a wider one takes the smallest n/8 of libjpeg (sides rounded up)
    not more than ``DECODE_SLACK_PX`` narrower than ``max_width``, and if that is still wider, ``max_width``.
    """
    scaled = _scaled_size(width, height, max_width)
    if scaled[0] <= max_width:
        return scaled
    return max_width, max(1, round(scaled[1] * max_width / scaled[0]))


def decode(data: bytes, camera: Camera, max_width: int) -> UInt8Image:
    """Decode a frame that passed :func:`check_frame` to RGB (H, W, 3) uint8, contiguous, of :func:`decoded_size`.

    Strict: anything that the codec would paper over (truncation, corrupt entropy data, wrong checksums) raises FrameError
    with the camera's id as field. The geometry of the result is ``camera.scaled(w, h)``.
    """
    scaled = _scaled_size(camera.width, camera.height, max_width)
    image = _decode_jpeg(data, camera, scaled) if data.startswith(_JPEG_START) else _decode_png(data, camera)
    size = decoded_size(camera.width, camera.height, max_width)
    if (image.shape[1], image.shape[0]) != size:
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return np.ascontiguousarray(image)


def reduced(image: UInt8Image, max_width: int) -> UInt8Image:
    """An image (H, W, 3) at most ``max_width`` px wide; the same one where it is narrow enough.

    By a whole factor, which is quick, unless that leaves less than ``WHOLE_FACTOR_LEAVES`` of ``max_width``.
    """
    height, width = image.shape[:2]
    factor = -(-width // max_width)
    if factor == 1:
        return image
    if width // factor < WHOLE_FACTOR_LEAVES * max_width:
        return resized(image, max_width)
    size = (width // factor, max(round(height / factor), 1))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def resized(image: UInt8Image, width: int) -> UInt8Image:
    """An image (H, W, 3) at a width, px, larger or smaller; the same one where it has it."""
    if image.shape[1] == width:
        return image
    size = (width, max(round(image.shape[0] * width / image.shape[1]), 1))
    interpolation = cv2.INTER_AREA if image.shape[1] > width else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(image, size, interpolation=interpolation), dtype=np.uint8)


def _scaled_size(width: int, height: int, max_width: int) -> tuple[int, int]:
    if width <= max_width:
        return width, height
    for numerator in range(1, _SCALE_DENOMINATOR):
        scaled = -(-width * numerator // _SCALE_DENOMINATOR)
        if scaled >= max_width - DECODE_SLACK_PX:
            return scaled, -(-height * numerator // _SCALE_DENOMINATOR)
    return width, height


def _decode_jpeg(data: bytes, camera: Camera, scaled: tuple[int, int]) -> UInt8Image:
    min_width = scaled[0] if scaled[0] < camera.width else 0
    try:
        # Colour from its four times coarser grid without smoothing: an eighth quicker, and 0.15 of 255 levels off on average.
        image: UInt8Image = simplejpeg.decode_jpeg(data, "RGB", min_width=min_width, strict=True, fastupsample=True)
    except (ValueError, MemoryError) as error:
        raise FrameError(f"the JPEG is damaged: {error}.", field=camera.id, remedy=_NOT_AN_IMAGE) from None
    if (image.shape[1], image.shape[0]) != scaled:
        raise FrameError(
            f"the JPEG holds {image.shape[1]}x{image.shape[0]} px where {scaled[0]}x{scaled[1]} were expected.",
            field=camera.id,
            remedy=_NOT_AN_IMAGE,
        )
    return image


def _decode_png(data: bytes, camera: Camera) -> UInt8Image:
    _check_png_chunks(data, camera.id)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        image = None
    if image is None or image.shape[:2] != (camera.height, camera.width):
        raise FrameError("the PNG's pixels cannot be read.", field=camera.id, remedy=_NOT_AN_IMAGE)
    return np.asarray(image, dtype=np.uint8)


def _read_jpeg_header(data: bytes) -> ImageHeader:
    position = len(_JPEG_START)
    while True:
        # A marker is 0xFF and a code; any number of fill bytes 0xFF may stand before the code (ITU T.81, B.1.1.2).
        if data[position : position + 1] != b"\xff":
            raise _no_jpeg_header(f"no marker at byte {position}")
        while data[position : position + 1] == b"\xff":
            position += 1
        if position >= len(data):
            raise _no_jpeg_header("the file ends in its header")
        code = data[position]
        position += 1
        if code in _STANDALONE:
            continue
        if code in (_START_OF_SCAN, _END_OF_IMAGE):
            raise _no_jpeg_header("no frame header before the picture's data")
        if position + 2 > len(data):
            raise _no_jpeg_header("the file ends in its header")
        (length,) = struct.unpack_from(">H", data, position)
        if length < 2:
            raise _no_jpeg_header(f"a segment of length {length} at byte {position}")
        if code in _SOF_ALL:
            return _parse_frame_header(data[position : position + length], code)
        position += length


def _parse_frame_header(segment: bytes, code: int) -> ImageHeader:
    if code not in _SOF_SUPPORTED:
        raise FrameError(f"a JPEG of kind SOF{code - 0xC0}, which few decoders read.", remedy=_NOT_AN_IMAGE)
    if len(segment) < 8:
        raise _no_jpeg_header("the file ends in its header")
    precision, height, width = struct.unpack_from(">BHH", segment, 2)
    if precision != 8 or not width or not height:
        raise _no_jpeg_header(f"{width}x{height} px of {precision} bits")
    return ImageHeader("jpeg", width, height)


def _no_jpeg_header(reason: str) -> FrameError:
    return FrameError(f"not a whole JPEG header: {reason}.", remedy=_NOT_AN_IMAGE)


def _read_png_header(data: bytes) -> ImageHeader:
    if len(data) < 33 or data[8:16] != b"\x00\x00\x00\rIHDR":
        raise FrameError("not a whole PNG header: no IHDR chunk.", remedy=_NOT_AN_IMAGE)
    width, height = struct.unpack_from(">II", data, 16)
    if not width or not height:
        raise FrameError(f"not a whole PNG header: {width}x{height} px.", remedy=_NOT_AN_IMAGE)
    return ImageHeader("png", width, height)


def _check_end(data: bytes, header: ImageHeader, field: str) -> None:
    if header.kind == "png":
        if b"IEND" not in data[-_JPEG_TAIL:]:
            raise FrameError("the PNG is truncated: it has no IEND chunk.", field=field, remedy=_NOT_AN_IMAGE)
        return
    # Some cameras pad their files to a block; zeros behind the end marker do no harm.
    if not data[-_JPEG_TAIL:].rstrip(b"\x00\r\n").endswith(_JPEG_END):
        raise FrameError(
            f"the JPEG is truncated: {len(data)} bytes without an end marker.", field=field, remedy="Send the whole file."
        )
    scans = data.count(b"\xff\xda")
    if scans > MAX_JPEG_SCANS:
        raise TooLargeError(
            f"a JPEG of {scans} scans; {MAX_JPEG_SCANS} are allowed.", field=field, remedy="Send baseline JPEGs."
        )


def _check_png_chunks(data: bytes, field: str) -> None:
    """Walk the chunks and their checksums: OpenCV decodes a torn PNG to a half-empty picture without a word."""
    position = len(_PNG_START)
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        end = position + 12 + length
        if end > len(data):
            break
        kind = data[position + 4 : position + 8]
        if zlib.crc32(data[position + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            raise FrameError(f"the PNG's {kind!r} chunk is damaged.", field=field, remedy=_NOT_AN_IMAGE)
        if kind == b"IEND":
            return
        position = end
    raise FrameError("the PNG is truncated.", field=field, remedy=_NOT_AN_IMAGE)
