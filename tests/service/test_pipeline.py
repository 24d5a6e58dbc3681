"""The whole way of a frame set on the shipped pack and the shipped clip."""

from __future__ import annotations

import json
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import simplejpeg
from numpy.typing import NDArray

from service.errors import FrameError
from service.frames import EncodedFrame, FrameSet
from service.nets.multibin import MultibinEstimates
from service.nets.pack import load_pack
from service.pipeline import Pipeline, PipelineSettings, SetResult
from service.sightings import Sightings
from service.site import AccuracyModel, parse_site

CLIP = Path(__file__).resolve().parents[2] / "clients" / "clip"
STEPS = ("decode", "detect", "orient", "depth", "lift", "fuse", "total")


@pytest.fixture(scope="module")
def pipeline() -> Pipeline:
    pipeline = Pipeline(load_pack("edge"))
    pipeline.warm_up()
    return pipeline


def frame_set(step: int) -> FrameSet:
    site = parse_site(json.loads((CLIP / "site.json").read_text()))
    frames = tuple(EncodedFrame(c.id, (CLIP / c.id / f"{step:06d}.jpg").read_bytes(), None) for c in site.cameras)
    return FrameSet(site, frames, 10**18 + step * 10**8, step + 1)


def assert_well_formed(result: SetResult) -> None:
    boxes = result.boxes
    assert result.members.shape == (len(boxes), len(result.camera_ids))
    assert result.members.any(1).all()
    assert np.isfinite(boxes.center).all()
    assert (boxes.dims_lwh > 0).all()
    assert ((boxes.yaw >= -np.pi) & (boxes.yaw < np.pi)).all()
    assert ((boxes.score >= 0) & (boxes.score <= 1)).all()
    assert (np.linalg.eigvalsh(boxes.covariance) > 0).all()
    assert set(STEPS) <= set(result.timing_ms)
    assert result.timing_ms["total"] >= sum(result.timing_ms[step] for step in STEPS[:-1]) - 0.01


def test_four_frames_give_boxes(pipeline: Pipeline) -> None:
    result = pipeline.run(frame_set(40))
    assert_well_formed(result)
    assert len(result.boxes) >= 3
    assert result.members.sum(1).max() >= 2
    assert sum(len(own) for own in result.per_camera) == sum(result.detections.values())


def test_one_set_gives_one_answer(pipeline: Pipeline) -> None:
    # Fitted scales of the depth map are kept a camera, so each run gets a site, and cameras, of its own.
    first, second = pipeline.run(frame_set(10)), pipeline.run(frame_set(10))
    np.testing.assert_array_equal(first.boxes.center, second.boxes.center)


def test_a_site_that_is_surveyed_better_gives_surer_boxes(pipeline: Pipeline) -> None:
    surveyed = frame_set(30)
    vague = replace(surveyed, site=replace(surveyed.site, accuracy=AccuracyModel(ground_m=0.3, camera_m=0.3, camera_rad=0.02)))
    exact, loose = (np.median(pipeline.run(s).boxes.covariance[:, 0, 0]) for s in (surveyed, vague))
    assert exact < 0.7 * loose


def test_a_lost_camera_leaves_the_others(pipeline: Pipeline) -> None:
    whole = frame_set(40)
    result = pipeline.run(replace(whole, frames=whole.frames[1:]))
    assert_well_formed(result)
    assert result.camera_ids == tuple(frame.camera_id for frame in whole.frames[1:])
    assert len(result.boxes) >= 2


def test_a_damaged_frame_leaves_the_others(pipeline: Pipeline) -> None:
    whole = frame_set(40)
    first = whole.frames[0]
    torn = replace(first, data=first.data[: len(first.data) // 2] + b"\xff\xd9")
    result = pipeline.run(replace(whole, frames=(torn, *whole.frames[1:])))
    assert_well_formed(result)
    assert list(result.failed) == [first.camera_id]
    assert first.camera_id not in result.camera_ids


def test_only_damaged_frames_raise(pipeline: Pipeline) -> None:
    whole = frame_set(40)
    torn = tuple(replace(frame, data=frame.data[:2000] + b"\xff\xd9") for frame in whole.frames)
    with pytest.raises(FrameError, match="damaged"):
        pipeline.run(replace(whole, frames=torn))


def test_a_set_in_which_nothing_is_found_has_no_boxes() -> None:
    strict = Pipeline(load_pack("edge"), PipelineSettings(score_threshold=0.9999))
    result = strict.run(frame_set(40))
    assert_well_formed(result)
    assert len(result.boxes) == 0


@pytest.mark.parametrize("width", [512, 800])
def test_the_same_vehicles_stand_in_the_same_places_at_another_width(pipeline: Pipeline, width: int) -> None:
    other = Pipeline(load_pack("edge"), PipelineSettings(detector_width=width))
    stills, _ = other.decode(frame_set(40))
    assert {still.small.shape[1] for still in stills} == {width}
    assert other.detector_width == width
    ours, theirs = pipeline.run(frame_set(40)).boxes.center, other.run(frame_set(40)).boxes.center
    apart = np.linalg.norm(ours[:, None, :2] - theirs[None, :, :2], axis=2)
    assert np.median(apart.min(1)) < 0.3
    assert (apart.min(1) < 1.0).mean() > 0.7


def test_threads_do_not_disturb_each_other(pipeline: Pipeline) -> None:
    steps = list(range(0, 40, 5))
    alone = [pipeline.run(frame_set(step)).boxes.center for step in steps]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda step: pipeline.run(frame_set(step)).boxes.center, steps))
    for ours, theirs in zip(together, alone, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_cameras_in_another_order_give_the_same_vehicles(pipeline: Pipeline) -> None:
    whole = frame_set(40)
    forward = pipeline.run(whole).boxes.center
    backward = pipeline.run(replace(whole, frames=whole.frames[::-1])).boxes.center
    assert len(forward) == len(backward)
    distance = np.linalg.norm(forward[:, None] - backward[None], axis=-1)
    assert distance.min(1).max() < 0.3


@pytest.mark.parametrize("count", [2, 3, 4])
def test_a_set_in_parts_gives_the_same_answer(pipeline: Pipeline, count: int) -> None:
    # A site of its own each: fitted scales of the depth map are kept a camera.
    whole, parts = pipeline.run(frame_set(40)), frame_set(40).split(count)
    again = pipeline.fuse(parts[0].site, [pickle.loads(pickle.dumps(pipeline.see(part))) for part in parts])
    assert again.camera_ids == whole.camera_ids
    assert again.detections == whole.detections
    assert (again.members == whole.members).all()
    assert again.boxes.center == pytest.approx(whole.boxes.center, abs=1e-6)
    assert again.boxes.covariance == pytest.approx(whole.boxes.covariance, abs=1e-6)
    assert again.parts is not None
    assert whole.parts is not None
    assert (again.parts.captured_at_ns == whole.parts.captured_at_ns).all()


def test_fusing_leaves_what_was_seen_as_it_is(pipeline: Pipeline) -> None:
    seen = pipeline.see(frame_set(40))
    first, second = (pipeline.fuse(frame_set(40).site, [seen]) for _ in range(2))
    assert (first.boxes.center == second.boxes.center).all()
    assert first.timing_ms.keys() == second.timing_ms.keys()


def test_a_part_whose_frames_are_damaged_leaves_the_others(pipeline: Pipeline) -> None:
    whole = frame_set(40)
    torn = [replace(frame, data=frame.data[:2000]) for frame in whole.frames[:2]]
    parts = replace(whole, frames=(*torn, *whole.frames[2:])).split(2)
    result = pipeline.fuse(whole.site, [pipeline.see(part) for part in parts])
    assert_well_formed(result)
    assert set(result.failed) == {frame.camera_id for frame in torn}
    assert result.camera_ids == tuple(frame.camera_id for frame in whole.frames[2:])
    with pytest.raises(FrameError) as caught:
        pipeline.fuse(whole.site, [pipeline.see(part) for part in replace(whole, frames=(*torn,)).split(2)])
    assert caught.value.field == torn[0].camera_id


def test_a_part_with_nothing_in_it_takes_nothing_away(pipeline: Pipeline) -> None:
    whole = frame_set(40)
    blank = simplejpeg.encode_jpeg(np.full((whole.site.cameras[0].height, whole.site.cameras[0].width, 3), 114, np.uint8))
    first, second = replace(whole, frames=(replace(whole.frames[0], data=blank), *whole.frames[1:])).split(2)
    seen = [pipeline.see(replace(first, frames=first.frames[:1])), pipeline.see(second)]
    assert seen[0].terms is None
    together = Sightings.together(seen)
    assert together.terms is not None
    assert len(together.boxes) == len(seen[1].boxes)
    assert (together.camera_index == seen[1].camera_index + 1).all()


def test_the_papers_method_runs_the_whole_way(pipeline: Pipeline) -> None:
    paper = Pipeline(load_pack("edge"), PipelineSettings(method="paper"))
    result, default = paper.run(frame_set(40)), pipeline.run(frame_set(40))
    assert_well_formed(result)
    assert result.detections == default.detections
    assert len(result.boxes) >= 3
    assert not np.allclose(result.per_camera[0].center, default.per_camera[0].center)


def test_a_heading_that_is_no_number_is_an_unknown_heading(monkeypatch: pytest.MonkeyPatch, pipeline: Pipeline) -> None:
    usual = pipeline.multibin.estimate

    def lame(crops: NDArray[np.uint8], cls: NDArray[np.int64]) -> MultibinEstimates:
        estimates = usual(crops, cls)
        return replace(estimates, alpha=np.where(np.arange(len(cls)) % 3 == 0, np.nan, estimates.alpha))

    monkeypatch.setattr(pipeline.multibin, "estimate", lame)
    result = pipeline.run(frame_set(40))
    assert_well_formed(result)
    for own in result.per_camera:
        assert np.isfinite(own.center).all()
        assert np.isfinite(own.yaw).all()
