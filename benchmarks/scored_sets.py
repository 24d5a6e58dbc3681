"""What scores are made of: the boxes found in one frame set, and the vehicles that were really there."""

from __future__ import annotations

from dataclasses import dataclass

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
    """(M,) whether a camera in use looks at the place from within range; a box elsewhere is never false."""
    track_id: tuple[str, ...] = ()
    """M identities, or none."""

    def __len__(self) -> int:
        return len(self.score)

    def take(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> Found:
        """The boxes at an index or mask."""
        ids = tuple(np.array(self.track_id, dtype=object)[index]) if self.track_id else ()
        return Found(self.states[index], self.score[index], self.in_view[index], ids)


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
