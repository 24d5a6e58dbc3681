"""How many vehicles the pipeline finds, and how exactly, on the shipped clip and on the real roadside clip."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.centres import MIN_CAMERAS, CentreScore, countable, near_cameras
from benchmarks.clip_sets import clip_frame_sets, clip_truth
from benchmarks.recordings import ROADSIDE_STEPS, RoadsideClip
from clients.clip import SHIPPED, open_clip
from service.frames import EncodedFrame, FrameSet, decode
from service.geometry.iou import iou_2d
from service.geometry.transforms import Array
from service.pipeline import Pipeline
from service.site import Site

ROADSIDE_IOU = 0.4
ROADSIDE_RANGE_M = 40.0
ROADSIDE_MATCH_M = 1.5
ROADSIDE_3D_CLASSES = ("CAR", "VAN")


def score_clip(pipeline: Pipeline, clip_path: Path = SHIPPED, cameras: int | None = None) -> dict[str, float | int]:
    """Fused boxes of every step of a clip against its truth.

    Counted are vehicles that two cameras see more than half of from within 40 m; a box is false when it lies within 40 m of
    two cameras and no vehicle's centre is within 1 m of its own.
    """
    clip = open_clip(clip_path)
    score = CentreScore()
    for frame_set, truth in zip(clip_frame_sets(clip, cameras), clip_truth(clip), strict=True):
        site = frame_set.site
        boxes = pipeline.run(frame_set).boxes
        counted = near_cameras(site, boxes.center) >= min(MIN_CAMERAS, len(site.cameras))
        visible = truth.visible[:, : len(site.cameras)]
        score.add(boxes.center, counted, truth.center, countable(site, truth.center, visible))
    return score.summary()


def score_roadside(pipeline: Pipeline, clip: RoadsideClip) -> dict[str, Any]:
    """The roadside clip by its protocol: 2D recall at IoU > 0.4, and fused centres of cars and vans within 1.5 m."""
    references = recalled = false = 0
    fused = CentreScore(ROADSIDE_MATCH_M)
    for step in ROADSIDE_STEPS:
        frames = {camera.id: clip.frame(camera.id, step) for camera in clip.site.cameras}
        for camera in clip.site.cameras:
            image = pipeline.for_detector(decode(frames[camera.id], camera, pipeline.detector_width))
            found = pipeline.detector.detect([image], score_threshold=pipeline.settings.score_threshold)[0]
            scale = np.array([camera.width / image.shape[1], camera.height / image.shape[0]] * 2)
            hits = _greedy_hits(found.xyxy_px * scale, clip.reference_2d(camera.id, step))
            references += len(clip.reference_2d(camera.id, step))
            recalled += hits
            false += len(found) - hits
        encoded = tuple(EncodedFrame(camera_id, data, step) for camera_id, data in frames.items())
        boxes = pipeline.run(FrameSet(clip.site, encoded, step * 100_000_000, step + 1)).boxes
        center = clip.reference(step)[0]
        small = np.isin(clip.reference_classes(step), ROADSIDE_3D_CLASSES)
        fused.add(boxes.center, np.ones(len(boxes), dtype=bool), center, small & _seen_by_two(clip, step, center))
    return {
        "2d": {"references": references, "recalled": recalled, "false": false},
        "3d_cars_and_vans_seen_by_two_within_40_m": fused.summary(),
    }


def _seen_by_two(clip: RoadsideClip, step: int, center: Array) -> Any:
    """Vehicles (N,) whose centre projects into two cameras' images, from within 40 m."""
    views = [_in_view(clip.site, index, center) for index in range(len(clip.site.cameras))]
    return np.sum(views, axis=0) >= MIN_CAMERAS


def _in_view(site: Site, index: int, center: Array) -> Any:
    camera = site.cameras[index]
    pixels, depth = camera.project(center)
    inside = np.all((pixels >= 0) & (pixels <= [camera.width - 1, camera.height - 1]), axis=1)
    return inside & (depth > 0) & (np.linalg.norm(center - camera.position_m, axis=1) <= ROADSIDE_RANGE_M)


def _greedy_hits(ours: Array, reference: Array) -> int:
    """How many of our boxes (best first) take a reference box each at IoU > 0.4."""
    overlap = iou_2d(ours, reference)
    hits = 0
    for row in range(len(ours)):
        if overlap.shape[1] and (best := int(overlap[row].argmax())) >= 0 and overlap[row, best] > ROADSIDE_IOU:
            overlap[:, best] = 0.0
            hits += 1
    return hits
