"""A frame set's pictures, decoded, and what a detector found in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from service.geometry.camera import Camera, UInt8Image
from service.geometry.transforms import Array
from service.nets.detections import Detections
from service.nets.multibin import Crops, MultibinEstimates, cut_crops

_MOST_SHIFT = 0.5
"""Beyond this share of its side an outline is of another vehicle, or of none."""


@dataclass(frozen=True, eq=False)
class Still:
    """One camera's decoded frame, at up to three sizes, of which several may be one: detector and depth net see the smallest,
    crops are cut from ``image``, and ``whole`` is for a depth-guided detector that wants more."""

    site_camera: Camera
    """The site's camera, at the size of its frames."""
    image: UInt8Image
    """(H, W, 3) RGB."""
    small: UInt8Image
    """(h, w, 3) RGB; the same picture, or the same array."""
    whole: UInt8Image
    """The same picture as it was decoded."""

    @cached_property
    def camera(self) -> Camera:
        """The camera at the size of ``image``."""
        return self.site_camera.scaled(self.image.shape[1], self.image.shape[0])

    @cached_property
    def small_camera(self) -> Camera:
        """The camera at the size of ``small``."""
        return self.site_camera.scaled(self.small.shape[1], self.small.shape[0])

    @cached_property
    def whole_camera(self) -> Camera:
        """The camera at the size of ``whole``."""
        return self.site_camera.scaled(self.whole.shape[1], self.whole.shape[0])

    @property
    def scale(self) -> tuple[float, float]:
        """Pixels of ``image`` a pixel of ``small``, across and down."""
        return self.image.shape[1] / self.small.shape[1], self.image.shape[0] / self.small.shape[0]


@dataclass(frozen=True, eq=False)
class DetectedVehicles:
    """What a detector found in all stills of a frame set: N vehicles, one still after the other."""

    stills: Sequence[Still]
    still: NDArray[np.int64]
    """(N,) index into ``stills``."""
    xyxy_px: Array
    """(N, 4) boxes in px of each still's ``image``, not clipped."""
    score: Array
    """(N,) in 0..1."""
    cls: NDArray[np.int64]
    """(N,) indices into the classes."""

    def __len__(self) -> int:
        return len(self.score)

    @staticmethod
    def of(stills: Sequence[Still], found: Sequence[Detections]) -> DetectedVehicles:
        """From what was found in each still's ``small``; there is at least one still."""
        large = [detections.scaled(one.scale) for one, detections in zip(stills, found, strict=True)]
        return DetectedVehicles(
            stills=stills,
            still=np.repeat(np.arange(len(stills)), [len(own) for own in large]),
            xyxy_px=np.concatenate([own.xyxy_px for own in large]),
            score=np.concatenate([own.score for own in large]),
            cls=np.concatenate([own.cls for own in large]),
        )

    def crops(self, crop_px: int) -> Crops:
        """A crop around each box."""
        return self._cut(self.xyxy_px, self.still, crop_px)

    def second_looks(self, estimates: MultibinEstimates, crop_px: int, least_shift: float) -> tuple[NDArray[np.int64], Crops]:
        """Which vehicles (M,) are to be read again, and their crops (M).

        A head reads best what its crop shows in the middle. Where an edge that it read lies farther from the detector's than
        ``least_shift`` of the box's longer side, a second crop is cut around the outline.
        """
        # A head that reads no outline has nothing against the detector's box.
        outlines = self.xyxy_px if estimates.xyxy_px is None else estimates.xyxy_px
        side = (self.xyxy_px[:, 2:] - self.xyxy_px[:, :2]).max(1)
        shift = np.abs(outlines - self.xyxy_px).max(1) / np.maximum(side, 1.0)
        again = np.flatnonzero((shift > least_shift) & (shift < _MOST_SHIFT))
        return again, self._cut(outlines[again], self.still[again], crop_px)

    def _cut(self, xyxy_px: Array, still: NDArray[np.int64], crop_px: int) -> Crops:
        numbered = enumerate(self.stills)
        return Crops.concatenate([cut_crops(one.image, xyxy_px[still == number], crop_px) for number, one in numbered])
