"""Three CARLA cameras for each camera of a rig (colour, depth, instances), their pictures matched by frame number."""

from __future__ import annotations

import queue
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from models_export.data.carla_convert import CarlaPose, pose_enu
from models_export.data.carla_images import bgra
from models_export.data.carla_rig import Mount, Rig
from models_export.data.carla_session import Session
from service.errors import QuadliftError

if TYPE_CHECKING:
    import carla

KINDS = {
    "rgb": "sensor.camera.rgb",
    "depth": "sensor.camera.depth",
    "instance": "sensor.camera.instance_segmentation",
}
"""Blueprints by kind of picture."""
_POSE_TOLERANCE = 1e-3
_FOV_TOLERANCE_DEG = 1e-3


@dataclass(frozen=True, eq=False)
class Pictures:
    """What one camera of the rig saw in one frame, as BGRA (H, W, 4)."""

    rgb: NDArray[np.uint8]
    depth: NDArray[np.uint8]
    instance: NDArray[np.uint8]


class MissingPictureError(QuadliftError):
    """A sensor did not deliver a frame in time."""


class Inbox:
    """Pictures of one sensor, kept until their frame is asked for."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._arrived: queue.SimpleQueue[carla.Image] = queue.SimpleQueue()
        self._early: dict[int, carla.Image] = {}

    def put(self, image: carla.Image) -> None:
        """Called by CARLA on a thread of its own."""
        self._arrived.put(image)

    def take(self, frame: int, deadline: float) -> carla.Image:
        """The picture of a frame; older ones are dropped, newer ones kept.

        deadline: by ``time.monotonic``. Raises MissingPictureError when it passes.
        """
        while frame not in self._early:
            try:
                image = self._arrived.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                raise MissingPictureError(
                    f"no picture of frame {frame} arrived in time.",
                    field=self.name,
                    remedy="Give the server more time (--picture-timeout), or fewer or smaller cameras.",
                ) from None
            self._early[int(image.frame)] = image
        found = self._early.pop(frame)
        self._early = {number: image for number, image in self._early.items() if number > frame}
        return found


class SensorArray:
    """The sensors of a rig; made by :func:`open_sensors`."""

    def __init__(self, rig: Rig, inboxes: list[dict[str, Inbox]]) -> None:
        self._rig, self._inboxes = rig, inboxes
        self._checked: set[str] = set()

    def collect(self, frame: int, timeout_s: float) -> list[Pictures]:
        """All cameras' pictures of one frame, in the order of the rig.

        Raises MissingPictureError, or QuadliftError when the server's camera is not the one that was asked for.
        """
        deadline = time.monotonic() + timeout_s
        collected = []
        for mount, inboxes in zip(self._rig.mounts, self._inboxes, strict=True):
            images = {kind: inbox.take(frame, deadline) for kind, inbox in inboxes.items()}
            for kind, image in images.items():
                self._check(inboxes[kind].name, mount, image)
            arrays = {kind: bgra(image.raw_data, image.width, image.height) for kind, image in images.items()}
            collected.append(Pictures(**arrays))
        return collected

    def _check(self, name: str, mount: Mount, image: carla.Image) -> None:
        """Compare a sensor's first picture with its mount: all truth rests on where the cameras are."""
        if name in self._checked:
            return
        self._checked.add(name)
        at, turn = image.transform.location, image.transform.rotation
        found = pose_enu(CarlaPose(at.x, at.y, at.z, turn.pitch, turn.yaw, turn.roll))
        size = (image.width, image.height)
        if size != (mount.camera.width, mount.camera.height) or abs(image.fov - mount.fov_deg) > _FOV_TOLERANCE_DEG:
            raise QuadliftError(f"the server draws {size} px over {image.fov} degrees, not what was asked.", field=name)
        if np.abs(found - pose_enu(mount.pose)).max() > _POSE_TOLERANCE:
            raise QuadliftError(
                f"the server put it at {at} {turn}, not at {mount.pose}.", field=name, remedy="Move it out of other objects."
            )


@contextmanager
def open_sensors(session: Session, rig: Rig) -> Iterator[SensorArray]:
    """Spawn a rig's sensors and listen to them; they stop listening at the end, the session destroys them."""
    library = session.world.get_blueprint_library()
    with ExitStack() as undo:
        inboxes: list[dict[str, Inbox]] = []
        for mount in rig.mounts:
            boxes = {}
            for kind, blueprint_id in KINDS.items():
                blueprint = library.find(blueprint_id)
                for attribute, value in _attributes(mount).items():
                    blueprint.set_attribute(attribute, value)
                sensor = session.keep(session.world.spawn_actor(blueprint, session.transform(mount.pose)))
                boxes[kind] = Inbox(f"{mount.camera.id}.{kind}")
                undo.callback(sensor.stop)
                sensor.listen(boxes[kind].put)
            inboxes.append(boxes)
        yield SensorArray(rig, inboxes)


def _attributes(mount: Mount) -> dict[str, str]:
    """What all three sensors share. CARLA's lens attributes stay at their defaults, which bend nothing."""
    return {
        "image_size_x": str(mount.camera.width),
        "image_size_y": str(mount.camera.height),
        "fov": repr(mount.fov_deg),
        "sensor_tick": "0.0",
    }
