"""What the cameras of a frame set saw, each by itself: all that fusion needs to know of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.errors import FrameError
from service.fusion import CameraParts
from service.geometry.boxes import Boxes
from service.geometry.camera import Camera
from service.residuals import BoxProblem


@dataclass(frozen=True, eq=False)
class Sightings:
    """N boxes that C cameras of a frame set lifted, and how."""

    cameras: tuple[Camera, ...]
    """The C cameras whose frames were decoded, at the size of the images that boxes were read in."""
    captured_at_ns: tuple[int, ...]
    """(C) when, nanoseconds since 1970 (UTC)."""
    boxes: Boxes
    """N boxes in the world, one camera after the other."""
    terms: BoxProblem | None
    """What the boxes were solved from; None where that is not known of all, and for no box."""
    camera_index: NDArray[np.int64]
    """(N,) into ``cameras``."""
    hard: frozenset[str]
    """Cameras in which the depth-guided detector ran."""
    timing_ms: dict[str, float]
    """Wall time of each step, and of all under ``total``."""
    failed: dict[str, FrameError]
    """Cameras whose frame could not be decoded."""

    @staticmethod
    def of_none(failed: dict[str, FrameError]) -> Sightings:
        """Where not one frame could be decoded."""
        return Sightings((), (), Boxes.empty(), None, np.zeros(0, np.int64), frozenset(), {"total": 0.0}, failed)

    @staticmethod
    def together(parts: Sequence[Sightings], *, side_by_side: bool = True) -> Sightings:
        """All cameras' of one or more parts of a set.

        side_by_side: the parts were seen at the same time, so of each step the longest time counts; else their sum.
        """
        if len(parts) == 1:
            return parts[0]
        with_boxes = [part for part in parts if len(part.boxes)]
        terms = [part.terms for part in with_boxes if part.terms is not None]
        first = np.cumsum([0, *(len(part.cameras) for part in parts[:-1])])
        time_of = max if side_by_side else sum
        steps = dict.fromkeys(step for part in parts for step in part.timing_ms)
        return Sightings(
            cameras=tuple(camera for part in parts for camera in part.cameras),
            captured_at_ns=tuple(moment for part in parts for moment in part.captured_at_ns),
            boxes=Boxes.concatenate([part.boxes for part in parts]),
            terms=BoxProblem.concatenate(terms) if terms and len(terms) == len(with_boxes) else None,
            camera_index=np.concatenate([part.camera_index + start for part, start in zip(parts, first, strict=True)]),
            hard=frozenset().union(*(part.hard for part in parts)),
            timing_ms={step: time_of([part.timing_ms.get(step, 0.0) for part in parts]) for step in steps},
            failed={camera: error for part in parts for camera, error in part.failed.items()},
        )

    def timed(self, parts: CameraParts) -> CameraParts:
        """What the cameras contributed to fused boxes, with when they saw it."""
        return replace(parts, captured_at_ns=np.array(self.captured_at_ns, dtype=np.int64)[parts.camera])
