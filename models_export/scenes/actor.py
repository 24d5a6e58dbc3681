"""What every road user has in common: a kind, a box, a mesh that fills the box exactly, and lamps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from models_export.scenes.mesh import Array, Mesh

KITTI_CLASS = {
    "car": "Car",
    "van": "Van",
    "truck": "Truck",
    "bus": "Truck",
    "pedestrian": "Pedestrian",
    "cyclist": "Cyclist",
}
"""Class in label files by kind. KITTI has no bus; among its classes a bus is nearest to a truck. ``kind`` keeps them apart."""
VEHICLE_KINDS = ("car", "van", "truck", "bus")


def _no_lamps() -> Array:
    return np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class ActorModel:
    """Looks of one road user. Its frame: x forward, y left, z up, origin at the centre of its box."""

    shape: str
    """Body style, such as ``sedan``."""
    kind: str
    """A key of ``KITTI_CLASS``."""
    dims_lwh: Array
    """(3,) metres; the mesh's exact extents."""
    build: Callable[[], Mesh]
    """Makes the mesh; called once, when it is first drawn."""
    head_lamps: Array = field(default_factory=_no_lamps)
    """(N, 3) lit lamps that shine forwards."""
    tail_lamps: Array = field(default_factory=_no_lamps)
    """(N, 3) lit lamps at the rear."""

    @cached_property
    def mesh(self) -> Mesh:
        """The mesh, in the actor's frame."""
        return self.build()
