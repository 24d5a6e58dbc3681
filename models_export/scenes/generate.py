"""Makes scenes: draws the steps of a plan."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from models_export.data.dataset import SceneTruth
from models_export.scenes.lens import Lens
from models_export.scenes.plan import Moment, ScenePlan
from models_export.scenes.renderer import Renderer, Shot
from models_export.scenes.request import SceneRequest
from models_export.scenes.staging import cast_of
from models_export.scenes.truth import measure_sight


@dataclass(frozen=True, eq=False)
class Step:
    """One rendered moment of a scene."""

    index: int
    truth: SceneTruth
    shots: tuple[Shot, ...]
    """One per camera, in the order of the site; images before blur, rain and sensor."""


class SceneMaker:
    """One scene in the making: its plan is known at once, its steps come in order."""

    def __init__(self, request: SceneRequest, renderer: Renderer) -> None:
        self.plan = ScenePlan(request)
        self._renderer = renderer
        self._lenses = tuple(Lens(camera) for camera in self.plan.site.cameras)

    def steps(self) -> Iterator[Step]:
        """Render all steps; once only."""
        self.start()
        for moment in self.plan.moments():
            yield self.render(moment)

    def start(self) -> None:
        """Put what does not move on stage; before the first moment."""
        self._renderer.set_scene(self.plan.static_mesh(), self.plan.request.seed)

    def render(self, moment: Moment) -> Step:
        """Draw one moment of the plan in all cameras."""
        renderer, light = self._renderer, self.plan.light
        renderer.keep_actors({k: model.mesh for k, model in zip(moment.ids, moment.models, strict=True)})
        cast = cast_of(self.plan, moment)
        renderer.cast_light(light, cast)
        boxes = (moment.center, moment.dims_lwh, moment.poses[:, 2])
        shots, sights = [], []
        for lens, film in zip(self._lenses, self.plan.films, strict=True):
            shot = renderer.shoot(lens.source, light, film, cast)
            sights.append(measure_sight(renderer, lens, shot, cast, boxes))
            shots.append(lens.bend(shot))
        truth = SceneTruth(
            moment.captured_at_ns,
            np.array(moment.ids, dtype=np.int64),
            moment.classes,
            *boxes,
            moment.velocity,
            np.stack([s.visible for s in sights], 1),
            np.stack([s.truncated for s in sights], 1),
            moment.kinds,
        )
        return Step(moment.index, truth, tuple(shots))
