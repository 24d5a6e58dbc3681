"""Lifted boxes against true ones: centre errors, IoU box by box, normalised errors; and measurements made of true boxes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from service.geometry.boxes import Boxes, box_states
from service.geometry.camera import Camera
from service.geometry.ground import Ground
from service.geometry.iou import clip_convex_pairs, rectangle_corners
from service.geometry.transforms import Array, wrap_angle
from service.lifting import LiftSettings, lift, lift_with_terms
from service.measurements import Measurements
from service.paper_lifting import lift_paper
from service.residuals import BoxProblem

Lift = Callable[[Sequence[Camera], Ground, Measurements, LiftSettings | None], Boxes]
METHODS: dict[str, Lift] = {"paper": lift_paper, "map": lift}
"""The ways of lifting that every table sets side by side."""

Row = dict[str, float | int]
"""One line of a table."""

_CHUNK = 2048


@dataclass(frozen=True, eq=False)
class Sigmas:
    """What a benchmark tells the lift about its inputs."""

    px: Array
    """() or (4,), left top right bottom, px."""
    dims_lwh: Array
    """(3,) or (N, 3), metres."""
    yaw_rad: float


def measurements_of(
    camera_index: NDArray[np.int64], xyxy_px: Array, dims_lwh: Array, yaw: Array, sigmas: Sigmas
) -> Measurements:
    """Of N boxes in 2D (N, 4), with sizes (N, 3) and world yaw (N,), no depth, full confidence."""
    n = len(yaw)
    return Measurements(
        camera_index=camera_index,
        xyxy_px=xyxy_px,
        sigma_px=np.broadcast_to(sigmas.px, (n, 4)),
        dims_lwh=dims_lwh,
        sigma_dims=np.broadcast_to(sigmas.dims_lwh, (n, 3)),
        yaw=wrap_angle(yaw),
        sigma_yaw=np.full(n, sigmas.yaw_rad),
        flip_log_odds=np.full(n, 5.0),
        score=np.ones(n),
        cls=np.zeros(n, np.int64),
        depth_m=np.full(n, np.nan),
        sigma_depth_m=np.full(n, np.nan),
    )


def take(measurements: Measurements, index: NDArray[np.int64] | NDArray[np.bool_]) -> Measurements:
    """The measurements at an index or mask."""
    return Measurements(**{f.name: getattr(measurements, f.name)[index] for f in fields(measurements)})


def lift_all(
    method: str, cameras: Sequence[Camera], ground: Ground, measurements: Measurements, settings: LiftSettings | None = None
) -> Boxes:
    """Lift any number of boxes, a batch at a time to bound memory; a box does not depend on its batch."""
    starts = range(0, len(measurements), _CHUNK)
    rows = np.arange(len(measurements))
    parts = [METHODS[method](cameras, ground, take(measurements, rows[s : s + _CHUNK]), settings) for s in starts]
    return Boxes.concatenate(parts)


def lift_with(
    method: str, cameras: Sequence[Camera], ground: Ground, measurements: Measurements, settings: LiftSettings | None = None
) -> tuple[Boxes, BoxProblem | None]:
    """Boxes, and the terms that fusion can solve anew; the paper's method has none."""
    if method == "map":
        return lift_with_terms(cameras, ground, measurements, settings)
    return lift_all(method, cameras, ground, measurements, settings), None


def paired_iou_3d(a: Array, b: Array) -> Array:
    """IoU (N,) of states a and b (N, 7) row by row: x y z l w h yaw."""
    shared = clip_convex_pairs(rectangle_corners(a[:, :2], a[:, 3:5], a[:, 6]), rectangle_corners(b[:, :2], b[:, 3:5], b[:, 6]))
    top = np.minimum(a[:, 2] + a[:, 5] / 2, b[:, 2] + b[:, 5] / 2)
    bottom = np.maximum(a[:, 2] - a[:, 5] / 2, b[:, 2] - b[:, 5] / 2)
    common = shared * np.maximum(top - bottom, 0.0)
    iou: Array = common / (np.prod(a[:, 3:6], axis=1) + np.prod(b[:, 3:6], axis=1) - common)
    return iou


def nees_of(boxes: Boxes, truth: Array) -> Array:
    """Normalised squared errors (N,) of the centres against states (N, 7): mean 3 when the covariances are true."""
    error = boxes.center - truth[:, :3]
    solved = np.linalg.solve(boxes.covariance[:, :3, :3], error[..., None])[..., 0]
    nees: Array = (error * solved).sum(1)
    return nees


def score(boxes: Boxes, truth: Array) -> Row:
    """Centre error, IoU and honesty of boxes against the true states (N, 7), row by row."""
    if len(boxes) == 0:
        return {"boxes": 0}
    error = np.linalg.norm(boxes.center - truth[:, :3], axis=1)
    iou = paired_iou_3d(box_states(boxes), truth)
    nees = nees_of(boxes, truth)
    return {
        "boxes": len(boxes),
        "median_m": round(float(np.median(error)), 3),
        "p90_m": round(float(np.quantile(error, 0.9)), 3),
        "iou_above_05_percent": round(100 * float(np.mean(iou > 0.5)), 1),
        "iou_above_07_percent": round(100 * float(np.mean(iou > 0.7)), 1),
        "nees_median": round(float(np.median(nees)), 2),
        "nees_mean": round(float(np.mean(nees)), 2),
    }
