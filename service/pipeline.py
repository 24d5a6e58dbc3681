"""One frame set's way through the house: decode, detect, orient, depth, lift, fuse. Knows no HTTP, times each step."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from service.confidence import Confidence
from service.depth_scale import DepthReadings, DepthScale, DepthScales, read_boxes
from service.errors import FrameError
from service.frames import FrameSet, decode, reduced, resized
from service.fusion import CameraParts, FusedBoxes, FusionSettings, fuse
from service.geometry.boxes import Boxes
from service.geometry.camera import Camera, UInt8Image
from service.guidance import Guidance, GuidanceSettings, HardMode, View
from service.lifting import LiftSettings, lift_with_terms
from service.measurements import Measurements
from service.measuring import measure, read_vehicles
from service.nets.canvas import Canvases, canvas_size
from service.nets.depth import DepthNet, InverseDepth
from service.nets.detections import Detections
from service.nets.detector import NMS_IOU, SCORE_THRESHOLD, Detector
from service.nets.multibin import Multibin, cut_crops
from service.nets.pack import Pack
from service.paper_fusion import PaperFusionSettings, fuse_paper
from service.residuals import BoxProblem
from service.sightings import Sightings
from service.site import Site
from service.solver import SolverSettings
from service.stills import DetectedVehicles, Still

CONFIDENCE = Confidence(offset=-3.7, score=0.48, doubt=-3.4, several=-0.5, silent=-0.8)
"""``FusionSettings.confidence`` of a pipeline, fitted on validation scenes (docs: fusion): the score is then about the share of
such boxes that overlap a vehicle by more than half."""
TAIL_SIGMAS, TAIL_SHARE = 1.4, 0.5
"""``LiftSettings.tail_sigmas`` and ``FusionSettings.tail_share`` of a pipeline: a network's outline of a vehicle that is partly
hidden is a guess, and wrong guesses are far off (validation scenes; docs: lifting, fusion)."""
GATE = 6.0
"""``FusionSettings.gate`` of a pipeline: 95 % of a chi-square with 2 degrees of freedom."""
SOLVER = SolverSettings(step_tolerance=1.0)
"""Of a pipeline's lifting and fusion: with networks' outlines, steps shorter than a sigma change no AP (docs: fusion)."""
_WARM_UP_CROPS = 64
"""Vehicles in four cameras' views of a busy crossing."""


@dataclass(frozen=True)
class PipelineSettings:
    """What can be set of the pipeline; the rest comes from the pack and the site."""

    method: Literal["map", "paper"] = "map"
    """How boxes are lifted and fused: by maximum a posteriori and information, or as in the source paper."""
    hard_mode: HardMode = "auto"
    """Whether the depth-guided detector adds to what was lifted: in cameras whose view is hard, in all, or in none."""
    score_threshold: float = SCORE_THRESHOLD
    """2D detections of a lower score are dropped."""
    detector_width: int | None = None
    """All pictures are brought to this width for the detector and the depth net, px; None: only those that are wider than the
    pack says, to that. More finds smaller vehicles, also where it enlarges, in time that grows with its square (docs:
    networks)."""
    nms_iou: float = NMS_IOU
    """2D boxes that overlap a better one by more are dropped."""
    refine_shift: float = 0.05
    """Vehicles are read a second time whose outline differs from the detected box by more of its longer side; 1: none are. On
    validation scenes these are 52 %; most of what reading all of them twice would gain (docs: networks)."""
    min_fused_score: float = 0.2
    """Fused boxes of a lower score are dropped."""
    lift: LiftSettings = field(default_factory=lambda: LiftSettings(tail_sigmas=TAIL_SIGMAS, solver=SOLVER))
    """How exact the ground is, and for fusion the cameras, a site's own ``accuracy`` says."""
    guidance: GuidanceSettings = field(default_factory=GuidanceSettings)
    fusion: FusionSettings = field(
        default_factory=lambda: FusionSettings(gate=GATE, confidence=CONFIDENCE, solver=SOLVER, tail_share=TAIL_SHARE)
    )
    paper_fusion: PaperFusionSettings = field(default_factory=PaperFusionSettings)


@dataclass(frozen=True, eq=False)
class SetResult:
    """What the pipeline says of one frame set."""

    boxes: Boxes
    """Fused boxes (M) in the world frame."""
    members: NDArray[np.bool_]
    """(M, C): which of ``camera_ids`` saw each box."""
    camera_ids: tuple[str, ...]
    """The C cameras whose frames were decoded."""
    classes: tuple[str, ...]
    """Names of the class indices."""
    per_camera: list[Boxes]
    """Each camera's own lifted boxes, in the order of ``camera_ids``."""
    detections: dict[str, int]
    """Boxes a camera, before fusion."""
    timing_ms: dict[str, float]
    """Wall time of each step."""
    failed: dict[str, FrameError]
    """Cameras whose frame could not be decoded."""
    parts: CameraParts | None = None
    """What each camera contributed to ``boxes``, and when, for the tracker; cameras as in ``camera_ids``."""
    hard: frozenset[str] = frozenset()
    """Cameras in which the depth-guided detector ran."""


class Pipeline:
    """The steps, composed over one pack. Safe to run from several threads at once."""

    def __init__(self, pack: Pack, settings: PipelineSettings | None = None) -> None:
        self.settings = settings or PipelineSettings()
        self.classes = tuple(pack.manifest.classes)
        self.detector = Detector(pack.networks["detector"])
        self.multibin = Multibin(pack.networks["multibin"])
        self.depth = DepthNet(pack.networks["depth"])
        self.guidance = Guidance.of(pack, self.settings.hard_mode, self.settings.guidance)
        self._scales = DepthScales()
        # Whole frame sets run side by side; threads inside OpenCV would only fight them for the same cores.
        cv2.setNumThreads(1)

    @property
    def detector_width(self) -> int:
        """Width of the widest picture that the detector sees, px."""
        return self.settings.detector_width or self.detector.spec.max_width

    def for_detector(self, image: UInt8Image) -> UInt8Image:
        """A picture (H, W, 3) at the size at which the detector sees it."""
        width = self.settings.detector_width
        return reduced(image, self.detector_width) if width is None else resized(image, width)

    def warm_up(self) -> None:
        """Run every network twice on four frames of the paper's size full of vehicles.

        So the first request pays no set-up, and a worker takes its memory now: one that at first sees only parts of frame
        sets would grow with its first whole ones, perhaps hours later. Twice, for at its second run of a shape ONNX Runtime
        takes one more block, for all results in between.
        """
        width, height = canvas_size(self.detector_width, 192)
        images = [np.full((height, width, 3), 114, np.uint8)] * 4
        boxes = np.tile([0.0, 0.0, 20.0, 20.0], (_WARM_UP_CROPS, 1))
        crops = cut_crops(images[0], boxes, self.multibin.spec.crop_px)
        for _ in range(2):
            self.detector.detect(images)
            self.depth.infer(images)
            self.multibin.estimate(crops, np.zeros(len(boxes), np.int64))
            if self.guidance is not None:
                self.guidance.warm_up(images)

    def run(self, frame_set: FrameSet) -> SetResult:
        """All steps for one set. Raises the first FrameError when not one frame can be decoded."""
        return self.fuse(frame_set.site, [self.see(frame_set)])

    def see(self, frame_set: FrameSet) -> Sightings:
        """The steps that each camera of a set takes by itself, whatever the others saw: all but fusion."""
        timing: dict[str, float] = {}
        started = time.perf_counter()
        with _timed(timing, "decode"):
            stills, failed = self.decode(frame_set)
        if not stills:
            return Sightings.of_none(failed)
        cameras = [still.camera for still in stills]
        with _timed(timing, "detect"):
            canvases = Canvases([still.small for still in stills])
            found = self._detect(canvases)
        detected = DetectedVehicles.of(stills, found)
        with _timed(timing, "orient"):
            estimates = read_vehicles(detected, self.multibin, self.settings.refine_shift)
        with _timed(timing, "depth"):
            maps = self._metric_maps(frame_set, stills, canvases)
            readings = self._read_depth(maps, found)
        with _timed(timing, "lift"):
            measured = measure(detected, estimates, readings, self.detector.spec, self.multibin.spec)
            lifted, terms = self._lift(cameras, frame_set.site, measured)
            index = measured.camera_index
        hard: frozenset[str] = frozenset()
        if self.guidance is not None:
            with _timed(timing, "guided"):
                lifted, index, hard = self._guided(self.guidance, stills, found, maps, frame_set.site, lifted, index)
            # Guided boxes were not solved from terms: a set that has any is combined by covariance.
            terms = None if hard else terms
        own = {frame.camera_id: frame.captured_at_ns for frame in frame_set.frames if frame.captured_at_ns is not None}
        timing["total"] = 1e3 * (time.perf_counter() - started)
        return Sightings(
            cameras=tuple(cameras),
            captured_at_ns=tuple(own.get(camera.id, frame_set.captured_at_ns) for camera in cameras),
            boxes=lifted,
            terms=terms,
            camera_index=index,
            hard=hard,
            timing_ms=timing,
            failed=failed,
        )

    def fuse(self, site: Site, seen: Sequence[Sightings]) -> SetResult:
        """What a set's cameras saw, made one. Raises the first FrameError when not one frame could be decoded."""
        started = time.perf_counter()
        sightings = Sightings.together(seen)
        if not sightings.cameras:
            raise next(iter(sightings.failed.values()))
        cameras, index = sightings.cameras, sightings.camera_index
        timing = dict(sightings.timing_ms)
        before = timing.pop("total")
        with _timed(timing, "fuse"):
            fused = self._fuse(sightings, site)
            keep = fused.boxes.score >= self.settings.min_fused_score
        timing["total"] = before + 1e3 * (time.perf_counter() - started)
        own = [sightings.boxes.take(index == number) for number in range(len(cameras))]
        return SetResult(
            boxes=fused.boxes.take(keep),
            members=fused.members[keep],
            camera_ids=tuple(camera.id for camera in cameras),
            classes=self.classes,
            per_camera=own,
            detections={camera.id: len(boxes) for camera, boxes in zip(cameras, own, strict=True)},
            timing_ms=timing,
            failed=sightings.failed,
            parts=None if fused.parts is None else sightings.timed(fused.parts.of_rows(keep)),
            hard=sightings.hard,
        )

    def _lift(self, cameras: list[Camera], site: Site, measurements: Measurements) -> tuple[Boxes, BoxProblem | None]:
        told = site.accuracy
        settings = replace(self.settings.lift, ground_sigma_m=told.ground_m, ground_sigma_per_m=told.ground_per_m)
        if self.settings.method == "paper":
            # Imported here: the default method does not pay for it.
            from service.paper_lifting import lift_paper

            return lift_paper(cameras, site.ground, measurements, settings), None
        return lift_with_terms(cameras, site.ground, measurements, settings)

    def _guided(
        self,
        guidance: Guidance,
        stills: list[Still],
        found: list[Detections],
        maps: list[tuple[InverseDepth, DepthScale | None]],
        site: Site,
        lifted: Boxes,
        index: NDArray[np.int64],
    ) -> tuple[Boxes, NDArray[np.int64], frozenset[str]]:
        """Boxes and their cameras after the hard path, and the cameras that took it."""
        rows = zip(stills, found, maps, strict=True)
        views = [View(still, own, *depth) for still, own, depth in rows]
        hard = guidance.hard_views(views)
        lifted, index = guidance.add(views, hard, site, lifted, index, self.settings.method)
        return lifted, index, frozenset(still.camera.id for still, is_hard in zip(stills, hard, strict=True) if is_hard)

    def _fuse(self, seen: Sightings, site: Site) -> FusedBoxes:
        if self.settings.method == "paper":
            return fuse_paper(seen.boxes, seen.camera_index, seen.cameras, self.settings.paper_fusion)
        told = site.accuracy
        settings = replace(self.settings.fusion, calibration_sigma_m=told.camera_m, calibration_sigma_rad=told.camera_rad)
        return fuse(seen.boxes, seen.camera_index, seen.cameras, settings, seen.terms)

    def decode(self, frame_set: FrameSet) -> tuple[list[Still], dict[str, FrameError]]:
        """The first step alone: every frame at the sizes that the networks want, and the cameras whose frames are damaged."""
        stills, failed = [], {}
        crop_width = max(self.multibin.spec.max_width or 0, self.detector_width)
        width = max(crop_width, self.guidance.max_width or 0) if self.guidance is not None else crop_width
        for frame in frame_set.frames:
            camera = frame_set.site.camera(frame.camera_id)
            try:
                image = decode(frame.data, camera, width)
            except FrameError as error:
                failed[camera.id] = error
                continue
            stills.append(Still(camera, reduced(image, crop_width), self.for_detector(image), image))
        return stills, failed

    def _detect(self, canvases: Canvases) -> list[Detections]:
        batches, settings = canvases.batches(self.detector.fit), self.settings
        return self.detector.detect_on(batches, score_threshold=settings.score_threshold, nms_iou=settings.nms_iou)

    def _metric_maps(
        self, frame_set: FrameSet, stills: list[Still], canvases: Canvases
    ) -> list[tuple[InverseDepth, DepthScale | None]]:
        """Each image's inverse depth, and what makes it metric."""
        maps = self.depth.infer_on(canvases.batches(self.depth.fit))
        return [
            (inverse, self._scales.update(still.site_camera, still.small_camera, frame_set.site.ground, inverse))
            for still, inverse in zip(stills, maps, strict=True)
        ]

    def _read_depth(self, maps: list[tuple[InverseDepth, DepthScale | None]], found: list[Detections]) -> DepthReadings:
        parts = [
            read_boxes(inverse, scale, detections.xyxy_px, self.depth.reading)
            for (inverse, scale), detections in zip(maps, found, strict=True)
        ]
        return DepthReadings(np.concatenate([p.depth_m for p in parts]), np.concatenate([p.sigma_m for p in parts]))


@contextmanager
def _timed(timing: dict[str, float], step: str) -> Iterator[None]:
    started = time.perf_counter()
    try:
        yield
    finally:
        timing[step] = 1e3 * (time.perf_counter() - started)
