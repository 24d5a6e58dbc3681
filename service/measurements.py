"""What the networks say of a frame set's detections, and the same as lifting wants it: normalised, each over its sigma."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.geometry.boxes import TANGENT_DIRECTIONS
from service.geometry.camera import Camera
from service.geometry.transforms import Array, between, wrap_angle
from service.solver import MAX_DIM_M, MIN_DIM_M

_MIN_SIGMA_PX, _MIN_SIGMA_M, _MIN_SIGMA_RAD = 0.25, 0.01, 0.005
_MAX_SIGMA_PX, _MAX_SIGMA_M, _MAX_SIGMA_RAD = 1e3, 30.0, np.pi
_NOT_READ = np.zeros((0, 0))


@dataclass(frozen=True, eq=False)
class Measurements:
    """What the networks say about the N detections of one frame set, all cameras together."""

    camera_index: NDArray[np.int64]
    """(N,) into the list of cameras."""
    xyxy_px: Array
    """(N, 4) 2D boxes in the pixels of ``cameras[camera_index]``."""
    sigma_px: Array
    """(N, 4) standard deviations of the four edges, px."""
    dims_lwh: Array
    """(N, 3) length, width, height, metres."""
    sigma_dims: Array
    """(N, 3) their standard deviations, metres."""
    yaw: Array
    """(N,) world yaw, radians."""
    sigma_yaw: Array
    """(N,) its standard deviation, radians."""
    flip_log_odds: Array
    """(N,) log-odds that the heading is ``yaw`` rather than ``yaw + pi``; passed on."""
    score: Array
    """(N,) in 0..1; passed on."""
    cls: NDArray[np.int64]
    """(N,) class indices; passed on."""
    depth_m: Array
    """(N,) depth of the visible surface along the optical axis, metres; NaN or not positive: no reading."""
    sigma_depth_m: Array
    """(N,) its standard deviation, metres."""
    tangents_px: Array = field(default_factory=lambda: _NOT_READ)
    """(N, 8) reach of the vehicles in ``TANGENT_DIRECTIONS``, px; (N, 0), the default, where nothing reads them."""
    sigma_tangents_px: Array = field(default_factory=lambda: _NOT_READ)
    """Their standard deviations, px."""

    def __post_init__(self) -> None:
        for name in ("tangents_px", "sigma_tangents_px"):
            if getattr(self, name).shape == _NOT_READ.shape:
                object.__setattr__(self, name, np.zeros((len(self), 0)))

    def __len__(self) -> int:
        return len(self.yaw)


@dataclass(frozen=True, eq=False)
class EdgeMeasurements:
    """Measurements normalised for N boxes: what every way of lifting starts from."""

    R: Array
    """(N, 3, 3) rotation world to camera."""
    t: Array
    """(N, 3) translation world to camera, metres."""
    origin: Array
    """(N, 3) camera centre, world."""
    xyxy_px: Array
    """(N, 4) 2D boxes clipped to their images."""
    hinged: NDArray[np.bool_]
    """(N, 4) edges that the image border cuts."""
    edges: Array
    """(N, 4) left, top, right, bottom, in undistorted normalised coordinates."""
    edge_weight: Array
    """(N, 4) 1 / sigma of the edges."""
    tangents: Array
    """(N, K) reach along ``directions``, normalised coordinates, as if no lens bent them."""
    tangent_weight: Array
    """(N, K) 1 / sigma of the tangents."""
    directions: Array
    """(N, K, 2) unit vectors, normalised coordinates."""
    bottom_ray: Array
    """(N, 3) viewing ray through the middle of the bottom edge, world, of depth 1."""
    center_ray: Array
    """(N, 3) through the 2D box's centre."""
    dims_lwh: Array
    """(N, 3) metres, within sane limits; so the sigmas below."""
    sigma_dims: Array
    """(N, 3) metres."""
    yaw: Array
    """(N,) world, radians in [-pi, pi)."""
    sigma_yaw: Array
    """(N,) radians."""


def edge_measurements(cameras: Sequence[Camera], m: Measurements, rows: slice, border_px: float) -> EdgeMeasurements:
    """A slice of the measurements, normalised: through the lens, into the camera's frame, over their sigmas.

    border_px: an edge this near to the image border is taken as cut by it.
    """
    index = m.camera_index[rows]
    border = np.array([[camera.width - 1.0, camera.height - 1.0] for camera in cameras])[index]
    xyxy = m.xyxy_px[rows]
    low, high = np.minimum(xyxy[:, :2], xyxy[:, 2:]), np.maximum(xyxy[:, :2], xyxy[:, 2:])
    low, high = (np.minimum(np.maximum(end, 0.0), border) for end in (low, high))
    visible = np.concatenate([low, high], 1)
    T = np.array([camera.T_cam_world for camera in cameras])[index]
    K = np.array([camera.K for camera in cameras])[index]
    points = _normalised(cameras, index, K, _middles(visible))
    rays = np.concatenate([points[:, 3:], np.ones_like(points[:, 3:, :1])], -1) @ T[:, :3, :3]
    directions, tangents, tangent_weight = _tangents(K, m.tangents_px[rows], m.sigma_tangents_px[rows])
    return EdgeMeasurements(
        R=T[:, :3, :3],
        t=T[:, :3, 3],
        origin=np.array([camera.position_m for camera in cameras])[index],
        xyxy_px=visible,
        hinged=np.concatenate([low <= border_px, high >= border - border_px], 1),
        edges=points.reshape(-1, 10)[:, [0, 3, 4, 7]],
        edge_weight=K[:, [0, 1, 0, 1], [0, 1, 0, 1]] / between(m.sigma_px[rows], _MIN_SIGMA_PX, _MAX_SIGMA_PX),
        tangents=tangents,
        tangent_weight=tangent_weight,
        directions=directions,
        bottom_ray=rays[:, 0],
        center_ray=rays[:, 1],
        dims_lwh=between(m.dims_lwh[rows], MIN_DIM_M, MAX_DIM_M),
        sigma_dims=between(m.sigma_dims[rows], _MIN_SIGMA_M, _MAX_SIGMA_M),
        yaw=wrap_angle(m.yaw[rows]),
        sigma_yaw=between(m.sigma_yaw[rows], _MIN_SIGMA_RAD, _MAX_SIGMA_RAD),
    )


def _tangents(K: Array, reach_px: Array, sigma_px: Array) -> tuple[Array, Array, Array]:
    """Directions (N, K, 2), reaches (N, K) and weights (N, K) in normalised coordinates; of matrices K (N, 3, 3)."""
    if not reach_px.shape[1]:
        return np.zeros((len(K), 0, 2)), reach_px, sigma_px
    # Pixels are K times normalised points: a direction d in pixels is K' d there, and as long as pixels are many.
    scaled = TANGENT_DIRECTIONS @ K[:, :2, :2]
    length = np.sqrt((scaled * scaled).sum(2))
    reach = (reach_px - K[:, :2, 2] @ TANGENT_DIRECTIONS.T) / length
    return scaled / length[..., None], reach, length / between(sigma_px, _MIN_SIGMA_PX, _MAX_SIGMA_PX)


def _middles(xyxy: Array) -> Array:
    """Middles of the left, top, right and bottom edges and the centre (N, 5, 2) of 2D boxes (N, 4), px."""
    middle = 0.5 * (xyxy[:, :2] + xyxy[:, 2:])
    points = np.repeat(middle[:, None], 5, axis=1)
    points[:, [0, 1, 2, 3], [0, 1, 0, 1]] = xyxy
    return points


def _normalised(cameras: Sequence[Camera], index: NDArray[np.int64], K: Array, pixels: Array) -> Array:
    """Undistorted normalised points of pixels (N, P, 2) in the cameras ``index`` (N,), whose matrices are K (N, 3, 3)."""
    points = np.empty_like(pixels)
    points[..., 1] = (pixels[..., 1] - K[:, 1, 2, None]) / K[:, 1, 1, None]
    points[..., 0] = (pixels[..., 0] - K[:, 0, 2, None] - K[:, 0, 1, None] * points[..., 1]) / K[:, 0, 0, None]
    for number, camera in enumerate(cameras):
        if camera.has_distortion:
            mine = index == number
            points[mine] = camera.normalised_from_pixels(pixels[mine])
    return points
