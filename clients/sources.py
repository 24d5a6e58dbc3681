"""Where ``quadlift feed`` gets a camera's frames: JPEG files, folders of them, video files, network streams."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2

JPEG_QUALITY = 90
TIMEOUT_MS = 5000
"""A network stream that does not open, or brings no picture, for this long is broken."""
_SUFFIXES = (".jpg", ".jpeg")
_SCHEMES = ("rtsp://", "rtsps://", "http://", "https://")


class SourceError(Exception):
    """A source cannot be read; the message names it."""


class Source(Protocol):
    """One camera's frames. Blocks while it reads; used by one thread at a time."""

    @property
    def is_live(self) -> bool:
        """Whether frames come at their own time, so that theirs is the time of arrival."""
        ...

    @property
    def rate_hz(self) -> float | None:
        """The recording's own rate, if it says."""
        ...

    def frames(self) -> Iterator[bytes]:
        """JPEG files from the beginning to the end. Raises SourceError."""
        ...


@dataclass(frozen=True)
class JpegFiles:
    """JPEG files in the order of their names."""

    paths: tuple[Path, ...]
    is_live: bool = False
    rate_hz: float | None = None

    def frames(self) -> Iterator[bytes]:
        """The files as they are. Raises SourceError."""
        for path in self.paths:
            try:
                yield path.read_bytes()
            except OSError as error:
                raise SourceError(f"{path}: {error.strerror}.") from error


@dataclass(frozen=True)
class Video:
    """A video file through OpenCV; its frames are encoded as JPEG."""

    path: Path
    rate_hz: float | None
    is_live: bool = False

    def frames(self) -> Iterator[bytes]:
        """All pictures of the file. Raises SourceError."""
        yield from _pictures(cv2.VideoCapture(str(self.path)), str(self.path))


@dataclass(frozen=True)
class NetworkStream:
    """A camera's stream (RTSP, or video over HTTP) through OpenCV. It ends when it breaks; it may be opened again."""

    url: str
    is_live: bool = True
    rate_hz: float | None = None

    def frames(self) -> Iterator[bytes]:
        """Pictures until the connection breaks. Raises SourceError when there is none."""
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, TIMEOUT_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, TIMEOUT_MS]
        yield from _pictures(cv2.VideoCapture(self.url, cv2.CAP_FFMPEG, limits), self.url)


def open_source(text: str) -> Source:
    """A source from what the user wrote: a stream's URL, a folder of JPEGs, one JPEG, or a video file.

    Raises SourceError when there is no such file, or nothing in it.
    """
    if text.startswith(_SCHEMES):
        return NetworkStream(text)
    path = Path(text)
    if path.is_dir():
        paths = tuple(sorted(p for p in path.iterdir() if p.suffix.lower() in _SUFFIXES))
        if not paths:
            raise SourceError(f"{path}: no *.jpg in this folder.")
        return JpegFiles(paths)
    if not path.is_file():
        raise SourceError(f"{path}: no such file or folder.")
    if path.suffix.lower() in _SUFFIXES:
        return JpegFiles((path,))
    return Video(path, _video_rate(path))


def _video_rate(path: Path) -> float | None:
    capture = cv2.VideoCapture(str(path))
    try:
        if not capture.isOpened():
            raise SourceError(f"{path}: OpenCV cannot read it as a video.")
        rate: float = capture.get(cv2.CAP_PROP_FPS)
    finally:
        capture.release()
    return rate if 0 < rate < 1000 else None


def _pictures(capture: cv2.VideoCapture, name: str) -> Iterator[bytes]:
    try:
        if not capture.isOpened():
            raise SourceError(f"{_without_password(name)}: cannot be opened.")
        while True:
            is_read, picture = capture.read()
            if not is_read:
                return
            is_encoded, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            if is_encoded:
                yield data.tobytes()
    finally:
        capture.release()


def _without_password(name: str) -> str:
    """URLs of cameras often hold their password."""
    scheme, separator, rest = name.partition("://")
    return f"{scheme}://{rest.rpartition('@')[2]}" if separator else name
