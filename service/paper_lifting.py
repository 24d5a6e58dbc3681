"""The paper's lift (method ``paper``, eq. 1): four box edges, a size and a yaw fix the translation by linear least squares.

Each edge of the 2D box is touched by one corner of the 3D box. For a camera with pitch 1024 assignments are possible: any
of the eight corners at the left and right edge, any of the upper four at the top, of the lower four at the bottom. The
matrix of the equations does not depend on the assignment, so one pseudo-inverse a box serves all. The assignment is chosen
by reprojection (the algebraic residual picks wrong ones), and edges that the image border cuts are left out. The paper's
method knows neither the ground nor a depth.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from service.geometry.boxes import CORNER_SIGNS, STATE_DIM, Boxes
from service.geometry.camera import MIN_DEPTH_M, Camera
from service.geometry.ground import Ground
from service.geometry.transforms import Array, wrap_angle
from service.lifting import LiftSettings
from service.measurements import EdgeMeasurements, Measurements, edge_measurements
from service.residuals import box_axes

_SIDES, _TOP, _BOTTOM = np.arange(8), np.arange(4, 8), np.arange(4)
CONFIGURATIONS = np.stack(np.meshgrid(_SIDES, _TOP, _SIDES, _BOTTOM, indexing="ij"), -1).reshape(-1, 4)
"""(1024, 4) corners, in the order of ``CORNER_SIGNS``, at the left, top, right and bottom edge."""

_BATCH = 32
_MAX_MISFIT = 1e6
_RANK_TOLERANCE = 1e-6
_IMAGE_AXIS = np.array([0, 1, 0, 1])


def lift_paper(
    cameras: Sequence[Camera], ground: Ground, measurements: Measurements, settings: LiftSettings | None = None
) -> Boxes:
    """Boxes in the world, one a detection and in their order, by the paper's linear solve.

    Takes what :func:`service.lifting.lift` takes, so that either can stand for the other; ``ground`` and depths are not
    used. The covariance is the first-order one of edges, size and yaw, plus the spread of the assignments that reproject
    as well, plus ``start_sigma_m`` along directions that the visible edges leave open.
    """
    settings = settings or LiftSettings()
    starts = range(0, len(measurements), _BATCH)
    parts = [_lift_batch(cameras, measurements, slice(s, s + _BATCH), settings) for s in starts]
    if not parts:
        return Boxes.empty()
    state = np.concatenate([part[0] for part in parts])
    return Boxes(
        center=state[:, :3],
        dims_lwh=state[:, 3:6],
        yaw=wrap_angle(state[:, 6]),
        score=np.asarray(measurements.score, dtype=np.float64),
        cls=measurements.cls,
        covariance=np.concatenate([part[1] for part in parts]),
        flip_log_odds=np.asarray(measurements.flip_log_odds, dtype=np.float64),
    )


def _lift_batch(cameras: Sequence[Camera], m: Measurements, rows: slice, settings: LiftSettings) -> tuple[Array, Array]:
    """States (n, 7) and covariances (n, 7, 7) of a slice of the measurements; the batch bounds the memory."""
    seen = edge_measurements(cameras, m, rows, settings.border_px)
    half = 0.5 * seen.dims_lwh
    # World axes of the box times its half size, in the camera's frame: rows are length, width, height.
    half_axes = (box_axes(seen.yaw) * half[..., None]) @ seen.R.transpose(0, 2, 1)
    corners = CORNER_SIGNS @ half_axes
    equations = np.zeros((len(half), 4, 3))
    equations[:, np.arange(4), _IMAGE_AXIS] = 1.0
    equations[..., 2] = -seen.edges
    visible = ~seen.hinged
    inverse = np.asarray(np.linalg.pinv(equations * visible[..., None], rcond=_RANK_TOLERANCE), dtype=np.float64)
    # One right-hand side an edge and corner; a translation is the sum of one of each edge.
    right = -np.einsum("nek,nck->nec", equations, corners)
    parts = inverse.transpose(0, 2, 1)[:, :, None] * (right * visible[..., None])[..., None]
    translations = sum(parts[:, edge, CONFIGURATIONS[:, edge]] for edge in range(4))
    cost = _reprojection_cost(translations, corners, seen.edges, np.where(visible, seen.edge_weight, 0.0))
    best = cost.argmin(1)
    n = np.arange(len(best))
    chosen = CONFIGURATIONS[best]
    translation = translations[n, best]
    covariance = _covariance(seen, inverse, equations, translation, corners, chosen, settings)
    # Assignments that reproject nearly as well are nearly as likely: their spread is what the choice leaves open.
    likelihood = np.exp(-0.5 * np.minimum(cost - cost[n, best][:, None], _MAX_MISFIT))
    apart = (translations - translation[:, None]) @ seen.R
    spread = np.einsum("nk,nki,nkj->nij", likelihood / likelihood.sum(1, keepdims=True), apart, apart, optimize=True)
    covariance[:, :3, :3] += np.where(np.isfinite(spread), spread, 0.0)
    center = ((translation - seen.t)[:, None] @ seen.R)[:, 0]
    return np.concatenate([center, seen.dims_lwh, seen.yaw[:, None]], 1), covariance


def _reprojection_cost(translations: Array, corners: Array, edges: Array, weight: Array) -> Array:
    """Squared misses (n, 1024), in sigmas, of the visible edges when the box is projected from each translation."""
    depth = translations[..., 2:] + corners[:, None, :, 2]
    in_front = depth.min(-1) > MIN_DEPTH_M
    np.maximum(depth, MIN_DEPTH_M, out=depth)
    cost = np.zeros(translations.shape[:2])
    for axis in (0, 1):
        image = (translations[..., axis, None] + corners[:, None, :, axis]) / depth
        cost += ((image.min(-1) - edges[:, axis, None]) * weight[:, axis, None]) ** 2
        cost += ((image.max(-1) - edges[:, axis + 2, None]) * weight[:, axis + 2, None]) ** 2
    return np.where(in_front, cost, cost + _MAX_MISFIT)


def _covariance(
    seen: EdgeMeasurements,
    inverse: Array,
    equations: Array,
    translation: Array,
    corners: Array,
    chosen: NDArray[np.int64],
    settings: LiftSettings,
) -> Array:
    """First-order covariances (n, 7, 7) of the least-squares translation and of the size and yaw it was given."""
    n = np.arange(len(chosen))[:, None]
    depth = np.maximum(translation[:, 2:] + corners[n, chosen, 2], MIN_DEPTH_M)
    over_axes = (equations @ seen.R) @ box_axes(seen.yaw).transpose(0, 2, 1)
    signs = CORNER_SIGNS[chosen]
    reach = 0.5 * signs * seen.dims_lwh[:, None]
    # How the right-hand sides move with edges, size and yaw.
    over_inputs = np.zeros((len(chosen), 4, 8))
    over_inputs[:, np.arange(4), np.arange(4)] = depth
    over_inputs[..., 4:7] = -0.5 * signs * over_axes
    over_inputs[..., 7] = -(reach[..., 0] * over_axes[..., 1] - reach[..., 1] * over_axes[..., 0])
    over_inputs *= (~seen.hinged)[..., None]
    jacobian = np.zeros((len(chosen), STATE_DIM, 8))
    jacobian[:, :3] = seen.R.transpose(0, 2, 1) @ inverse @ over_inputs
    jacobian[:, [3, 4, 5, 6], [4, 5, 6, 7]] = 1.0
    sigma = np.concatenate([1.0 / seen.edge_weight, seen.sigma_dims, seen.sigma_yaw[:, None]], 1)
    scaled = jacobian * sigma[:, None]
    covariance = scaled @ scaled.transpose(0, 2, 1)
    open_cam = np.eye(3) - inverse @ (equations * (~seen.hinged)[..., None])
    covariance[:, :3, :3] += settings.start_sigma_m**2 * seen.R.transpose(0, 2, 1) @ open_cam @ seen.R
    covariance[:, np.arange(STATE_DIM), np.arange(STATE_DIM)] += 1e-6
    symmetric: Array = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    return symmetric
