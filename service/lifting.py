"""Lifting: a 2D box, a size, a yaw (and a depth) become a 3D box with its covariance.

Maximum a posteriori over (x, y, z, l, w, h, yaw), all boxes of a frame set at once. The terms stand in
:mod:`service.residuals`, the solver in :mod:`service.solver`. The inverse Hessian at the solution is the box's covariance: as
honest as the sigmas that came in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from service.geometry.boxes import BORDER_PX, TANGENT_DIRECTIONS, Boxes, box_corners, extents_of, tangents_of
from service.geometry.camera import MIN_DEPTH_M, Camera
from service.geometry.ground import Ground
from service.geometry.transforms import Array, between, transform_points, wrap_angle
from service.measurements import EdgeMeasurements, Measurements, edge_measurements
from service.residuals import FIXED_ROWS, GROUND, BoxProblem
from service.solver import SolverSettings, covariance_of, solve

_MIN_DEPTH_SIGMA_M, _MAX_DEPTH_M = 0.05, 1000.0
_MIN_START_DEPTH_M = 1.0
_LENS_PASSES = 2
_MAX_LENS_MISS = 0.1


@dataclass(frozen=True)
class LiftSettings:
    """Tuning of the lift; the defaults are those of the measured table in the docs."""

    ground_sigma_m: float = 0.05
    """How far a wheel may stand above or below the ground plane, metres (one sigma)."""
    ground_sigma_per_m: float = 0.003
    """What a metre of distance adds to it: roads are not planes, poses not exact."""
    border_px: float = BORDER_PX
    """An edge this near to the image border is taken as cut by it."""
    tail_sigmas: float = 3.0
    """Edges and depths off by this many sigmas count half, and less beyond (Cauchy): occlusion, a depth read off another
    object."""
    ground_tail_sigmas: float = 2.0
    """The same for the ground: real roads leave a plane by more than noise does (measured on KITTI: docs, lifting)."""
    start_sigma_m: float = 50.0
    """Weak pull to the start position; it only keeps boxes finite whose edges are all cut."""
    max_start_depth_m: float = 200.0
    """Starts farther than this (rays near the horizon) are taken from the size instead."""
    solver: SolverSettings = field(default_factory=SolverSettings)


def lift(cameras: Sequence[Camera], ground: Ground, measurements: Measurements, settings: LiftSettings | None = None) -> Boxes:
    """Boxes in the world, one a detection and in their order.

    Finite for any finite input; what cannot be known (all edges cut, box above the horizon) shows in the covariance. A box
    does not depend on the others in the batch.
    """
    return lift_with_terms(cameras, ground, measurements, settings)[0]


def lift_with_terms(
    cameras: Sequence[Camera], ground: Ground, measurements: Measurements, settings: LiftSettings | None = None
) -> tuple[Boxes, BoxProblem | None]:
    """What :func:`lift` gives, and the terms that each box was solved from (None for no box), for fusion."""
    if len(measurements) == 0:
        return Boxes.empty(), None
    settings = settings or LiftSettings()
    seen = edge_measurements(cameras, measurements, slice(None), settings.border_px)
    problem = _problem(ground, seen, measurements, settings)
    bent = np.array([camera.has_distortion for camera in cameras])
    first = _without_tangents(problem, bent[measurements.camera_index]) if bent.any() else problem
    state, hessian = solve(first, problem.prior, settings.solver)
    for _ in range(_LENS_PASSES if bent.any() else 0):
        problem = _straightened(cameras, measurements, seen, state, problem)
        state, hessian = solve(problem, state, settings.solver)
    boxes = Boxes(
        center=state[:, :3],
        dims_lwh=state[:, 3:6],
        yaw=wrap_angle(state[:, 6]),
        score=np.asarray(measurements.score, dtype=np.float64),
        cls=measurements.cls,
        covariance=covariance_of(hessian),
        flip_log_odds=np.asarray(measurements.flip_log_odds, dtype=np.float64),
    )
    return boxes, problem


def _problem(ground: Ground, seen: EdgeMeasurements, m: Measurements, settings: LiftSettings) -> BoxProblem:
    """The measurements whitened, with a start for every box."""
    start, start_depth = _start(ground, seen, settings)
    sigma_ground = settings.ground_sigma_m + settings.ground_sigma_per_m * start_depth
    depth, depth_weight = _depth_readings(m)
    position_sigma = np.full((len(m), 3), settings.start_sigma_m)
    tail = np.full((len(m), FIXED_ROWS + seen.tangents.shape[1]), settings.tail_sigmas)
    tail[:, GROUND] = settings.ground_tail_sigmas
    return BoxProblem(
        R=seen.R,
        t=seen.t,
        origin=seen.origin,
        edges=seen.edges,
        edge_weight=seen.edge_weight,
        hinged=seen.hinged,
        tangents=seen.tangents,
        tangent_weight=seen.tangent_weight,
        directions=seen.directions,
        prior=np.concatenate([start, seen.dims_lwh, seen.yaw[:, None]], 1),
        prior_weight=1.0 / np.concatenate([position_sigma, seen.sigma_dims, seen.sigma_yaw[:, None]], 1),
        ground=ground,
        ground_weight=1.0 / sigma_ground,
        ray=seen.center_ray,
        depth=depth,
        depth_weight=depth_weight,
        tail=tail,
    )


def _depth_readings(m: Measurements) -> tuple[Array, Array]:
    """Depths (N,), metres, and their weights (N,): 0 where there is no reading, or none that can be a depth."""
    usable = np.isfinite(m.sigma_depth_m) & (m.depth_m > 0) & (m.depth_m < _MAX_DEPTH_M)
    sigma = between(np.where(usable, m.sigma_depth_m, 1.0), _MIN_DEPTH_SIGMA_M, _MAX_DEPTH_M)
    return np.where(usable, m.depth_m, 0.0), np.where(usable, 1.0 / sigma, 0.0)


def _without_tangents(problem: BoxProblem, bent: NDArray[np.bool_]) -> BoxProblem:
    """The problem without the tangents of the boxes at a mask (N,): where a lens bends them it is not known yet."""
    return replace(problem, tangent_weight=np.where(bent[:, None], 0.0, problem.tangent_weight))


def _straightened(
    cameras: Sequence[Camera], m: Measurements, seen: EdgeMeasurements, state: Array, problem: BoxProblem
) -> BoxProblem:
    """With edges and tangents for a pinhole that miss the boxes at ``state`` as the readings do through the real lens.

    A lens bends straight edges, so an edge's middle undistorted is not where the box touches it; misses are.
    """
    edges, tangents, weight = problem.edges.copy(), seen.tangents.copy(), seen.tangent_weight.copy()
    for number in np.unique(m.camera_index):
        mine = np.flatnonzero(m.camera_index == number)
        camera = cameras[number]
        corners = transform_points(camera.T_cam_world, box_corners(state[mine, :3], state[mine, 3:6], state[mine, 6]))
        image = corners[..., :2] / np.maximum(corners[..., 2:], MIN_DEPTH_M)
        pixels = camera.pixels_from_normalised(image)
        miss = seen.xyxy_px[mine] - extents_of(pixels)
        focal = camera.K[[0, 1, 0, 1], [0, 1, 0, 1]]
        straight = extents_of(image) + miss / focal
        # Far from its edge, or past the border, a box may lie where the lens model means nothing.
        trusted = ~problem.hinged[mine] & (np.abs(miss) < _MAX_LENS_MISS * focal)
        edges[mine] = np.where(trusted, straight, edges[mine])
        if camera.has_distortion and tangents.shape[1]:
            reach = (image @ seen.directions[mine].transpose(0, 2, 1)).max(1)
            beyond = m.tangents_px[mine] - tangents_of(pixels)
            near = np.abs(beyond) < _MAX_LENS_MISS * camera.K[0, 0]
            tangents[mine] = reach + beyond / np.sqrt(((TANGENT_DIRECTIONS @ camera.K[:2, :2]) ** 2).sum(1))
            weight[mine] = np.where(near, weight[mine], 0.0)
    return replace(problem, edges=edges, tangents=tangents, tangent_weight=weight)


def _start(ground: Ground, seen: EdgeMeasurements, settings: LiftSettings) -> tuple[Array, Array]:
    """Start centres (N, 3) and their depths (N,): the bottom edge on the ground, else the size at the seen height."""
    down, dims = seen.bottom_ray, seen.dims_lwh
    contact = ground.intersect(seen.origin, down)
    # The rays have depth 1 along the optical axis, the third row of R.
    on_ground = (seen.R[:, 2] * (contact - seen.origin)).sum(1)
    limit = settings.max_start_depth_m
    height = seen.edges[:, 3] - seen.edges[:, 1]
    by_size = dims[:, 2] / np.minimum(np.maximum(height, dims[:, 2] / limit), dims[:, 2] / _MIN_START_DEPTH_M)
    # False for NaN, too.
    usable = (on_ground > _MIN_START_DEPTH_M) & (on_ground < limit)
    # The bottom edge belongs to the nearest part of the box: its centre lies half a footprint farther on.
    azimuth = np.arctan2(down[:, 1], down[:, 0])
    turn = seen.yaw - azimuth
    reach = 0.5 * (dims[:, 0] * np.abs(np.cos(turn)) + dims[:, 1] * np.abs(np.sin(turn)))
    offset = np.stack([reach * np.cos(azimuth), reach * np.sin(azimuth), 0.5 * dims[:, 2]], 1)
    start = np.where(usable[:, None], contact + offset, seen.origin + seen.center_ray * by_size[:, None])
    return start, np.where(usable, on_ground, by_size)
