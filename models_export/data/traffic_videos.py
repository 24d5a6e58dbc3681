"""Unlabelled clips of real traffic cameras (repositories under MIT): frames, which a teacher labels."""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
import simplejpeg

from models_export.data.detection import DetectionSample, Labels, detection_sample
from service.errors import InputError, NotFoundError

ARCHIVE = "traffic_videos.zip"
SOURCE = "traffic_videos"
ATTRIBUTION = "Clips of traffic cameras from repositories under MIT"
LEFT_OUT = frozenset({"bgs_video.avi"})
"""Outlines of the vehicles are painted into its frames."""
EVERY = 10
"""Every tenth frame: a car has moved on by then."""
_QUALITY = 95


def read_frames(archive: Path, every: int = EVERY) -> Iterator[tuple[str, bytes]]:
    """Names (``clip/frame``) and pictures, as JPEG, of every n-th frame of all clips.

    Raises NotFoundError when the archive is not there, InputError when a clip cannot be decoded.
    """
    if not archive.is_file():
        raise NotFoundError("no such archive.", field=str(archive), remedy="Give the folder that holds it.")
    with zipfile.ZipFile(archive) as stored, tempfile.TemporaryDirectory() as folder:
        for member in sorted(name for name in stored.namelist() if not name.endswith("/") and Path(name).name not in LEFT_OUT):
            yield from _frames_of(Path(stored.extract(member, folder)), every)


def load_videos(archive: Path, taught: Mapping[str, Labels], classes: tuple[str, ...], max_width: int) -> list[DetectionSample]:
    """Samples of the frames that the teacher has labelled, in memory. taught: labels by frame name."""
    return [
        detection_sample(data, taught[name], classes, max_width, f"{SOURCE}/{name.split('/')[0]}")
        for name, data in read_frames(archive)
        if name in taught
    ]


def _frames_of(path: Path, every: int) -> Iterator[tuple[str, bytes]]:
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise InputError("no video that OpenCV reads.", field=path.name, remedy="Check the file.")
    number = 0
    while capture.grab():
        if number % every == 0:
            image = np.ascontiguousarray(capture.retrieve()[1][..., ::-1])
            yield f"{path.stem}/{number:06d}", simplejpeg.encode_jpeg(image, _QUALITY)
        number += 1
    capture.release()
