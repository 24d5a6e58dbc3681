"""Frames of a driving CARLA camera with 2D boxes (D. Hafner's set, MIT licence) as detection samples.

The set says `vehicle` for cars, vans, trucks and buses alike: its boxes have no class here. Bicycles, motor bikes, lights and
signs are background. Frames follow each other along four routes, so the split is by stretches of a route, never by neighbours.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from models_export.data.detection import ANY_VEHICLE, DetectionSample, Labels, detection_sample, yolo_labels
from service.errors import NotFoundError

ARCHIVE = "carla2d.zip"
ATTRIBUTION = "CARLA object detection frames, Daniel Hafner, MIT"
KINDS = (ANY_VEHICLE, None, None, None, None)
"""What classes 0 vehicle, 1 bike, 2 motobike, 3 traffic_light, 4 traffic_sign mean to a detector of vehicles."""
TEST_STRETCHES = {
    "Town01": (9000, 12961),
    "Town02": (8000, 11401),
    "Town03": (17500, 20021),
    "Town04": (4140, 5041),
}
"""Simulator ticks [first, end) of each town's route that test: the last third of every drive."""
GAP_TICKS = 300
"""Frames this close before a test stretch are left out of both sides: they may show the same place."""
_NAME = re.compile(r"carla2d/images/(Town\d+)_(\d+)\.jpg")


@dataclass(frozen=True)
class Frame:
    """One frame of the archive."""

    town: str
    tick: int
    image: str
    """Member of the archive."""

    @property
    def side(self) -> str:
        """``training``, ``test``, or ``gap``."""
        first, end = TEST_STRETCHES[self.town]
        if first <= self.tick < end:
            return "test"
        return "gap" if first - GAP_TICKS <= self.tick < first else "training"


def list_frames(archive: Path, side: str) -> list[Frame]:
    """Frames of one side of the split, in the order of the routes. Raises NotFoundError when the archive is not there."""
    if not archive.is_file():
        raise NotFoundError("no such archive.", field=str(archive), remedy="Give the folder that holds it.")
    with zipfile.ZipFile(archive) as stored:
        found = [match for name in sorted(stored.namelist()) if (match := _NAME.fullmatch(name))]
    frames = [Frame(match[1], int(match[2]), match[0]) for match in found]
    return [frame for frame in frames if frame.side == side]


def read_frames(archive: Path, side: str) -> Iterator[tuple[Frame, bytes, Labels]]:
    """Picture files and boxes of one side of the split."""
    frames = list_frames(archive, side)
    with zipfile.ZipFile(archive) as stored:
        for frame in frames:
            label = frame.image.replace("/images/", "/labels/").replace(".jpg", ".txt")
            yield frame, stored.read(frame.image), yolo_labels(stored.read(label).decode("ascii"), KINDS, label)


def load_carla2d(archive: Path, classes: tuple[str, ...], max_width: int, side: str = "training") -> list[DetectionSample]:
    """All samples of one side of the split, in memory."""
    return [
        detection_sample(data, labels, classes, max_width, f"carla2d/{frame.town}")
        for frame, data, labels in read_frames(archive, side)
    ]
