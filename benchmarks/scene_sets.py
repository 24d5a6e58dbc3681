"""Rendered or captured scenes as frame sets, with the vehicles that a set of cameras has to find.

A vehicle counts for the cameras in use when it is a car and at least one of them, no farther than ``RANGE_M`` from its centre,
shows more than ``MIN_SHOWN`` of its whole silhouette: the visible share of what lies inside the image, times the share that
lies inside; and when it is no harder than its scene (``scene_grades``). All other vehicles, and vans, trucks and buses
whatever they show, are ignored: found or not, they change nothing. People and cyclists are no vehicles: a box on one is false.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.centres import RANGE_M
from benchmarks.scored_sets import Found, Wanted
from models_export.data.dataset import Scene, SceneTruth, list_scenes, open_scene, step_name
from service.errors import InputError
from service.frames import EncodedFrame, FrameSet
from service.geometry.boxes import Boxes, box_states
from service.geometry.transforms import Array
from service.site import Site

MIN_SHOWN = 0.3
COUNTED = frozenset({"car"})
IGNORED = frozenset({"van", "truck", "bus", "tram", "misc"})
NO_VEHICLES = frozenset({"pedestrian", "person_sitting", "cyclist"})


@dataclass(frozen=True, eq=False)
class SceneSets:
    """The scenes of a dataset, and what had to be passed over in them."""

    scenes: tuple[Scene, ...]
    unknown: Counter[str] = field(default_factory=Counter)
    """How many objects of unknown classes were skipped, by class."""

    @property
    def most_cameras(self) -> int:
        """Cameras of the scene that has most."""
        return max(len(scene.site.cameras) for scene in self.scenes)

    def truth(self, scene: Scene, step: int) -> SceneTruth:
        """The vehicles of a step; people, cyclists and unknown classes are left out, the latter counted.

        Raises NotFoundError for a step without a file, InputError naming the file when a value is not finite.
        """
        truth = scene.truth(step)
        numbers = np.column_stack([truth.center, truth.dims_lwh, truth.yaw, truth.visible, truth.truncated])
        bad = np.flatnonzero(~np.isfinite(numbers).all(1) | (truth.dims_lwh <= 0).any(1))
        if len(bad):
            raise InputError(
                f"box {truth.ids[bad[0]]} is not finite or has no size.",
                field=str(scene.path / "boxes" / f"{step_name(step)}.json"),
                remedy="Render the scene again.",
            )
        names = [name.lower() for name in truth.classes]
        self.unknown.update(name for name in names if name not in COUNTED | IGNORED | NO_VEHICLES)
        return _take(truth, [k for k, name in enumerate(names) if name in COUNTED | IGNORED])


def open_scene_sets(dataset: Path) -> SceneSets:
    """All scenes of a dataset. Raises NotFoundError or InputError naming what is missing or damaged."""
    return SceneSets(tuple(open_scene(path) for path in list_scenes(dataset)))


def site_of_first(scene: Scene, cameras: int) -> Site:
    """The scene's site cut to its first cameras."""
    return replace(scene.site, cameras=scene.site.cameras[:cameras])


def frame_sets(scene: Scene, site: Site, times_ns: Sequence[int]) -> Iterator[FrameSet]:
    """Every step of a scene as the frames of a site's cameras; ``times_ns``: capture time of each step."""
    for step, captured in enumerate(times_ns):
        frames = tuple(EncodedFrame(camera.id, scene.frame_bytes(camera.id, step), captured) for camera in site.cameras)
        yield FrameSet(site, frames, captured, step + 1)


def wanted(truth: SceneTruth, fits: NDArray[np.bool_], all_cameras: Sequence[str], site: Site) -> Wanted:
    """What the cameras of ``site`` have to find.

    fits: vehicles (N,) that are no harder than their scene. all_cameras: ids of the columns of the truth's visibility.
    """
    columns = [list(all_cameras).index(camera.id) for camera in site.cameras]
    shown = (truth.visible * (1.0 - truth.truncated))[:, columns]
    positions = np.array([camera.position_m for camera in site.cameras]).reshape(-1, 3)
    distance = np.linalg.norm(truth.center[:, None] - positions, axis=-1)
    distance = np.where((shown > MIN_SHOWN) & (distance <= RANGE_M), distance, np.inf)
    nearest = distance.min(1) if len(truth) else np.zeros(0)
    cars = np.array([name.lower() in COUNTED for name in truth.classes], dtype=bool)
    states = np.column_stack([truth.center, truth.dims_lwh, truth.yaw])
    return Wanted(states, cars & fits & np.isfinite(nearest), nearest, truth.ids)


def found(boxes: Boxes, classes: Sequence[str], site: Site, track_id: Sequence[str] = ()) -> Found:
    """Boxes of a pipeline as what was found; those of a class that is ignored, or no vehicle, are left out."""
    everything = Found(box_states(boxes), boxes.score, in_view(site, boxes.center), tuple(track_id))
    return everything.take(of_counted_class(boxes, classes))


def of_counted_class(boxes: Boxes, classes: Sequence[str]) -> NDArray[np.bool_]:
    """Which boxes (M,) are of a class that counts."""
    return np.array([classes[index].lower() not in IGNORED | NO_VEHICLES for index in boxes.cls], dtype=bool)


def in_view(site: Site, center: Array) -> NDArray[np.bool_]:
    """Which centres (N, 3) lie in the image of at least one camera of a site, no farther than ``RANGE_M`` from it."""
    seen = np.zeros(len(center), dtype=bool)
    for camera in site.cameras:
        pixels, depth = camera.project(center)
        inside = np.all((pixels >= 0) & (pixels <= [camera.width - 1, camera.height - 1]), axis=1)
        seen |= inside & (depth > 0) & (np.linalg.norm(center - camera.position_m, axis=1) <= RANGE_M)
    return seen


def _take(truth: SceneTruth, rows: list[int]) -> SceneTruth:
    index = np.array(rows, dtype=np.int64)
    arrays = {name: value[index] for name, value in vars(truth).items() if isinstance(value, np.ndarray)}
    return replace(truth, classes=tuple(truth.classes[k] for k in rows), **arrays)
