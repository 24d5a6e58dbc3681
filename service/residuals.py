"""What a lifted box must satisfy: residuals with analytic Jacobians, for N boxes at once (docs: lifting).

State (N, 7): x y z l w h yaw, world frame. Everything is whitened, so a residual of 1 is one sigma. The image is handled in
undistorted normalised coordinates (x/z, y/z); distances there are pixels over the focal length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.geometry.boxes import CORNER_SIGNS, STATE_DIM
from service.geometry.camera import MIN_DEPTH_M
from service.geometry.ground import Ground
from service.geometry.transforms import Array, wrap_angle

EDGES, GROUND, DEPTH = slice(0, 4), 4, 5
"""Rows of the residual: left, top, right, bottom; bottom face on the ground; visible surface at the read depth."""

ROWS = 6
_EDGE_AXIS = np.array([0, 1, 0, 1])
_FAR_PARALLEL = 1e-9
_TINY = 1e-30
_SIGNS_T = np.ascontiguousarray(CORNER_SIGNS.T)
_HALF_SIGNS = 0.5 * CORNER_SIGNS
_OUTWARD = np.array([-1.0, -1.0, 1.0, 1.0])
_DIAGONAL = np.arange(STATE_DIM)
_PER_BOX = (
    *("R", "t", "origin", "edges", "edge_weight", "hinged", "prior", "prior_weight"),
    *("ground_weight", "ray", "depth", "depth_weight"),
)


@dataclass(frozen=True, eq=False)
class BoxProblem:
    """The measurements of N boxes, whitened and gathered a box at a time."""

    R: Array
    """(N, 3, 3) rotation world to camera."""
    t: Array
    """(N, 3) translation world to camera, metres."""
    origin: Array
    """(N, 3) camera centre, world."""
    edges: Array
    """(N, 4) left, top, right, bottom of the 2D boxes, normalised coordinates."""
    edge_weight: Array
    """(N, 4) 1 / sigma of the edges."""
    hinged: NDArray[np.bool_]
    """(N, 4) edges cut by the image border: the box must reach them and may go past."""
    prior: Array
    """(N, 7) start position, predicted size, predicted yaw."""
    prior_weight: Array
    """(N, 7) 1 / sigma of the prior."""
    ground: Ground
    """The road, world."""
    ground_weight: Array
    """(N,) 1 / sigma, 1/m."""
    ray: Array
    """(N, 3) viewing ray through the 2D box's centre, world, of depth 1 along the optical axis."""
    depth: Array
    """(N,) depth of the visible surface along the optical axis, metres; any number where the weight is 0."""
    depth_weight: Array
    """(N,) 1 / sigma, 1/m; 0 where there is no reading."""
    huber: Array
    """(6,) residual (sigmas) from which a row counts linearly."""

    def take(self, index: NDArray[np.bool_]) -> BoxProblem:
        """The boxes at a mask (N,)."""
        return replace(self, **{name: getattr(self, name)[index] for name in _PER_BOX})


class NormalEquations(NamedTuple):
    """Cost (N,), gradient (N, 7) and Gauss-Newton Hessian (N, 7, 7) of N boxes."""

    cost: Array
    gradient: Array
    hessian: Array


def box_axes(yaw: Array) -> Array:
    """World directions (N, 3, 3) of the boxes' length, width and height, one a row."""
    axes = np.zeros((len(yaw), 3, 3))
    axes[:, 0, 0] = axes[:, 1, 1] = np.cos(yaw)
    axes[:, 0, 1] = np.sin(yaw)
    axes[:, 1, 0] = -axes[:, 0, 1]
    axes[:, 2, 2] = 1.0
    return axes


def normal_equations(problem: BoxProblem, state: Array) -> NormalEquations:
    """Cost, gradient and Hessian at states (N, 7): Huber on the rows, squares on the prior."""
    residual, jacobian = residuals(problem, state)
    magnitude = np.abs(residual)
    inner = np.minimum(magnitude, problem.huber)
    robust = np.maximum(inner, _TINY) / np.maximum(magnitude, _TINY)
    offset = state - problem.prior
    offset[:, 6] = wrap_angle(offset[:, 6])
    information = problem.prior_weight * problem.prior_weight
    pull = offset * information
    weighted_t = (jacobian * robust[..., None]).transpose(0, 2, 1)
    hessian = weighted_t @ jacobian
    hessian[:, _DIAGONAL, _DIAGONAL] += information
    gradient = (weighted_t @ residual[..., None])[..., 0] + pull
    cost = (inner * (magnitude - 0.5 * inner)).sum(1) + 0.5 * (offset * pull).sum(1)
    return NormalEquations(cost, gradient, hessian)


def residuals(problem: BoxProblem, state: Array) -> tuple[Array, Array]:
    """Whitened residuals (N, 6) and Jacobians (N, 6, 7) of everything but the prior, at states (N, 7)."""
    residual = np.empty((len(state), ROWS))
    jacobian = np.zeros((len(state), ROWS, STATE_DIM))
    axes = box_axes(state[:, 6])
    _edge_rows(problem, state, axes, residual, jacobian)
    _ground_row(problem, state, residual, jacobian)
    if np.any(problem.depth_weight):
        _depth_row(problem, state, axes, residual, jacobian)
    else:
        residual[:, DEPTH] = 0.0
    return residual, jacobian


def _edge_rows(problem: BoxProblem, state: Array, axes: Array, residual: Array, jacobian: Array) -> None:
    """Each edge against the corner that makes it at this state (the active corner)."""
    half = 0.5 * state[:, 3:6]
    R = problem.R
    center_cam = (R @ state[:, :3, None])[..., 0] + problem.t
    # Corners (N, 3, 8): coordinate by coordinate, so that extremes are sought along contiguous memory.
    corners = (R @ (axes * half[..., None]).transpose(0, 2, 1)) @ _SIGNS_T + center_cam[..., None]
    depth = np.maximum(corners[:, 2], MIN_DEPTH_M)
    image = corners[:, :2] / depth[:, None]
    active = np.concatenate([image.argmin(2), image.argmax(2)], 1)
    rows = np.arange(len(state))[:, None]
    seen = image[rows, _EDGE_AXIS, active]
    miss = seen - problem.edges
    # A cut edge is content when the box goes past it: below it at the left and top, above it at the right and bottom.
    weight = np.where(problem.hinged & (miss * _OUTWARD > 0), 0.0, problem.edge_weight)
    # The image coordinate's gradient over the corner's world position, then chained through size and yaw.
    scale = weight / depth[rows, active]
    over_corner = R[:, _EDGE_AXIS] * scale[..., None] - (seen * scale)[..., None] * R[:, 2:]
    over_axes = over_corner @ axes.transpose(0, 2, 1)
    signs = _HALF_SIGNS[active]
    residual[:, EDGES] = miss * weight
    jacobian[:, EDGES, :3] = over_corner
    jacobian[:, EDGES, 3:6] = signs * over_axes
    reach = signs[..., :2] * state[:, None, 3:5]
    jacobian[:, EDGES, 6] = reach[..., 0] * over_axes[..., 1] - reach[..., 1] * over_axes[..., 0]


def _ground_row(problem: BoxProblem, state: Array, residual: Array, jacobian: Array) -> None:
    """Centre of the bottom face on the ground, or on its tangent plane below the box where the ground is a grid."""
    normal, offset = problem.ground.tangent_at(state[:, :2])
    weight = problem.ground_weight
    gap = (state[:, :3] * normal).sum(1) - 0.5 * normal[..., 2] * state[:, 5] - offset
    residual[:, GROUND] = gap * weight
    jacobian[:, GROUND, :3] = normal * weight[:, None]
    jacobian[:, GROUND, 5] = -0.5 * normal[..., 2] * weight


def _depth_row(problem: BoxProblem, state: Array, axes: Array, residual: Array, jacobian: Array) -> None:
    """Depth at which the ray through the 2D box's centre enters the 3D box; of the box's centre if the ray misses it."""
    rows = np.arange(len(state))
    half = 0.5 * state[:, 3:6]
    to_center = state[:, :3] - problem.origin
    along = (axes @ problem.ray[..., None])[..., 0]
    parallel = np.abs(along) < _FAR_PARALLEL
    speed = np.where(parallel, 1.0, along)
    facing = np.sign(speed)
    to_center_box = (axes @ to_center[..., None])[..., 0]
    enter = np.where(parallel, -np.inf, (to_center_box - facing * half) / speed)
    leave = np.where(parallel, np.inf, (to_center_box + facing * half) / speed)
    face = enter.argmax(1)
    first = enter[rows, face]
    hit = (first <= leave.min(1)) & (first > 0)
    normal, rate = axes[rows, face], speed[rows, face]
    # d(normal)/d(yaw): the length axis turns into the width axis, that one into the opposite of the length axis.
    turned = np.stack([axes[:, 1], -axes[:, 0], np.zeros_like(axes[:, 0])], 1)[rows, face]
    over_center = np.where(hit[:, None], normal / rate[:, None], problem.R[:, 2])
    surface = np.where(hit, first, (problem.R[:, 2] * to_center).sum(1))
    over_yaw = (turned * (to_center - first[:, None] * problem.ray)).sum(1) / rate
    weight = problem.depth_weight
    residual[:, DEPTH] = np.where(weight > 0, (surface - problem.depth) * weight, 0.0)
    jacobian[:, DEPTH, :3] = over_center * weight[:, None]
    jacobian[rows, DEPTH, 3 + face] = np.where(hit, -0.5 * facing[rows, face] / rate, 0.0) * weight
    jacobian[:, DEPTH, 6] = np.where(hit, over_yaw, 0.0) * weight
