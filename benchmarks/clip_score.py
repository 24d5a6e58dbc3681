"""How many vehicles the pipeline finds, and how exactly, on the shipped clip and on the real roadside clip."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.centres import MIN_CAMERAS, CentreScore, countable, near_cameras
from benchmarks.clip_sets import clip_frame_sets, clip_truth
from benchmarks.drive_score import outcomes
from benchmarks.recordings import ROADSIDE_STEPS, RoadsideClip, shown_extents
from clients.clip import SHIPPED, open_clip
from service.frames import EncodedFrame, FrameSet, decode
from service.geometry.boxes import scaled_extents
from service.geometry.transforms import Array
from service.pipeline import Pipeline, PipelineSettings
from service.site import Site

ROADSIDE_IOU = 0.4
ROADSIDE_RANGE_M = 40.0
ROADSIDE_MATCH_M = 1.5
ROADSIDE_3D_CLASSES = ("CAR", "VAN")
FALSE_OF_A_SMALL_DETECTOR = 99
"""False boxes of the best small public detector by this protocol, which recalls 188 of the 329 vehicles."""
_NOTHING_IGNORED = np.zeros((0, 4))
MIN_FUSED_SCORE = PipelineSettings().min_fused_score


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


def score_roadside(pipeline: Pipeline, clip: RoadsideClip, least_score: float = MIN_FUSED_SCORE) -> dict[str, Any]:
    """The roadside clip by its protocol: 2D recall at IoU > 0.4, and fused centres of cars and vans within 1.5 m.

    2D boxes are those of the detector, and, beside them, the fused boxes as each camera would show them: those of
    ``least_score``, which the service would publish, and of all that the pipeline gives (its ``min_fused_score`` may be lower)
    the best, until ``FALSE_OF_A_SMALL_DETECTOR`` are false.
    """
    detected, fused, centres = FlatFinds(), FlatFinds(), CentreScore(ROADSIDE_MATCH_M)
    for step in ROADSIDE_STEPS:
        frames = {camera.id: clip.frame(camera.id, step) for camera in clip.site.cameras}
        encoded = tuple(EncodedFrame(camera_id, data, step) for camera_id, data in frames.items())
        boxes = pipeline.run(FrameSet(clip.site, encoded, step * 100_000_000, step + 1)).boxes
        for camera in clip.site.cameras:
            image = pipeline.for_detector(decode(frames[camera.id], camera, pipeline.detector_width))
            found = pipeline.detector.detect([image], score_threshold=pipeline.settings.score_threshold)[0]
            scale = np.array([camera.width / image.shape[1], camera.height / image.shape[0]])
            reference = clip.reference_2d(camera.id, step)
            detected.add(scaled_extents(found.xyxy_px, scale), found.score, reference)
            shown, inside = shown_extents(camera, boxes.center, boxes.dims_lwh, boxes.yaw)
            fused.add(shown[inside], boxes.score[inside], reference)
        published = boxes.take(boxes.score >= least_score)
        center = clip.reference(step)[0]
        small = np.isin(clip.reference_classes(step), ROADSIDE_3D_CLASSES)
        centres.add(published.center, np.ones(len(published), dtype=bool), center, small & _seen_by_two(clip, step, center))
    return {
        "2d": {"references": detected.references} | detected.down_to(0.0),
        "2d_fused": fused.down_to(least_score),
        f"2d_fused_at_most_{FALSE_OF_A_SMALL_DETECTOR}_false": fused.up_to(FALSE_OF_A_SMALL_DETECTOR),
        "3d_cars_and_vans_seen_by_two_within_40_m": centres.summary(),
    }


class FlatFinds:
    """2D boxes of many pictures: which took a reference box, and their scores."""

    def __init__(self) -> None:
        self.references = 0
        self._right: list[NDArray[np.bool_]] = []
        self._score: list[Array] = []

    def add(self, xyxy_px: Array, score: Array, reference: Array) -> None:
        """The boxes (K, 4) of one picture with their scores (K,), and its reference boxes (N, 4)."""
        order = np.argsort(-score, kind="stable")
        self.references += len(reference)
        self._right.append(outcomes(xyxy_px[order], reference, _NOTHING_IGNORED, ROADSIDE_IOU)[1] > 0)
        self._score.append(score[order])

    def down_to(self, least_score: float) -> dict[str, float | int]:
        """Right and false boxes of at least a score."""
        right = np.concatenate(self._right)[np.concatenate(self._score) >= least_score]
        return {"recalled": int(right.sum()), "false": int((~right).sum())}

    def up_to(self, most_false: int) -> dict[str, float | int]:
        """Right and false boxes of the best scores of which no more are false, and the least of these scores."""
        scores = np.unique(np.concatenate(self._score))
        counts = [self.down_to(score) | {"least_score": round(float(score), 4)} for score in scores]
        return next(
            (count for count in counts if count["false"] <= most_false), {"recalled": 0, "false": 0, "least_score": 1.0}
        )


def _seen_by_two(clip: RoadsideClip, step: int, center: Array) -> Any:
    """Vehicles (N,) whose centre projects into two cameras' images, from within 40 m."""
    views = [_in_view(clip.site, index, center) for index in range(len(clip.site.cameras))]
    return np.sum(views, axis=0) >= MIN_CAMERAS


def _in_view(site: Site, index: int, center: Array) -> Any:
    camera = site.cameras[index]
    pixels, depth = camera.project(center)
    inside = np.all((pixels >= 0) & (pixels <= [camera.width - 1, camera.height - 1]), axis=1)
    return inside & (depth > 0) & (np.linalg.norm(center - camera.position_m, axis=1) <= ROADSIDE_RANGE_M)
