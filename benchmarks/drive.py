"""``bench-accuracy pandaset``: a pack's 2D detector on the frames of a real drive."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
from rich.table import Table

from benchmarks.drive_score import MIN_IOU, DriveScore, detect_in, score_drive
from benchmarks.drive_truth import MIN_CLEAR, MIN_HEIGHT_PX, MIN_INSIDE, DriveFrame
from service.frames import decode
from service.nets.detector import Detector
from service.nets.pack import Network

RULES = {
    "min_iou": MIN_IOU,
    "min_height_px": MIN_HEIGHT_PX,
    "min_inside": MIN_INSIDE,
    "min_clear": MIN_CLEAR,
    "truth": "extents of projected cuboids of cars, pickups, trucks and buses; classes are not compared",
    "not_known": "what hides a vehicle, other cuboids aside",
}
_TRUE, _OURS, _IGNORED = (0, 255, 0), (255, 0, 0), (120, 120, 255)


def score_pack(network: Network, frames: Sequence[DriveFrame], thresholds: Sequence[float]) -> list[DriveScore]:
    """Scores of a pack's detector by threshold."""
    detector = Detector(network)
    return score_drive(detector, detector.spec.max_width, frames, thresholds)


def write_pictures(network: Network, frames: Sequence[DriveFrame], threshold: float, folder: Path) -> None:
    """One picture a frame: the truth green (thin where something nearer covers it), ignored extents blue, boxes found red."""
    folder.mkdir(parents=True, exist_ok=True)
    detector = Detector(network)
    for frame in frames:
        picture = decode(frame.jpeg, frame.camera, frame.camera.width).copy()
        for row in frame.ignored_xyxy_px.round().astype(int).tolist():
            cv2.rectangle(picture, row[:2], row[2:], _IGNORED, 1)
        for row, clear in zip(frame.xyxy_px.round().astype(int).tolist(), frame.clear, strict=True):
            cv2.rectangle(picture, row[:2], row[2:], _TRUE, 2 if clear else 1)
        for row in detect_in(detector, detector.spec.max_width, frame, threshold).xyxy_px.round().astype(int).tolist():
            cv2.rectangle(picture, row[:2], row[2:], _OURS, 2)
        cv2.imwrite(str(folder / f"{frame.step:02d}-{frame.camera.id}.jpg"), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))


def drive_table(title: str, scores: dict[str, list[DriveScore]]) -> Table:
    """One row a runtime and threshold."""
    table = Table(title=title)
    rows = [(runtime, score.summary()) for runtime, of_runtime in scores.items() for score in of_runtime]
    table.add_column("runtime")
    for name in rows[0][1] if rows else ():
        table.add_column(name.replace("_", " "), justify="right")
    for runtime, summary in rows:
        table.add_row(runtime, *(str(value) for value in summary.values()))
    return table


def drive_figures(scores: dict[str, list[DriveScore]]) -> dict[str, Any]:
    """The same as JSON-ready data."""
    return {runtime: [score.summary() for score in of_runtime] for runtime, of_runtime in scores.items()}
