"""Fitting the weights of a fused box's score."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.confidence_fit import MEAN, SHIPPED, Candidates, candidates, confidence_figures, confidence_table, fit
from benchmarks.scene_sets import open_scene_sets
from service.confidence import Confidence

TRUE = Confidence(offset=-1.0, score=1.2, doubt=-2.0, several=-0.7, silent=-0.4)


def seen(count: int, seed: int, ignored: float = 0.1) -> Candidates:
    """Boxes that are right as often as ``TRUE`` says, some of them left out."""
    rng = np.random.default_rng(seed)
    facts = np.column_stack(
        [rng.normal(1, 2, count), rng.normal(-1, 1, count), rng.random(count) < 0.5, rng.integers(0, 4, count)]
    )
    outcome = (rng.random(count) < TRUE.of(facts)).astype(np.int64)
    outcome[rng.random(count) < ignored] = -1
    return Candidates(facts, {0.5: outcome, 0.7: outcome}, int((outcome == 1).sum()))


def test_the_weights_that_made_the_outcomes_are_found() -> None:
    np.testing.assert_allclose(astuple(fit(seen(60_000, 0))), astuple(TRUE), atol=0.08)


def test_evidence_that_never_varies_gets_no_weight() -> None:
    boxes = seen(5000, 1)
    boxes.evidence[:, 2] = 1.0
    weights = fit(boxes)
    assert np.isfinite(astuple(weights)).all()
    assert weights.several == 0.0


def test_true_weights_rank_best() -> None:
    boxes = seen(20_000, 2)
    blind = Confidence(score=0.0, silent=1.0)
    assert boxes.average_precision(TRUE, 0.5) > boxes.average_precision(Confidence(), 0.5) > boxes.average_precision(blind, 0.5)


def test_figures_try_every_weighting_on_every_set() -> None:
    figures = confidence_figures({"a": seen(4000, 3), "b": seen(4000, 4)})
    assert list(figures["weights"]) == list(figures["ap_3d"]) == [SHIPPED, "a", "b", MEAN]
    own, other, both = (figures["weights"][name]["doubt"] for name in ("a", "b", MEAN))
    assert both == pytest.approx((own + other) / 2, abs=0.011)
    assert set(figures["ap_3d"][MEAN]) == {"a", "b"}
    assert confidence_table("", figures).row_count == 4


def test_boxes_of_scenes_become_candidates(dataset: Path, answering: Callable[..., Any]) -> None:
    perfect = candidates(open_scene_sets(dataset), answering())
    assert perfect.evidence.shape == (len(perfect.outcomes[0.7]), 4)
    # Each of five cars a set is found once; the van's box, called a car, lies on an ignored vehicle.
    assert (perfect.outcomes[0.7] == 1).sum() == perfect.vehicles
    assert not (perfect.outcomes[0.7] == 0).any()
    off = candidates(open_scene_sets(dataset), answering(offset_m=(0.0, 0.0, 0.45)))
    assert (off.outcomes[0.5] == 1).sum() == off.vehicles
    assert not (off.outcomes[0.7] == 1).any()
