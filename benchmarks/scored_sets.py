"""What scores are made of: the boxes found in one frame set, and the vehicles that were really there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.geometry.transforms import Array


@dataclass(frozen=True, eq=False)
class Found:
    """M boxes found in a frame set."""

    states: Array
    """(M, 7) x y z l w h yaw in the world, metres and radians."""
    score: Array
    """(M,) confidence, 0..1."""
    in_view: NDArray[np.bool_]
    """(M,) whether a camera in use looks at the place from within range; a box elsewhere is never false. Cleared by
    :meth:`forgiven` for boxes that stand on an ignored vehicle."""
    track_id: tuple[str, ...] = ()
    """M identities, or none."""

    def __len__(self) -> int:
        return len(self.score)

    def take(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> Found:
        """The boxes at an index or mask."""
        ids = tuple(np.array(self.track_id, dtype=object)[index]) if self.track_id else ()
        return Found(self.states[index], self.score[index], self.in_view[index], ids)

    def forgiven(self, wanted: Wanted) -> Found:
        """The same boxes; those whose centre stands in the footprint of an ignored vehicle are never false.

        A car's box on a truck may lie too far from the truck's centre to match it, like a box in KITTI's DontCare regions.
        """
        ignored = wanted.states[~wanted.counted]
        offset = self.states[:, None, :2] - ignored[None, :, :2]
        c, s = np.cos(ignored[:, 6]), np.sin(ignored[:, 6])
        along = offset[..., 0] * c + offset[..., 1] * s
        across = offset[..., 1] * c - offset[..., 0] * s
        inside = (np.abs(along) <= ignored[:, 3] / 2) & (np.abs(across) <= ignored[:, 4] / 2)
        return replace(self, in_view=self.in_view & ~inside.any(1))


@dataclass(frozen=True, eq=False)
class Wanted:
    """N vehicles that were there at a frame set."""

    states: Array
    """(N, 7) x y z l w h yaw in the world, metres and radians."""
    counted: NDArray[np.bool_]
    """(N,) whether it has to be found. The others are ignored: a box on one is neither right nor false."""
    distance_m: Array
    """(N,) to the nearest camera that shows it; infinite where none does."""
    ids: NDArray[np.int64]
    """(N,) identities, constant over a scene."""

    def __len__(self) -> int:
        return len(self.ids)
