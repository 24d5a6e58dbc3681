"""Frames: header parsing, limits, strict decoding, and the size law that the geometry relies on."""

from __future__ import annotations

import contextlib
import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest
import simplejpeg
from hypothesis import given, settings
from hypothesis import strategies as st

from service.errors import FrameError, TooLargeError
from service.frames import EncodedFrame, FrameLimits, FrameSet, check_frame, decode, decoded_size, read_header, reduced, resized
from service.geometry.camera import Camera
from service.site import Site

LIMITS = FrameLimits()


def camera(width: int = 128, height: int = 64) -> Camera:
    return Camera("north", width, height, np.array([[90.0, 0, width / 2], [0, 90.0, height / 2], [0, 0, 1]]), np.eye(4))


def picture(width: int = 128, height: int = 64) -> np.ndarray:
    """A smooth picture whose red grows to the right, green downwards."""
    x, y = np.meshgrid(np.linspace(0, 255, width), np.linspace(0, 255, height))
    return np.ascontiguousarray(np.stack([x, y, np.full_like(x, 40)], -1).astype(np.uint8))


def jpeg(width: int = 128, height: int = 64) -> bytes:
    data: bytes = simplejpeg.encode_jpeg(picture(width, height), quality=92)
    return data


def png(width: int = 128, height: int = 64) -> bytes:
    return bytes(cv2.imencode(".png", picture(width, height)[..., ::-1])[1])


def with_header_size(data: bytes, width: int, height: int) -> bytes:
    """A JPEG whose frame header announces another size."""
    at = next(i for i in range(len(data)) if data[i] == 0xFF and data[i + 1] in (0xC0, 0xC1, 0xC2))
    return data[: at + 5] + struct.pack(">HH", height, width) + data[at + 9 :]


@pytest.mark.parametrize("progressive", [0, 1])
def test_header_of_baseline_and_progressive_jpeg(progressive: int) -> None:
    data = bytes(cv2.imencode(".jpg", picture(130, 70), [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])[1])
    header = read_header(data)
    assert (header.kind, header.width, header.height) == ("jpeg", 130, 70)


def test_header_of_png() -> None:
    header = read_header(png(130, 70))
    assert (header.kind, header.width, header.height) == ("png", 130, 70)


def test_header_skips_fill_bytes_and_a_thumbnail_in_app1() -> None:
    thumbnail = jpeg(16, 16)
    app1 = b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 2) + thumbnail
    data = jpeg()[:2] + app1 + b"\xff\xff" + jpeg()[2:]
    assert read_header(data).width == 128
    assert decode(data, camera(), 128).shape == (64, 128, 3)


@pytest.mark.parametrize("cut", [0, 1, 2, 3, 4, 10, 20, 100])
def test_header_cut_short_is_a_frame_error(cut: int) -> None:
    with pytest.raises(FrameError):
        read_header(jpeg()[:cut])


@given(st.binary(max_size=200))
def test_no_bytes_crash_the_header_parser(tail: bytes) -> None:
    for start in (b"", b"\xff\xd8", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR"):
        with contextlib.suppress(FrameError):
            header = read_header(start + tail)
            assert header.width > 0
            assert header.height > 0


@pytest.mark.parametrize(
    ("data", "kind", "says"),
    [
        (b"", FrameError, "empty"),
        (b"GIF89a not a jpeg", FrameError, "47 49 46"),
        (jpeg()[:-40], FrameError, "truncated"),
        (png()[:-40], FrameError, "truncated"),
        (jpeg(64, 64), FrameError, "64x64"),
        (with_header_size(jpeg(), 10000, 10000), TooLargeError, "10000x10000"),
        (jpeg() + b"\xff\xda" * 200 + b"\xff\xd9", TooLargeError, "scans"),
        (b"\xff\xd8\xff\xc9" + struct.pack(">HBHH", 11, 8, 64, 128) + bytes(4), FrameError, "SOF9"),
    ],
)
def test_bad_frames_are_named(data: bytes, kind: type[FrameError | TooLargeError], says: str) -> None:
    with pytest.raises(kind, match=says) as caught:
        check_frame(data, camera(), LIMITS)
    assert caught.value.field == "north"
    assert caught.value.remedy


def test_byte_limit() -> None:
    with pytest.raises(TooLargeError, match="may have 100"):
        check_frame(jpeg(), camera(), replace(LIMITS, max_frame_bytes=100))


@pytest.mark.parametrize("data", [jpeg(), png(), jpeg() + bytes(300)])
def test_good_frames_pass(data: bytes) -> None:
    check_frame(data, camera(), LIMITS)
    image = decode(data, camera(), 1000)
    assert image.dtype == np.uint8
    assert image.flags.c_contiguous
    assert np.abs(image.astype(int) - picture()).mean() < 3


@pytest.mark.parametrize(
    "data",
    [
        jpeg()[: len(jpeg()) // 2] + b"\xff\xd9",
        with_header_size(jpeg(64, 64), 128, 64),
        jpeg()[:300] + bytes(100) + jpeg()[400:],
        png()[:200] + b"\x00" + png()[201:],
        png()[:200] + png()[-12:],
    ],
)
def test_decoding_is_strict(data: bytes) -> None:
    with pytest.raises(FrameError) as caught:
        decode(data, camera(), 1000)
    assert caught.value.field == "north"


def test_sizes_of_the_standard_camera() -> None:
    assert decoded_size(1284, 384, 672) == (642, 192)
    assert decoded_size(1284, 384, 1284) == (1284, 384)
    assert decoded_size(640, 192, 672) == (640, 192)
    assert decoded_size(1920, 1200, 672) == (672, 420)


@settings(max_examples=60, deadline=None)
@given(st.integers(33, 400), st.integers(17, 120), st.integers(33, 420))
def test_decoded_size_tells_what_decode_returns(width: int, height: int, max_width: int) -> None:
    size = decoded_size(width, height, max_width)
    for data in (jpeg(width, height), png(width, height)):
        image = decode(data, camera(width, height), max_width)
        assert (image.shape[1], image.shape[0]) == size
    assert size[0] <= max_width
    assert size[0] <= width
    assert size[0] >= min(width, max_width - 32)


def test_a_pixel_stays_where_the_scaled_camera_expects_it() -> None:
    """The scaled picture's red at column u equals the full picture's at the column that Camera.scaled maps to u."""
    full = picture(1284, 384).astype(float)
    image = decode(jpeg(1284, 384), camera(1284, 384), 672).astype(float)
    u_full = 2 * np.arange(20, 620) + 0.5
    expected = np.interp(u_full, np.arange(1284), full[100, :, 0])
    assert np.abs(image[50, 20:620, 0] - expected).mean() < 1.0


@given(width=st.integers(1, 700), height=st.integers(1, 40), max_width=st.integers(1, 300))
def test_a_reduced_picture_is_narrow_enough_and_keeps_its_mean(width: int, height: int, max_width: int) -> None:
    image = np.random.default_rng(width).integers(0, 255, (height, width, 3), dtype=np.uint8)
    small = reduced(image, max_width)
    assert small.shape[1] <= max_width
    if width <= max_width:
        assert small is image
    else:
        assert small.shape[1] >= min(0.9 * max_width, width)
        assert abs(small.shape[0] - max(height * small.shape[1] / width, 1)) <= 1 + height / width


@pytest.mark.parametrize("width", [16, 48, 64, 100])
def test_a_resized_picture_has_the_width_and_shows_the_same(width: int) -> None:
    ramp = np.repeat(np.arange(64, dtype=np.uint8)[None, :, None] * 3, 32, 0).repeat(3, 2)
    image = resized(ramp, width)
    assert image.shape == (round(32 * width / 64), width, 3)
    u = (np.arange(width) + 0.5) * 64 / width - 0.5
    inner = (u > 2) & (u < 61)
    assert np.abs(image[5, inner, 0] - 3 * u[inner]).max() <= 1.5
    if width == 64:
        assert image is ramp


def test_halving_is_a_mean_of_four() -> None:
    image = np.arange(2 * 4 * 3, dtype=np.uint8).reshape(2, 4, 3)
    expected = image.reshape(1, 2, 2, 2, 3).mean((1, 3))
    np.testing.assert_allclose(reduced(image, 2), expected, atol=0.5)


@given(frames=st.integers(1, 20), count=st.integers(1, 20))
def test_a_set_is_split_into_parts_of_about_as_many_frames(frames: int, count: int) -> None:
    whole = FrameSet(Site("demo"), tuple(EncodedFrame(f"c{n}", b"", None) for n in range(frames)), 5, 7)
    parts = whole.split(min(count, frames))
    assert tuple(frame for part in parts for frame in part.frames) == whole.frames
    sizes = [len(part.frames) for part in parts]
    assert 1 <= min(sizes) <= max(sizes) <= min(sizes) + 1
    assert {(part.site.id, part.captured_at_ns, part.sequence) for part in parts} == {("demo", 5, 7)}
