"""3D boxes of the depth-guided detector: into the world with their covariance, onto the road, together with lifted boxes.

Within one camera a guided and a lifted box of the same vehicle come from the same pixels, so their errors are not independent:
they are combined by covariance intersection, which stays honest whatever the errors share.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from service.association import Index, best_of_duplicates, gated_assignment, mahalanobis_cost
from service.geometry.boxes import STATE_DIM, Boxes, box_states
from service.geometry.camera import Camera
from service.geometry.ground import Ground
from service.geometry.transforms import Array, wrap_angle
from service.nets.guided import GuidedDetections

_STEP_PX = 0.5
"""Half the step of the differences that stand for the derivatives of a viewing ray, px."""
_MIN_SIGMA = np.array([0.25, 0.25, 0.05, 0.02, 0.02, 0.02, 0.01])
_MAX_SIGMA = np.array([100.0, 100.0, 100.0, 10.0, 5.0, 5.0, np.pi])
_WEIGHTS = np.linspace(0.0, 1.0, 21)
"""Weights of the lifted box that covariance intersection tries."""


def world_boxes(camera: Camera, found: GuidedDetections, cls: NDArray[np.int64]) -> Boxes:
    """Boxes in the world, one a detection, with the covariance that their sigmas have through the camera.

    cls: (N,) class indices that the boxes get. The centre lies on the ray through ``center_px`` at ``depth_m``; the yaw is
    alpha about that ray's azimuth, so pixels move both.
    """
    if len(found) == 0:
        return Boxes.empty()
    ray = camera.rays_world(found.center_px)
    slope = np.stack(
        [
            (camera.rays_world(found.center_px + step) - camera.rays_world(found.center_px - step)) / (2 * _STEP_PX)
            for step in _STEP_PX * np.eye(2)
        ],
        -1,
    )
    horizontal = np.maximum((ray[:, :2] ** 2).sum(1), 1e-9)
    jacobian = np.zeros((len(found), STATE_DIM, STATE_DIM))
    jacobian[:, :3, :2] = found.depth_m[:, None, None] * slope
    jacobian[:, :3, 2] = ray
    jacobian[:, [3, 4, 5, 6], [3, 4, 5, 6]] = 1.0
    jacobian[:, 6, :2] = (ray[:, 0, None] * slope[:, 1] - ray[:, 1, None] * slope[:, 0]) / horizontal[:, None]
    scaled = jacobian * np.clip(found.sigma, _MIN_SIGMA, _MAX_SIGMA)[:, None]
    return Boxes(
        center=camera.position_m + ray * found.depth_m[:, None],
        dims_lwh=found.dims_lwh,
        yaw=wrap_angle(found.alpha + np.arctan2(ray[:, 1], ray[:, 0])),
        score=found.score,
        cls=cls,
        covariance=scaled @ scaled.transpose(0, 2, 1),
        flip_log_odds=found.flip_log_odds,
    )


def on_the_road(boxes: Boxes, ground: Ground, camera: Camera, sigma_m: float, sigma_per_m: float) -> Boxes:
    """The boxes given that their bottoms stand on the ground, within ``sigma_m`` plus ``sigma_per_m`` a metre of distance.

    One Kalman update with the tangent plane under each box.
    """
    if len(boxes) == 0:
        return boxes
    normal = ground.normal_at(boxes.center)
    row = np.zeros((len(boxes), STATE_DIM))
    row[:, :3] = normal / normal[:, 2:]
    row[:, 5] = -0.5
    miss = boxes.center[:, 2] - 0.5 * boxes.dims_lwh[:, 2] - ground.height_at(boxes.center)
    noise = (sigma_m + sigma_per_m * np.linalg.norm(boxes.center - camera.position_m, axis=1)) ** 2
    spread = (boxes.covariance @ row[..., None])[..., 0]
    gain = spread / ((spread * row).sum(1) + noise)[:, None]
    state = box_states(boxes) - gain * miss[:, None]
    covariance = boxes.covariance - gain[:, :, None] * spread[:, None]
    return _with_state(boxes, state, 0.5 * (covariance + covariance.transpose(0, 2, 1)))


def suppress_bev(boxes: Boxes, iou: float, distance_m: float) -> Boxes:
    """The best of boxes that overlap in bird's-eye view by more than ``iou`` or lie nearer than ``distance_m``."""
    keeper = best_of_duplicates(boxes, np.zeros(len(boxes), np.int64), iou, distance_m)
    return boxes.take(keeper == np.arange(len(boxes)))


def join(lifted: Boxes, guided: Boxes, gate: float, max_distance_m: float) -> Boxes:
    """One camera's boxes: lifted ones, combined with the guided ones that match them, then the unmatched guided ones."""
    if len(guided) == 0 or len(lifted) == 0:
        return Boxes.concatenate([lifted, guided])
    ours, theirs = _matches(lifted, guided, gate, max_distance_m)
    combined = intersect(lifted.take(ours), guided.take(theirs))
    alone = np.setdiff1d(np.arange(len(guided)), theirs)
    order = np.arange(len(lifted))
    order[ours] = len(lifted) + np.arange(len(ours))
    return Boxes.concatenate([Boxes.concatenate([lifted, combined]).take(order), guided.take(alone)])


def _matches(lifted: Boxes, guided: Boxes, gate: float, max_distance_m: float) -> tuple[Index, Index]:
    distance_sq, cost, distance_m = mahalanobis_cost(
        lifted.center[:, :2] - lifted.center[0, :2],
        lifted.covariance[:, :2, :2],
        guided.center[:, :2] - lifted.center[0, :2],
        guided.covariance[:, :2, :2],
    )
    return gated_assignment(distance_sq, cost, distance_m, gate, max_distance_m)


def intersect(a: Boxes, b: Boxes) -> Boxes:
    """Covariance intersection of N pairs of boxes: information w A + (1 - w) B, w being what makes the place most certain.

    Yaws are axes: b's is turned to a's side, and counts against a's heading where it had to be. Scores: the better of the two,
    for the same pixels are no second witness.
    """
    if len(a) == 0:
        return a
    first: Array = np.asarray(np.linalg.inv(a.covariance), dtype=np.float64)
    second: Array = np.asarray(np.linalg.inv(b.covariance), dtype=np.float64)
    weight = _best_weight(first, second)
    information = weight[:, None, None] * first + (1 - weight)[:, None, None] * second
    covariance = np.linalg.inv(information)
    flipped = np.cos(b.yaw - a.yaw) < 0
    apart = box_states(b) - box_states(a)
    apart[:, 6] = wrap_angle(apart[:, 6] + np.pi * flipped)
    step = (covariance @ ((1 - weight)[:, None, None] * second) @ apart[..., None])[..., 0]
    odds = weight * a.flip_log_odds + (1 - weight) * np.where(flipped, -1.0, 1.0) * b.flip_log_odds
    state = box_states(a) + step
    state[:, 6] += np.where(odds < 0, np.pi, 0.0)
    better = a.score >= b.score
    joined = _with_state(a, state, 0.5 * (covariance + covariance.transpose(0, 2, 1)))
    return replace(
        joined,
        score=np.maximum(a.score, b.score),
        cls=np.where(better, a.cls, b.cls),
        flip_log_odds=np.abs(odds),
    )


def _best_weight(first: Array, second: Array) -> Array:
    """Weights (N,) of information (N, 7, 7) that leave the least area of uncertainty on the road."""
    mixed = _WEIGHTS[:, None, None, None] * first + (1 - _WEIGHTS)[:, None, None, None] * second
    place = np.linalg.inv(mixed)[..., :2, :2]
    area = place[..., 0, 0] * place[..., 1, 1] - place[..., 0, 1] ** 2
    best: Array = _WEIGHTS[area.argmin(0)]
    return best


def _with_state(boxes: Boxes, state: Array, covariance: Array) -> Boxes:
    return replace(
        boxes, center=state[:, :3], dims_lwh=np.maximum(state[:, 3:6], 0.2), yaw=wrap_angle(state[:, 6]), covariance=covariance
    )
