"""Which kind of worker the settings give, and that a process computes what the pipeline here does."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.clip_sets import clip_frame_sets
from service.errors import PackError
from service.pipeline import Pipeline, PipelineSettings
from service.runners import load_pipeline, make_runner
from service.settings import Settings
from service.worker_processes import ProcessRunner


@pytest.mark.parametrize(
    ("kind", "gpu", "expected"),
    [("auto", False, ProcessRunner), ("auto", True, Pipeline), ("process", True, ProcessRunner), ("thread", False, Pipeline)],
)
def test_kinds_of_workers(monkeypatch: pytest.MonkeyPatch, kind: Any, gpu: bool, expected: type) -> None:
    monkeypatch.setattr("service.runners.is_gpu", lambda provider, offered: gpu)
    runner = make_runner(Settings(worker_kind=kind, workers=1, provider="cpu"))
    try:
        assert isinstance(runner, expected)
    finally:
        if isinstance(runner, ProcessRunner):
            runner.close()


def test_a_pack_that_is_not_there_is_an_error_here() -> None:
    with pytest.raises(PackError):
        make_runner(Settings(pack="no-such-pack", workers=2))


def test_each_threshold_is_set_by_itself() -> None:
    def thresholds(**given: float) -> tuple[float, float]:
        settings = load_pipeline(Settings(workers=1, provider="cpu", **given)).settings  # type: ignore[arg-type]
        return settings.score_threshold, settings.min_fused_score

    own = PipelineSettings()
    assert thresholds() == (own.score_threshold, own.min_fused_score)
    assert thresholds(score_threshold=0.4) == (0.4, own.min_fused_score)
    assert thresholds(min_fused_score=0.0) == (own.score_threshold, 0.0)


def test_a_process_gives_the_pipelines_own_boxes() -> None:
    settings = Settings(workers=1, provider="cpu")
    frame_set = clip_frame_sets()[40]
    ours = load_pipeline(settings).run(frame_set)
    runner = make_runner(settings)
    assert isinstance(runner, ProcessRunner)
    try:
        theirs = runner.run(frame_set)
    finally:
        runner.close()
    np.testing.assert_array_equal(theirs.boxes.center, ours.boxes.center)
    np.testing.assert_array_equal(theirs.boxes.covariance, ours.boxes.covariance)
    np.testing.assert_array_equal(theirs.members, ours.members)
    assert (theirs.camera_ids, theirs.classes, theirs.detections) == (ours.camera_ids, ours.classes, ours.detections)
