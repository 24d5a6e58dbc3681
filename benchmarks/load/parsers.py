"""The parsers that read what strangers send, each with whole inputs to begin from."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from benchmarks.load.mutation import ByteMutator, JsonMutator, Maker
from clients.clip import open_clip
from clients.ingest import ingest_message
from service.api.body import parse_json
from service.api.detect import frames_from_form
from service.api.errors import error_response
from service.api.ingest_message import parse_message
from service.errors import QuadliftError
from service.frames import FrameLimits, check_frame, decode, read_header
from service.geometry.camera import Camera
from service.site import parse_site, site_document

BOUNDARY = b"frontier"
_SIDE_PX = 24
_LIMITS = FrameLimits(max_frame_bytes=4096, max_pixels=_SIDE_PX**2)
_CAPTURED_AT_NS = 1_760_000_000_123_000_000


@dataclass(frozen=True)
class ParserTarget:
    """One parser under attack."""

    name: str
    run: Callable[[bytes], None]
    """Reads one input; raises QuadliftError where it refuses it."""
    corpus: tuple[bytes, ...]
    words: tuple[bytes, ...]
    documents: tuple[Any, ...] = ()
    """Where inputs are JSON: the documents of the corpus, to be changed as such."""

    def maker(self, seed: int) -> Maker:
        """Broken inputs, the same for the same seed."""
        return JsonMutator(self.documents, seed) if self.documents else ByteMutator(self.corpus, self.words, seed)


def parser_targets() -> dict[str, ParserTarget]:
    """All parsers, by name."""
    targets = (_frames(), _ingest(), _site(), _multipart())
    return {target.name: target for target in targets}


def _answering(parse: Callable[[bytes], object]) -> Callable[[bytes], None]:
    """A parser together with the answer that its refusal becomes: a message that cannot be written is a crash, too."""

    def run(data: bytes) -> None:
        try:
            parse(data)
        except QuadliftError as error:
            error_response(error)
            raise

    return run


def small_pictures() -> tuple[bytes, ...]:
    """Whole JPEG and PNG files of all kinds that cameras send, 24 px square: as quick to read as they can be."""
    colour = np.random.default_rng(7).integers(0, 255, (_SIDE_PX, _SIDE_PX, 3), dtype=np.uint8)
    jpeg: tuple[list[int], ...] = (
        [], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 1],
        [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444], [cv2.IMWRITE_JPEG_OPTIMIZE, 1],
    )  # fmt: skip
    pictures: list[tuple[str, np.ndarray[Any, Any], Sequence[int]]] = [(".jpg", colour, options) for options in jpeg]
    pictures += [(".jpg", colour[..., 0], []), (".png", colour, []), (".png", colour[..., 0], [])]
    pictures += [(".png", colour.astype(np.uint16) * 257, []), (".png", np.dstack([colour, colour[..., :1]]), [])]
    return tuple(cv2.imencode(suffix, picture, list(options))[1].tobytes() for suffix, picture, options in pictures)


def small_camera(camera_id: str = "north") -> Camera:
    """A camera of the size of :func:`small_pictures`."""
    K = np.array([[20.0, 0, 12], [0, 20, 12], [0, 0, 1]])
    return Camera(camera_id, _SIDE_PX, _SIDE_PX, K, np.eye(4), np.zeros(0))


def _frames() -> ParserTarget:
    camera = small_camera()

    def parse(data: bytes) -> None:
        read_header(data)
        check_frame(data, camera, _LIMITS)
        decode(data, camera, _SIDE_PX)

    words = (
        b"\xff\xd8", b"\xff\xd9", b"\xff\xda", b"\xff\xc0\x00\x11\x08", b"\xff\xc2", b"\xff\xc4", b"\xff\xdb",
        b"\xff\xe1\xff\xff",
        b"\xff\xff\xff", b"\xff\xdd\x00\x04", b"\x89PNG\r\n\x1a\n", b"IHDR", b"IDAT", b"IEND", b"\x00\x00\x00\x00",
        b"\x00\x18",
    )  # fmt: skip
    return ParserTarget("frame", _answering(parse), small_pictures(), words)


def _ingest() -> ParserTarget:
    whole = [
        ingest_message(camera, data, _CAPTURED_AT_NS + step, step)
        for camera in ("north", "c" * 64)
        for step, data in enumerate((b"", b"\xff\xd8\xff\xd9", small_pictures()[0][:64]))
    ]
    words = (
        b"{", b"}", b'"', b"\\ud800", b"\\u0000", b"null", b"-1", b"1e999", b"9223372036854775808", b"[" * 40, b"camera",
        b"sequence",
        b"captured_at", b"2026-02-30T00:00:00Z", b"9999-12-31T23:59:60Z", b"0000-", b"+99:99", b"-23:59",
        b".999999999999", b"\xc3\x28",
    )  # fmt: skip
    run = _answering(lambda data: parse_message(data, max_header_bytes=1024, max_frame_bytes=4096))
    return ParserTarget("ingest_header", run, tuple(whole), words)


def _site() -> ParserTarget:
    shipped = open_clip().site
    camera = shipped["cameras"][0]
    grid = {"grid": {"origin_xy": [-10.0, -10.0], "cell_m": 10.0, "heights": [[0.0, 0.1, 0.2]] * 3}}
    small = {"id": "one", "cameras": [camera | {"distortion": [0.1, 0.0, 0.0, 0.0, 0.0]}], "ground": grid}
    small["accuracy"] = {"ground_m": 0.1, "ground_per_m": 0.002, "camera_m": 0.1, "camera_rad": 0.001}
    documents = (shipped, small, {"id": "empty"})
    words = (
        b"NaN",
        b"Infinity",
        b"1e400",
        b"[",
        b"]",
        b"{",
        b"}",
        b'"\\ud800"',
        b"null",
        b"-",
        b'"cameras"',
        b'"grid"',
        b'"K"',
    )

    def parse(data: bytes) -> None:
        site_document(parse_site(parse_json(data)))

    corpus = tuple(json.dumps(document).encode() for document in documents)
    return ParserTarget("site", _answering(parse), corpus, words, documents)


def _multipart() -> ParserTarget:
    site = replace(parse_site({"id": "one"}), cameras=(small_camera("north"), small_camera("east")))
    kind = f"multipart/form-data; boundary={BOUNDARY.decode()}"
    pictures = small_pictures()
    forms = (
        multipart_form({"north": pictures[0], "east": pictures[1]}),
        multipart_form({"north": pictures[6]}, {"captured_at": b"2026-11-22T01:02:03.040Z"}),
        multipart_form({"north": pictures[0]}, {"captured_at.north": b"2026-11-22T01:02:03Z"}),
    )
    words = (
        b"\r\n", b"\r", b"--", b"--" + BOUNDARY, b"--" + BOUNDARY + b"--", b'name="', b'filename="',
        b"filename*=utf-8''%ff%ZZ", b"\x00",
        b"Content-Disposition: form-data;", b"Content-Transfer-Encoding: base64\r\n", b"; " * 20, b"\\", b"\xff\xfe",
        b"captured_at",
    )  # fmt: skip
    run = _answering(lambda data: frames_from_form(data, kind, site, _LIMITS, _CAPTURED_AT_NS))
    return ParserTarget("multipart", run, forms, words)


def multipart_form(files: dict[str, bytes], fields: dict[str, bytes] | None = None) -> bytes:
    """A whole body with the boundary ``BOUNDARY``."""
    parts = [
        b'--%s\r\nContent-Disposition: form-data; name="%s"; filename="a.jpg"\r\nContent-Type: image/jpeg\r\n\r\n%s\r\n'
        % (BOUNDARY, name.encode(), data)
        for name, data in files.items()
    ]
    parts += [
        b'--%s\r\nContent-Disposition: form-data; name="%s"\r\n\r\n%s\r\n' % (BOUNDARY, name.encode(), data)
        for name, data in (fields or {}).items()
    ]
    return b"".join((*parts, b"--%s--\r\n" % BOUNDARY))
