"""Average precision of 2D boxes at IoU 0.5 on real pictures: CARLA's frames, and the held-out end of a PandaSet drive."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.average_precision import PrecisionRecall, curve
from benchmarks.drive_score import Finds, detect_in, outcomes
from benchmarks.drive_truth import drive_frames
from models_export.data.carla2d import read_frames
from models_export.data.detection import DetectionSample, detection_sample
from models_export.data.nanodet import WEIGHTS, open_nanodet
from models_export.data.pandaset import open_pandaset
from models_export.data.pandaset_samples import HELD_OUT_STEPS
from service.geometry.transforms import Array
from service.nets.detections import Detections
from service.nets.detector import Detector
from service.nets.pack import Pack

SCORE_FLOOR = 0.02
"""Boxes below do not enter the curve."""


@dataclass(frozen=True, eq=False)
class Contender:
    """A detector that is scored."""

    name: str
    detector: Finds
    max_width: int
    """Images are decoded to at most this width, px."""


@dataclass(frozen=True, eq=False)
class FlatResult:
    """Boxes found in one picture, and what was there."""

    found: Detections
    truth: Array
    """(N, 4) in the same pixels."""
    ignored: Array
    """(M, 4) where boxes do not count."""


def contenders(pack: Pack, folder: Path) -> list[Contender]:
    """A pack's detector, and NanoDet-g where its weights lie in the folder of the recordings."""
    ours = Detector(pack.networks["detector"])
    found = [Contender(pack.manifest.name, ours, ours.spec.max_width)]
    if (folder / WEIGHTS).is_file():
        nanodet = open_nanodet(folder / WEIGHTS)
        found.append(Contender("NanoDet-g", nanodet, nanodet.max_width))
    return found


def carla_results(contender: Contender, archive: Path) -> Iterator[FlatResult]:
    """The frames that test: any vehicle, at least 5 px wide and high."""
    for frame, data, labels in read_frames(archive, "test"):
        sample: DetectionSample = detection_sample(data, labels, ("vehicle",), contender.max_width, frame.town)
        width, height = sample.image_size
        image = np.ascontiguousarray(sample.canvas[:height, :width])
        (found,) = contender.detector.detect([image], score_threshold=SCORE_FLOOR)
        yield FlatResult(found, sample.xyxy_px[~sample.ignore], sample.xyxy_px[sample.ignore])


def drive_results(contender: Contender, archive: Path, every: int) -> Iterator[FlatResult]:
    """The steps that no training sees, every n-th of them, by the rules of ``drive_truth``."""
    for frame in drive_frames(open_pandaset(archive), HELD_OUT_STEPS[::every]):
        found = detect_in(contender.detector, contender.max_width, frame, SCORE_FLOOR)
        yield FlatResult(found, frame.xyxy_px, frame.ignored_xyxy_px)


def flat_curve(results: Iterable[FlatResult]) -> PrecisionRecall:
    """Precision and recall over pictures: a box takes the free vehicle that it overlaps most, by more than 0.5."""
    parts, scores, counted = [np.zeros(0, np.int64)], [np.zeros(0)], 0
    for result in results:
        order = np.argsort(-result.found.score, kind="stable")
        _, outcome = outcomes(result.found.xyxy_px[order], result.truth, result.ignored)
        parts.append(outcome)
        scores.append(result.found.score[order])
        counted += len(result.truth)
    return curve(np.concatenate(parts), np.concatenate(scores), counted)


def flat_summary(found: PrecisionRecall) -> dict[str, float | int]:
    """AP in percent, vehicles, and recall and precision of the boxes that score 0.3 or more."""
    at = int((found.score >= 0.3).sum()) - 1
    recall, precision = (float(values[at]) if at >= 0 else 0.0 for values in (found.recall, found.precision))
    return {
        "ap50_R40": round(found.average("R40"), 2),
        "ap50_R11": round(found.average("R11"), 2),
        "vehicles": found.counted,
        "recall_at_0.3": round(100 * recall, 2),
        "precision_at_0.3": round(100 * precision, 2),
    }
