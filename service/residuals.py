"""What a lifted box must satisfy: residuals with analytic Jacobians, for N boxes at once (docs: lifting).

State (N, 7): x y z l w h yaw, world frame. Everything is whitened, so a residual of 1 is one sigma. The image is handled in
undistorted normalised coordinates (x/z, y/z); distances there are pixels over the focal length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.geometry.boxes import CORNER_SIGNS, STATE_DIM
from service.geometry.camera import MIN_DEPTH_M
from service.geometry.ground import Ground
from service.geometry.transforms import Array, inverse_2x2

GROUND, DEPTH, EDGES, OUTLINE = 0, 1, slice(2, 6), slice(2, None)
"""Rows of the residual: bottom face on the ground; visible surface at the read depth; left, top, right, bottom; and these with
the tangents after them."""

FIXED_ROWS = 6
"""Rows before the tangents."""
_EDGE_START = np.array([0, 8, 0, 8])
_FAR_PARALLEL = 1e-9
_SIGNS_T = np.ascontiguousarray(CORNER_SIGNS.T)
_HALF_SIGNS = 0.5 * CORNER_SIGNS
_OUTWARD = np.array([-1.0, -1.0, 1.0, 1.0])
_DIAGONAL = np.arange(STATE_DIM)
_PER_BOX = (
    *(
        "R",
        "t",
        "origin",
        "edges",
        "edge_weight",
        "hinged",
        "tangents",
        "tangent_weight",
        "directions",
        "prior",
        "prior_weight",
    ),
    *("ground_weight", "ray", "depth", "depth_weight", "tail"),
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
    tangents: Array
    """(N, K) reach of the vehicle along ``directions``, normalised coordinates; K may be 0."""
    tangent_weight: Array
    """(N, K) 1 / sigma of the tangents; 0 where there is none."""
    directions: Array
    """(N, K, 2) unit vectors of the tangents, normalised coordinates."""
    prior: Array
    """(N, 7) start position, predicted size, predicted yaw; states are compared with it as they are, so yaw is not wrapped."""
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
    tail: Array
    """(N, 6 + K) residual (sigmas) at which a row counts half: the scale of a Cauchy distribution."""
    shift_sigma: Array | None = None
    """(N,) how far, normalised, the whole picture may be shifted along each axis, one sigma: all edges and tangents move
    together. None: not at all."""

    @staticmethod
    def concatenate(parts: Sequence[BoxProblem]) -> BoxProblem:
        """The boxes of one or more problems on the same ground, in order, before any picture may be shifted."""
        return BoxProblem(
            **{name: np.concatenate([getattr(part, name) for part in parts]) for name in _PER_BOX}, ground=parts[0].ground
        )

    def take(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> BoxProblem:
        """The boxes at an index or mask."""
        # Rows by number and ``take`` are several times quicker than a mask.
        rows = np.flatnonzero(index) if index.dtype == np.bool_ else index
        shift = None if self.shift_sigma is None else self.shift_sigma[rows]
        return BoxProblem(
            **{name: getattr(self, name).take(rows, 0) for name in _PER_BOX}, ground=self.ground, shift_sigma=shift
        )

    def normal_equations(self, state: Array) -> NormalEquations:
        """Of every box at its state (N, 7)."""
        return normal_equations(self, state)


class NormalEquations(NamedTuple):
    """Cost (N,), gradient (N, 7) and Gauss-Newton Hessian (N, 7, 7) of N boxes."""

    cost: Array
    gradient: Array
    hessian: Array


def box_axes(yaw: Array) -> Array:
    """World directions (N, 3, 3) of the boxes' length, width and height, one a row."""
    axes = np.zeros((len(yaw), 3, 3))
    axes[:, 0, 0] = axes[:, 1, 1] = np.cos(yaw)
    sine = np.sin(yaw)
    axes[:, 0, 1], axes[:, 1, 0] = sine, -sine
    axes[:, 2, 2] = 1.0
    return axes


def normal_equations(problem: BoxProblem, state: Array) -> NormalEquations:
    """Cost, gradient and Hessian at states (N, 7): Cauchy on the rows, squares on the prior."""
    rows, weight = _whitened(problem, state)
    residual, jacobian = rows[..., STATE_DIM], rows[..., :STATE_DIM]
    scale = problem.tail * problem.tail
    beyond = residual * residual / scale
    robust = 1.0 / (1.0 + beyond)
    weighted_t = (jacobian * robust[..., None]).transpose(0, 2, 1)
    cost = 0.5 * (scale * np.log1p(beyond)).sum(1)
    if problem.shift_sigma is not None:
        cost -= _free_shift(problem, weight, robust, residual, weighted_t)
    # One product gives the Hessian and, from the residual's column, the gradient.
    equations = weighted_t @ rows
    hessian, gradient = equations[..., :STATE_DIM], equations[..., STATE_DIM]
    offset = state - problem.prior
    information = problem.prior_weight * problem.prior_weight
    pull = offset * information
    hessian[:, _DIAGONAL, _DIAGONAL] += information
    gradient += pull
    cost += 0.5 * (offset * pull).sum(1)
    return NormalEquations(cost, gradient, hessian)


def residuals(problem: BoxProblem, state: Array) -> tuple[Array, Array]:
    """Whitened residuals (N, 6 + K) and Jacobians (N, 6 + K, 7) of everything but the prior, at states (N, 7)."""
    rows, _ = _whitened(problem, state)
    return rows[..., STATE_DIM], rows[..., :STATE_DIM]


def _whitened(problem: BoxProblem, state: Array) -> tuple[Array, Array]:
    """Rows (N, 6 + K, 8), Jacobian and residual side by side, and the weights (N, 4 + K) at which the outline counts."""
    rows = np.zeros((len(state), FIXED_ROWS + problem.tangents.shape[1], STATE_DIM + 1))
    axes = box_axes(state[:, 6])
    weight = _outline_rows(problem, state, axes, rows)
    _ground_row(problem, state, rows)
    if problem.depth_weight.any():
        _depth_row(problem, state, axes, rows)
    return rows, weight


def _free_shift(problem: BoxProblem, weight: Array, robust: Array, residual: Array, weighted_t: Array) -> Array:
    """Let each picture shift by its ``shift_sigma``: takes from ``weighted_t`` (N, 7, 6 + K), in place, what a shift explains.

    ``weight`` (N, 4 + K): how much the residuals of the outline change with it. Returns what the cost (N,) loses by the best
    shift. With S (4 + K, 2), the change of the residuals with a shift, W becomes W - W S (1 / sigma^2 + S' W S)^-1 S' W.
    """
    assert problem.shift_sigma is not None
    moved = np.zeros((*weight.shape, 2))
    moved[:, [0, 2], 0], moved[:, [1, 3], 1] = weight[:, [0, 2]], weight[:, [1, 3]]
    moved[:, 4:] = problem.directions * weight[:, 4:, None]
    pulled = moved * robust[:, OUTLINE, None]
    information = pulled.transpose(0, 2, 1) @ moved
    information[:, [0, 1], [0, 1]] += (1.0 / (problem.shift_sigma * problem.shift_sigma))[:, None]
    scale = inverse_2x2(information)
    miss = (residual[:, None, OUTLINE] @ pulled)[:, 0]
    outline = weighted_t[..., OUTLINE]
    outline -= outline @ moved @ scale @ pulled.transpose(0, 2, 1)
    explained: Array = 0.5 * ((miss[:, None] @ scale)[:, 0] * miss).sum(1)
    return explained


def _outline_rows(problem: BoxProblem, state: Array, axes: Array, rows: Array) -> Array:
    """Edges and tangents against the corner that each touches at this state (the active corner); returns weights (N, 4 + K)."""
    count, R = len(state), problem.R
    # World axes and box axes, one a column, in the camera's frame.
    columns = np.concatenate([R, R @ axes.transpose(0, 2, 1)], 2)
    half_axes = columns[..., 3:] * (0.5 * state[:, None, 3:6])
    center_cam = (R @ state[:, :3, None])[..., 0] + problem.t
    # Corners (N, 3, 8): coordinate by coordinate, so that extremes are sought along contiguous memory.
    corners = (half_axes.reshape(-1, 3) @ _SIGNS_T).reshape(count, 3, 8) + center_cam[..., None]
    depth = np.maximum(corners[:, 2], MIN_DEPTH_M)
    image = corners[:, :2] / depth[:, None]
    active = np.concatenate([image.argmin(2), image.argmax(2)], 1)
    box = np.arange(0, 8 * count, 8)[:, None]
    seen = image.ravel().take(active + 2 * box + _EDGE_START)
    miss = seen - problem.edges
    weight = problem.edge_weight
    if problem.hinged.any():
        # A cut edge is content when the box goes past it: below it at the left and top, above it at the right and bottom.
        weight = np.where(problem.hinged & (miss * _OUTWARD > 0), 0.0, weight)
    tangents = problem.tangents.shape[1]
    if tangents:
        reach = problem.directions @ image
        touching = reach.argmax(2)
        reached = reach.ravel().take(touching + 8 * np.arange(count * tangents).reshape(count, tangents))
        active, seen = np.concatenate([active, touching], 1), np.concatenate([seen, reached], 1)
        miss = np.concatenate([miss, reached - problem.tangents], 1)
        weight = np.concatenate([weight, problem.tangent_weight], 1)
    # The image coordinate's gradient over the corner's position in the camera's frame, then over world and box axes.
    over_corner = np.zeros((count, 4 + tangents, 3))
    scale = weight / depth.ravel().take(active + box)
    over_corner[:, 0:4:2, 0], over_corner[:, 1:4:2, 1] = scale[:, 0:4:2], scale[:, 1:4:2]
    over_corner[:, 4:, :2] = problem.directions * scale[:, 4:, None]
    over_corner[..., 2] = -seen * scale
    over = over_corner @ columns
    signs = _HALF_SIGNS.take(active, 0)
    outline = rows[:, OUTLINE]
    outline[..., :3] = over[..., :3]
    outline[..., 3:6] = signs * over[..., 3:]
    lever = signs[..., :2] * state[:, None, 3:5]
    outline[..., 6] = lever[..., 0] * over[..., 4] - lever[..., 1] * over[..., 3]
    outline[..., 7] = miss * weight
    return weight


def _ground_row(problem: BoxProblem, state: Array, rows: Array) -> None:
    """Centre of the bottom face on the ground, or on its tangent plane below the box where the ground is a grid."""
    normal, offset = problem.ground.tangent_at(state[:, :2])
    weight = problem.ground_weight
    gap = (state[:, :3] * normal).sum(1) - 0.5 * normal[..., 2] * state[:, 5] - offset
    rows[:, GROUND, :3] = normal * weight[:, None]
    rows[:, GROUND, 5] = -0.5 * normal[..., 2] * weight
    rows[:, GROUND, 7] = gap * weight


def _depth_row(problem: BoxProblem, state: Array, axes: Array, rows: Array) -> None:
    """Depth at which the ray through the 2D box's centre enters the 3D box; of the box's centre if the ray misses it."""
    box = np.arange(len(state))
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
    first = enter[box, face]
    hit = (first <= leave.min(1)) & (first > 0)
    normal, rate = axes[box, face], speed[box, face]
    # d(normal)/d(yaw): the length axis turns into the width axis, that one into the opposite of the length axis.
    turned = np.stack([axes[:, 1], -axes[:, 0], np.zeros_like(axes[:, 0])], 1)[box, face]
    over_center = np.where(hit[:, None], normal / rate[:, None], problem.R[:, 2])
    surface = np.where(hit, first, (problem.R[:, 2] * to_center).sum(1))
    over_yaw = (turned * (to_center - first[:, None] * problem.ray)).sum(1) / rate
    weight = problem.depth_weight
    rows[:, DEPTH, :3] = over_center * weight[:, None]
    rows[box, DEPTH, 3 + face] = np.where(hit, -0.5 * facing[box, face] / rate, 0.0) * weight
    rows[:, DEPTH, 6] = np.where(hit, over_yaw, 0.0) * weight
    rows[:, DEPTH, 7] = np.where(weight > 0, (surface - problem.depth) * weight, 0.0)
