"""Truth of a CARLA frame: boxes of all vehicles and walkers in the site's world, and what each camera sees of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from models_export.data.carla_convert import CarlaPose, box_enu, flip_y
from models_export.data.carla_images import depth_m_of, instance_ids_of
from models_export.data.carla_rig import Rig
from models_export.data.carla_sensors import Pictures
from models_export.data.carla_session import Session
from models_export.data.carla_sight import BoxSight, measure_boxes
from models_export.data.dataset import SceneTruth
from service.errors import QuadliftError
from service.geometry.transforms import Array

if TYPE_CHECKING:
    import carla

CLASS_OF_BASE_TYPE = {
    "car": "Car",
    "van": "Van",
    "truck": "Truck",
    "bus": "Truck",
    "motorcycle": "Cyclist",
    "bicycle": "Cyclist",
}
"""KITTI's classes by the attribute ``base_type`` of a vehicle; KITTI has none for buses."""
WALKER_CLASS = "Pedestrian"
OTHER_CLASS = "Misc"
MIN_SIDE_M = 0.1
"""A bounding box with a smaller side is a fault of the server: in several releases two-wheelers have no width."""
_ID_CHECK_PX = 500
_ID_CHECK_SHARE = 0.1


@dataclass(frozen=True, eq=False)
class Subject:
    """One vehicle or walker: what does not change while it lives."""

    id: int
    cls: str
    """KITTI's class."""
    offset: Array
    """Centre of its bounding box in the actor's left-handed axes (3,), metres."""
    turn: CarlaPose
    """The box's angles in those axes."""
    extent: Array
    """Half sizes (3,), metres."""


def class_of(actor: carla.Actor) -> str:
    """KITTI's class of a vehicle or walker."""
    if str(actor.type_id).startswith("walker."):
        return WALKER_CLASS
    return CLASS_OF_BASE_TYPE.get(str(actor.attributes.get("base_type", "")).lower(), OTHER_CLASS)


class SubjectList:
    """The vehicles and walkers of a world; each is asked for its box once."""

    def __init__(self, session: Session) -> None:
        self._world = session.world
        self._known: dict[int, Subject | None] = {}

    def present(self) -> list[Subject]:
        """Those alive now, by id, without those that have no box."""
        actors = self._world.get_actors()
        alive = [*actors.filter("vehicle.*"), *actors.filter("walker.pedestrian.*")]
        for actor in alive:
            if actor.id not in self._known:
                self._known[actor.id] = _subject(actor)
        found = (self._known[number] for number in sorted(actor.id for actor in alive))
        return [subject for subject in found if subject is not None]

    @property
    def without_box(self) -> int:
        """How many were left out because their bounding box has no width, length or height."""
        return sum(subject is None for subject in self._known.values())


def _subject(actor: carla.Actor) -> Subject | None:
    box = actor.bounding_box
    extent = np.array([box.extent.x, box.extent.y, box.extent.z], dtype=np.float64)
    if not np.all(2.0 * extent >= MIN_SIDE_M):
        return None
    turn = CarlaPose(pitch=box.rotation.pitch, yaw=box.rotation.yaw, roll=box.rotation.roll)
    offset = np.array([box.location.x, box.location.y, box.location.z], dtype=np.float64)
    return Subject(int(actor.id), class_of(actor), offset, turn, extent)


def frame_truth(
    snapshot: carla.WorldSnapshot, subjects: Sequence[Subject], rig: Rig, pictures: Sequence[Pictures], captured_at_ns: int
) -> SceneTruth:
    """World truth of a frame, its pictures given in the order of the rig's cameras.

    Raises QuadliftError when the instance pictures do not hold the actors' ids.
    """
    placed = [(subject, state) for subject in subjects if (state := snapshot.find(subject.id)) is not None]
    ids = np.array([subject.id for subject, _ in placed], dtype=np.int64)
    center, dims, yaw, velocity = np.zeros((len(placed), 3)), np.zeros((len(placed), 3)), np.zeros(len(placed)), []
    for k, (subject, state) in enumerate(placed):
        center[k], dims[k], yaw[k] = box_enu(_pose(state.get_transform()), subject.offset, subject.turn, subject.extent)
        speed = state.get_velocity()
        velocity.append([speed.x, speed.y, speed.z])
    center = rig.to_site(center)
    sights = _sights(rig, ids, (center, dims, yaw), pictures)
    return SceneTruth(
        captured_at_ns,
        ids,
        tuple(subject.cls for subject, _ in placed),
        center,
        dims,
        yaw,
        flip_y(np.array(velocity, dtype=np.float64).reshape(-1, 3)),
        np.stack([sight.visible for sight in sights], 1),
        np.stack([sight.truncated for sight in sights], 1),
    )


def _pose(transform: carla.Transform) -> CarlaPose:
    at, turn = transform.location, transform.rotation
    return CarlaPose(at.x, at.y, at.z, turn.pitch, turn.yaw, turn.roll)


def _sights(
    rig: Rig, ids: NDArray[np.int64], boxes: tuple[Array, Array, Array], pictures: Sequence[Pictures]
) -> list[BoxSight]:
    sights = [
        measure_boxes(mount.camera, ids, boxes, instance_ids_of(seen.instance), depth_m_of(seen.depth))
        for mount, seen in zip(rig.mounts, pictures, strict=True)
    ]
    inside, own = (sum(int(getattr(sight, name).sum()) for sight in sights) for name in ("inside_px", "own_px"))
    if inside > _ID_CHECK_PX and own < _ID_CHECK_SHARE * inside:
        raise QuadliftError(
            f"{inside} pixels lie inside of vehicles' boxes, only {own} carry their ids.",
            field="sensor.camera.instance_segmentation",
            remedy="Use a server of version 0.9.16 and a map other than the large ones (Town11 to Town13).",
        )
    return sights
