"""Real frames of elevated road cameras (three Roboflow sets, CC BY 4.0) as detection samples.

Their labels are incomplete: far vehicles, vehicles cut by the border and parked ones often have none. Three things keep a
detector from being blamed for those: the *far zone* of each clip, the border, and, where a teacher has looked
(``teacher.py``), what it suspects.
"""

from __future__ import annotations

import re
import zipfile
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from models_export.data.detection import ANY_VEHICLE, IGNORED, DetectionSample, Labels, detection_sample, yolo_labels
from service.errors import NotFoundError
from service.geometry.transforms import Array

ARCHIVE = "roadside_train.zip"
GANTRY, HIGHWAYS, OVERPASSES = "rf100_vehicles_tollroad_id", "atl_v2_highway_mix", "farzad_overpass_vehicle_boxonly"
ATTRIBUTION = {
    GANTRY: "Roboflow 100 'vehicles-q0x2v', Yudha Bhakti Nugraha and Kris, CC BY 4.0",
    HIGHWAYS: "Roboflow Universe finalproject-bqip3 'ATL-version-2', CC BY 4.0",
    OVERPASSES: "Roboflow Universe 'Vehicle_Detection_YOLOv8', Farzad Nekouee, CC BY 4.0",
}
KINDS: dict[str, tuple[str | None, ...]] = {
    GANTRY: ("car", "van", "truck", "bus", None, None),
    # Vans are called car here.
    HIGHWAYS: (ANY_VEHICLE, "van", "truck", "bus", None, None),
    OVERPASSES: (ANY_VEHICLE, ANY_VEHICLE, ANY_VEHICLE, ANY_VEHICLE, None, None),
}
"""What classes 0 car, 1 van, 2 truck, 3 bus, 4 two_wheeler, 5 person mean in each set."""
VALIDATION_CLIPS = frozenset(
    {
        f"{GANTRY}/siang_15112021_1",
        f"{HIGHWAYS}/motorway",
        *(f"{OVERPASSES}/{name}" for name in ("4", "8", "test2")),
    }
)
"""Clips kept out of training: a day of the gantry, one road of the highways, three overpasses."""
FAR_PERCENTILE = 5.0
"""A clip's far zone ends at the row above which only this share of its labelled boxes' centres lies."""
FAR_HEIGHT = 0.16
"""Height of the far zone over the picture's: it reaches up from the row where labels become rare."""
BORDER = 0.03
"""Width of the ignored strips at the left, right and lower border, over the picture's side."""
_VIDEO = re.compile(r"(.+?)_?mp4-\d+_jpg")
_DIGITS = {1: "curve", 2: "curve", 3: "curve", 4: "night", 5: "night", 6: "night", 7: "motorway", 8: "motorway"}
"""The highway set numbers its frames by scene, each with its own count of digits; ten and more are a US highway."""


@dataclass(frozen=True, eq=False)
class RoadsideFrame:
    """One labelled picture of the archive."""

    image: str
    """Member of the archive."""
    clip: str
    """Set and clip: ``set/clip``."""
    labels: Labels


def clip_of(member: str) -> str:
    """Set and clip of an archive member: frames of one clip show one place on one day."""
    folder, _, stem = member.split("/")
    stem = stem.removesuffix(".jpg")
    if match := _VIDEO.fullmatch(stem):
        return f"{folder}/{match[1]}"
    number = stem.removesuffix("_png")
    scene = _DIGITS.get(len(number), "us-highway") if number.isdigit() else ("boulevard-c" if number[0] == "C" else "boulevard")
    return f"{folder}/{scene}"


def read_frames(archive: Path) -> list[RoadsideFrame]:
    """All labelled frames, by name; pictures are not read yet. Raises NotFoundError when the archive is not there."""
    if not archive.is_file():
        raise NotFoundError("no such archive.", field=str(archive), remedy="Give the folder that holds it.")
    frames = []
    with zipfile.ZipFile(archive) as stored:
        for member in sorted(name for name in stored.namelist() if "/images/" in name and name.endswith(".jpg")):
            label = member.replace("/images/", "/labels/").removesuffix(".jpg") + ".txt"
            kinds = KINDS[member.split("/")[0]]
            frames.append(RoadsideFrame(member, clip_of(member), yolo_labels(stored.read(label).decode("ascii"), kinds, label)))
    return frames


def far_zone(labels: list[Labels]) -> Array:
    """The region (1, 4) of a clip, as fractions, where vehicles are too far to have been labelled reliably.

    It spans the picture's width and ends at the row above which labelled boxes' centres are rare. The boxes that *are*
    labelled there count all the same.
    """
    rows = np.concatenate([(part.xyxy[:, 1] + part.xyxy[:, 3]) / 2 for part in labels])
    end = float(np.percentile(rows, FAR_PERCENTILE)) if len(rows) else FAR_HEIGHT
    return np.array([[0.0, max(end - FAR_HEIGHT, 0.0), 1.0, end]])


def border_strips() -> Array:
    """Regions (3, 4) as fractions: left, right and lower border, where cut vehicles have no label."""
    return np.array([[0.0, 0.0, BORDER, 1.0], [1 - BORDER, 0.0, 1.0, 1.0], [0.0, 1 - BORDER, 1.0, 1.0]])


def load_roadside(
    archive: Path,
    classes: tuple[str, ...],
    max_width: int,
    side: str = "training",
    suspected: Mapping[str, Labels] | None = None,
) -> list[DetectionSample]:
    """All samples of one side, ``training`` or ``validation``, in memory.

    suspected: by archive member, what a teacher adds to the labels: further vehicles, and regions to ignore.
    """
    frames = read_frames(archive)
    by_clip: dict[str, list[Labels]] = defaultdict(list)
    for frame in frames:
        by_clip[frame.clip].append(frame.labels)
    zones = {clip: np.concatenate([far_zone(labels), border_strips()]) for clip, labels in by_clip.items()}
    ignored = {clip: Labels(zone, (IGNORED,) * len(zone)) for clip, zone in zones.items()}
    samples = []
    with zipfile.ZipFile(archive) as stored:
        for frame in frames:
            if (frame.clip in VALIDATION_CLIPS) == (side == "training"):
                continue
            parts = [frame.labels, ignored[frame.clip]]
            if suspected and frame.image in suspected:
                parts.append(suspected[frame.image])
            labels = Labels.concatenate(parts)
            samples.append(detection_sample(stored.read(frame.image), labels, classes, max_width, frame.clip))
    return samples
