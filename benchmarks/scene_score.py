"""The pipeline's boxes on scenes against the truth, by difficulty and by the number of cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Protocol

import numpy as np

from benchmarks.average_precision import OVERLAPS, RECALLS, PrecisionRecall, precision_recall
from benchmarks.centres import RANGE_M
from benchmarks.position_errors import MATCH_M, PositionErrors, position_errors
from benchmarks.scene_grades import UNGRADED, Grade, grade_of
from benchmarks.scene_sets import MIN_SHOWN, SceneSets, found, frame_sets, site_of_first, wanted
from benchmarks.scored_sets import Found, Wanted
from benchmarks.tracking_scores import MIN_IOU, TrackingCounts, count_scene, moments, no_counts
from models_export.data.dataset import Scene, SceneTruth
from models_export.scenes.scenario import SCENARIOS
from service.errors import InputError
from service.frames import FrameSet
from service.fusion import FusedBoxes
from service.geometry.boxes import Boxes
from service.pipeline import PipelineSettings, SetResult
from service.site import Site
from service.tracking import Tracker

MIN_OVERLAPS = (0.5, 0.7)
CURVE_SCORE = 0.05
"""Least score of the boxes that average precision is made of. All other figures take the boxes that the service publishes."""
SINGLE = "single"
"""Name of the view in which every camera is on its own; the others are called by their number of cameras."""
ALL = "all"
RULES = {
    "min_shown": MIN_SHOWN,
    "range_m": RANGE_M,
    "match_m": MATCH_M,
    "track_iou": MIN_IOU,
    "curve_score": CURVE_SCORE,
}
"""What the figures depend on beside the data: see docs/accuracy.md."""


class SetPipeline(Protocol):
    """What is scored: frame sets in, boxes out."""

    def run(self, frame_set: FrameSet) -> SetResult:
        """Boxes of one frame set."""
        ...


PipelineFactory = Callable[[PipelineSettings], SetPipeline]
"""Makes a pipeline that has seen nothing yet; each scene gets its own."""


@dataclass(frozen=True, eq=False)
class ViewScore:
    """Everything seen through one choice of cameras: frame sets in order, and their tracks."""

    published: list[Found] = field(default_factory=list)
    """What the service would say."""
    candidates: list[Found] = field(default_factory=list)
    """The same down to a score of ``CURVE_SCORE``."""
    truth: list[Wanted] = field(default_factory=list)
    tracking: list[TrackingCounts] = field(default_factory=list)
    """One a scene; empty for single cameras, which are not tracked."""

    def curve(self, metric: str, min_overlap: float) -> PrecisionRecall:
        """Precision over recall. metric: "3d" or "bev"."""
        return precision_recall(self.candidates, self.truth, metric, min_overlap)

    def errors(self) -> PositionErrors:
        """Recall and position errors of what the service would say."""
        return position_errors(self.published, self.truth)

    def summary(self) -> dict[str, Any]:
        """All figures; None where there is nothing to measure."""
        figures: dict[str, Any] = {"frame_sets": len(self.truth)}
        for metric in OVERLAPS:
            figures[f"ap_{metric}"] = {str(overlap): self._average(metric, overlap) for overlap in MIN_OVERLAPS}
        figures |= self.errors().summary()
        if self.tracking:
            figures["tracking"] = sum(self.tracking, start=no_counts()).summary()
        return figures

    def _average(self, metric: str, overlap: float) -> dict[str, float | None]:
        curve = self.curve(metric, overlap)
        averages = {sampling: curve.average(sampling) for sampling in RECALLS}
        return {sampling: None if math.isnan(value) else round(value, 2) for sampling, value in averages.items()}

    def joined(self, other: ViewScore) -> ViewScore:
        """Both together."""
        return ViewScore(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(ViewScore)))


Scores = dict[str, dict[str, ViewScore]]
"""By difficulty, then by view: "1", "2" .. cameras, or ``SINGLE``."""


def summaries(scores: Scores) -> dict[str, dict[str, dict[str, Any]]]:
    """All figures by difficulty and view."""
    return {difficulty: {name: view.summary() for name, view in views.items()} for difficulty, views in scores.items()}


def settings_of(method: str) -> PipelineSettings:
    """The shipped settings with a method of lifting and fusion: "map", the default, or "paper".

    Raises InputError when the pipeline offers no choice of methods.
    """
    settings = PipelineSettings()
    if method == "map":
        return settings
    if "method" not in {f.name for f in fields(PipelineSettings)}:
        raise InputError(
            f"the pipeline cannot run the method '{method}': PipelineSettings has no field 'method'.",
            field="--method",
            remedy="Use --method map, or a version of the service whose lifting and fusion offer the paper's method.",
        )
    return replace(settings, **{"method": method})


def score_scenes(
    sets: SceneSets,
    make: PipelineFactory,
    settings: PipelineSettings,
    camera_counts: Sequence[int],
    done: Callable[[], None] = lambda: None,
) -> Scores:
    """Scores by difficulty and view; ``ALL`` holds every scene when there is more than one difficulty.

    Scenes that have fewer cameras than a count are left out of it. The cameras of the largest count are scored one by one too.
    ``done`` is called after each scene.
    """
    scores: Scores = {}
    for scene in sets.scenes:
        grade = grade_of(scene)
        group = scores.setdefault(grade.difficulty, {})
        for name, view in _score_scene(sets, scene, grade, make, settings, camera_counts).items():
            group[name] = group.get(name, ViewScore()).joined(view)
        done()
    ordered = {name: scores[name] for name in (*SCENARIOS, UNGRADED) if name in scores}
    if len(ordered) > 1:
        everything: dict[str, ViewScore] = {}
        for group in ordered.values():
            for name, view in group.items():
                everything[name] = everything.get(name, ViewScore()).joined(view)
        ordered[ALL] = everything
    return ordered


def _score_scene(
    sets: SceneSets,
    scene: Scene,
    grade: Grade,
    make: PipelineFactory,
    settings: PipelineSettings,
    camera_counts: Sequence[int],
) -> dict[str, ViewScore]:
    truths = [sets.truth(scene, step) for step in range(scene.steps)]
    fits = [grade.fits(truth) for truth in truths]

    def seen_by(site: Site) -> list[Wanted]:
        return [wanted(truth, fit, scene.camera_ids, site) for truth, fit in zip(truths, fits, strict=True)]

    views: dict[str, ViewScore] = {}
    counts = [count for count in sorted(camera_counts) if count <= len(scene.site.cameras)]
    for count in counts:
        site = site_of_first(scene, count)
        published = _run(scene, site, truths, make(settings))
        low = replace(settings, score_threshold=CURVE_SCORE, min_fused_score=CURVE_SCORE)
        candidates = _run(scene, site, truths, make(low))
        times = [truth.captured_at_ns for truth in truths]
        views[str(count)] = _fused(site, times, seen_by(site), published, candidates)
        if count == counts[-1]:
            for camera in site.cameras:
                alone = replace(site, cameras=(camera,))
                view = _single(alone, seen_by(alone), published, candidates)
                views[SINGLE] = views.get(SINGLE, ViewScore()).joined(view)
    return views


def _run(scene: Scene, site: Site, truths: list[SceneTruth], pipeline: SetPipeline) -> list[SetResult]:
    return [pipeline.run(frame_set) for frame_set in frame_sets(scene, site, [t.captured_at_ns for t in truths])]


def _fused(
    site: Site, times_ns: list[int], truth: list[Wanted], published: list[SetResult], candidates: list[SetResult]
) -> ViewScore:
    tracker = Tracker()
    tracked = []
    for result, captured_at_ns, vehicles in zip(published, times_ns, truth, strict=True):
        source = np.arange(len(result.boxes), dtype=np.int64)
        out = tracker.update(FusedBoxes(result.boxes, result.members, source), captured_at_ns)
        tracked.append(found(out.boxes, result.classes, site, out.track_id).forgiven(vehicles))
    return ViewScore(
        [found(r.boxes, r.classes, site).forgiven(w) for r, w in zip(published, truth, strict=True)],
        [found(r.boxes, r.classes, site).forgiven(w) for r, w in zip(candidates, truth, strict=True)],
        truth,
        [count_scene(moments(tracked, truth))],
    )


def _single(alone: Site, truth: list[Wanted], published: list[SetResult], candidates: list[SetResult]) -> ViewScore:
    """The own boxes of the one camera of ``alone`` against what that camera shows."""
    camera_id = alone.cameras[0].id
    return ViewScore(
        [found(_own(r, camera_id), r.classes, alone).forgiven(w) for r, w in zip(published, truth, strict=True)],
        [found(_own(r, camera_id), r.classes, alone).forgiven(w) for r, w in zip(candidates, truth, strict=True)],
        truth,
    )


def _own(result: SetResult, camera_id: str) -> Boxes:
    """A camera's own boxes; none where its frame could not be decoded."""
    if camera_id not in result.camera_ids:
        return Boxes.empty()
    return result.per_camera[result.camera_ids.index(camera_id)]
