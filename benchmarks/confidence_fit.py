"""The weights of a fused box's score (:mod:`service.confidence`), by logistic regression on scenes with exact truth.

Right is a fused box that overlaps a vehicle by more than ``RIGHT_IOU`` in three dimensions, by the rules of average precision:
a second box on the same vehicle is false, and boxes that stand on an ignored vehicle, or where no camera looks, are left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, astuple, dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from scipy.optimize import minimize

from benchmarks.average_precision import OVERLAPS, curve, outcome
from benchmarks.scene_grades import grade_of
from benchmarks.scene_score import CURVE_SCORE, MIN_OVERLAPS, PipelineFactory
from benchmarks.scene_sets import SceneSets, found, frame_sets, of_counted_class, wanted
from service.confidence import Confidence, evidence
from service.fusion import silent_cameras
from service.geometry.transforms import Array
from service.odds import log_odds, probability
from service.pipeline import CONFIDENCE, PipelineSettings, SetResult
from service.site import Site

RIGHT_IOU = 0.5
RIDGE = 1e-4
"""Pull of the weights of normalised evidence to zero: it only keeps them finite where a kind of evidence never varies."""
SHIPPED, MEAN = "shipped", "mean"


@dataclass(frozen=True, eq=False)
class Candidates:
    """Fused boxes of a set of scenes, of any score."""

    evidence: Array
    """(K, 4) as :func:`service.confidence.evidence` gives it."""
    outcomes: dict[float, NDArray[np.int64]]
    """(K,) by least overlap: 1 right, 0 false, -1 left out, when better boxes by the shipped weights choose first."""
    vehicles: int
    """How many had to be found."""

    def average_precision(self, confidence: Confidence, min_overlap: float) -> float:
        """AP3D in percent (R40) when boxes are ranked by a confidence; which box took which vehicle stays as it was."""
        return curve(self.outcomes[min_overlap], confidence.of(self.evidence), self.vehicles).average("R40")


def candidates(sets: SceneSets, make: PipelineFactory) -> Candidates:
    """What all cameras of every scene make of it, 2D boxes down to the score of the precision curves."""
    settings = PipelineSettings()
    # As it stands a confidence is the mean of the cameras' scores: what the evidence takes.
    plain = replace(settings.fusion, confidence=Confidence())
    settings = replace(settings, score_threshold=CURVE_SCORE, min_fused_score=0.0, fusion=plain)
    known: list[Array] = []
    outcomes: dict[float, list[NDArray[np.int64]]] = {overlap: [] for overlap in MIN_OVERLAPS}
    vehicles = 0
    for scene in sets.scenes:
        grade, pipeline = grade_of(scene), make(settings)
        truths = [sets.truth(scene, step) for step in range(scene.steps)]
        steps = frame_sets(scene, scene.site, [truth.captured_at_ns for truth in truths])
        for frame_set, truth in zip(steps, truths, strict=True):
            there = wanted(truth, grade.fits(truth), scene.camera_ids, scene.site)
            result = pipeline.run(frame_set)
            facts = _facts(result, scene.site, plain.view_range_m)
            boxes = replace(result.boxes, score=CONFIDENCE.of(facts))
            ours = found(boxes, result.classes, scene.site).forgiven(there)
            for overlap, parts in outcomes.items():
                parts.append(outcome(ours, there, OVERLAPS["3d"](ours.states, there.states), overlap))
            known.append(facts[of_counted_class(boxes, result.classes)])
            vehicles += int(there.counted.sum())
    return Candidates(np.concatenate(known), {o: np.concatenate(parts) for o, parts in outcomes.items()}, vehicles)


def _facts(result: SetResult, site: Site, range_m: float) -> Array:
    """The evidence (M, 4) on a result whose scores are the cameras' means."""
    cameras = [site.camera(camera_id) for camera_id in result.camera_ids]
    silences = silent_cameras(result.boxes, result.members, cameras, range_m)
    return evidence(result.boxes, result.members.sum(1), silences)


def fit(seen: Candidates) -> Confidence:
    """Weights under which the candidates' outcomes are likeliest."""
    used = seen.outcomes[RIGHT_IOU] >= 0
    right = (seen.outcomes[RIGHT_IOU][used] == 1).astype(np.float64)
    mean, scale = seen.evidence[used].mean(0), seen.evidence[used].std(0)
    scale = np.where(scale > 0, scale, 1.0)
    normal = np.column_stack([np.ones(len(right)), (seen.evidence[used] - mean) / scale])

    def loss(weights: Array) -> tuple[float, Array]:
        odds = normal @ weights
        pull = np.append(0.0, weights[1:])
        value = np.logaddexp(0.0, odds).mean() - (right * odds).mean() + RIDGE * (pull @ pull)
        return float(value), normal.T @ (probability(odds) - right) / len(right) + 2 * RIDGE * pull

    found_weights = minimize(loss, np.append(log_odds(right.mean(keepdims=True), 1e-6), np.zeros(4)), jac=True).x
    weights = found_weights[1:] / scale
    return Confidence(float(found_weights[0] - weights @ mean), *weights.tolist())


def confidence_figures(by_set: Mapping[str, Candidates]) -> dict[str, Any]:
    """Each set's weights, their mean and the shipped ones, and what AP every set has under each of these."""
    weights = {name: fit(seen) for name, seen in by_set.items()}
    mean = Confidence(*np.mean([astuple(w) for w in weights.values()], 0).tolist())
    rows = {SHIPPED: CONFIDENCE, **weights, MEAN: mean}
    return {
        "vehicles": {name: seen.vehicles for name, seen in by_set.items()},
        "weights": {name: {key: round(value, 2) for key, value in asdict(w).items()} for name, w in rows.items()},
        "ap_3d": {
            name: {
                on: {str(overlap): round(seen.average_precision(w, overlap), 2) for overlap in MIN_OVERLAPS}
                for on, seen in by_set.items()
            }
            for name, w in rows.items()
        },
    }


def confidence_table(title: str, figures: Mapping[str, Any]) -> Table:
    """A row for each weighting: its weights, then AP3D of every set of scenes."""
    table = Table(title=title, title_justify="left")
    table.add_column("fitted on")
    names = [f.name for f in fields(Confidence)]
    for name in names:
        table.add_column(name, justify="right")
    sets = list(figures["vehicles"])
    for on in sets:
        table.add_column(f"AP3D {' / '.join(map(str, MIN_OVERLAPS))} on {on}", justify="right")
    for name, weights in figures["weights"].items():
        scores = [" / ".join(f"{value:.1f}" for value in figures["ap_3d"][name][on].values()) for on in sets]
        table.add_row(name, *(f"{weights[key]:.2f}" for key in names), *scores)
    return table
