"""Training samples of the 2D detector and the multi-bin head, whatever they were made of: simulated frames or real ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.errors import InputError
from service.frames import decode, read_header
from service.geometry.camera import Camera
from service.geometry.transforms import Array
from service.nets.canvas import to_canvas

VEHICLES = ("car", "van", "truck", "bus")
"""Classes that resemble each other: one that is not asked for is neither positive nor negative. Others are background."""
ANY_VEHICLE = "vehicle"
"""Kind of a vehicle of which a data set does not say whether it is a car, van, truck or bus."""
IGNORED = "ignored"
"""Kind of a region in which a detector is neither asked for vehicles nor blamed for them."""
MIN_SIDE_PX = 5.0
"""Vehicles whose 2D box is smaller in the decoded image are neither positives nor negatives."""


@dataclass(frozen=True, eq=False)
class DetectionSample:
    """One picture with 2D boxes."""

    canvas: NDArray[np.uint8]
    """(H, W, 3) RGB; the image lies in its upper left corner."""
    image_size: tuple[int, int]
    """Width and height of the image inside the canvas, px."""
    xyxy_px: Array
    """(N, 4) boxes, clipped to the image: vehicles and ignored regions."""
    ignore: NDArray[np.bool_]
    """(N,) vehicles and regions that a detector is neither asked for nor blamed for."""
    cls: NDArray[np.int64]
    """(N,) class indices; 0 where the class is not known."""
    class_known: NDArray[np.bool_]
    """(N,) whether ``cls`` means anything."""
    source: str
    """The data set, and the clip or camera within it: ``set/clip``."""

    @property
    def labels(self) -> dict[str, str]:
        """What validation tells pictures apart by."""
        return {"source": self.source}


@dataclass(frozen=True, eq=False)
class EncodedStill:
    """A frame as it came from its camera."""

    data: bytes
    """A JPEG."""
    camera: Camera
    """The camera at the frame's own size."""

    def at(self, max_width: int) -> tuple[NDArray[np.uint8], Camera]:
        """The image (H, W, 3) RGB, at most ``max_width`` px wide, and the camera at its size."""
        image = decode(self.data, self.camera, max_width)
        return image, self.camera.scaled(image.shape[1], image.shape[0])


@dataclass(frozen=True, eq=False)
class VehicleSample(DetectionSample):
    """One picture of a calibrated camera, whose vehicles' sizes and headings are known."""

    camera: Camera
    """The camera at the image's size."""
    dims_lwh: Array
    """(N, 3) metres."""
    alpha: Array
    """(N,) heading relative to the ray through the 2D box's centre, radians."""
    corners_px: Array
    """(N, 8, 2) corners of the 3D boxes, px, wherever they fall; they mean something where all are in front of the camera."""
    still: EncodedStill | None = field(default=None, kw_only=True)
    """The frame, for those who want it larger than the detector does; None: there is no more than the canvas."""


@dataclass(frozen=True, eq=False)
class Labels:
    """Boxes of a picture at its stored size, before anything is decided about training."""

    xyxy: Array
    """(N, 4) as fractions of the picture's width and height: pixel edges, 0 .. 1."""
    kinds: tuple[str, ...]
    """N kinds: one of ``VEHICLES``, ``ANY_VEHICLE`` or ``IGNORED``."""

    @staticmethod
    def concatenate(parts: Sequence[Labels]) -> Labels:
        """Labels of several origins in one."""
        xyxy = np.concatenate([np.zeros((0, 4)), *(part.xyxy for part in parts)])
        return Labels(xyxy, tuple(kind for part in parts for kind in part.kinds))


def class_columns(
    kinds: Sequence[str], classes: tuple[str, ...]
) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_]]:
    """Class indices, whether they are known, and whether to ignore: each (N,), of N kinds for a detector of ``classes``.

    A kind that is not asked for is ignored. A vehicle of unknown kind is a positive without a class.
    """
    cls = np.array([classes.index(kind) if kind in classes else 0 for kind in kinds], dtype=np.int64)
    known = np.array([kind in classes for kind in kinds], dtype=bool)
    unknown = np.array([kind == ANY_VEHICLE for kind in kinds], dtype=bool)
    return cls, known, ~(known | unknown)


def detection_sample(data: bytes, labels: Labels, classes: tuple[str, ...], max_width: int, source: str) -> DetectionSample:
    """A sample of a picture file, decoded as the service decodes frames. classes: lower-case names, in the network's order."""
    image = decode_picture(data, max_width, source)
    height, width = image.shape[:2]
    # Pixel centres lie at integers: the picture's left edge, fraction 0, is at -0.5 px.
    xyxy_px = np.clip(labels.xyxy * np.tile([width, height], 2) - 0.5, 0.0, [width - 1, height - 1] * 2)
    cls, known, ignore = class_columns(labels.kinds, classes)
    small = (xyxy_px[:, 2:] - xyxy_px[:, :2]).min(1, initial=np.inf) < MIN_SIDE_PX
    return DetectionSample(to_canvas(image), (width, height), xyxy_px, ignore | small, cls, known, source)


def decode_picture(data: bytes, max_width: int, source: str) -> NDArray[np.uint8]:
    """A JPEG or PNG file as the service would decode a frame of its size: (H, W, 3) RGB. Raises FrameError."""
    header = read_header(data)
    # The decoder asks a camera for its name and size only.
    return decode(data, Camera(source, header.width, header.height, np.eye(3), np.eye(4)), max_width)


def yolo_labels(text: str, kinds: Sequence[str | None], where: str) -> Labels:
    """Boxes of a YOLO label file: ``class x y w h`` a line, centre and size as fractions of the image.

    kinds: what each class index means here; None for a class that is background. Raises InputError naming file and line.
    """
    boxes, found = [], []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        try:
            index, (x, y, w, h) = int(line.split()[0]), (float(word) for word in line.split()[1:5])
            kind = kinds[index]
        except (ValueError, IndexError) as error:
            raise InputError(f"not a YOLO label: {error}.", field=f"{where}:{number}", remedy="Mend the line.") from error
        if kind is not None:
            boxes.append((x - w / 2, y - h / 2, x + w / 2, y + h / 2))
            found.append(kind)
    return Labels(np.array(boxes, dtype=np.float64).reshape(-1, 4), tuple(found))
