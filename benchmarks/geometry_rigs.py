"""Lifting and fusion on simulated rigs: cameras on poles, cars 10 to 40 m away, Gaussian noise, nothing hidden.

The set-up of the project's tables (docs: lifting): f = 642 px, sigmas 2 px, (.20, .06, .06) m in length, width, height, 4
degrees, 5 cm of ground, 8 % of depth.
"""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from benchmarks.geometry_scores import Row, Sigmas, lift_all, lift_with, measurements_of, score
from service.fusion import FusionSettings, fuse
from service.geometry.boxes import Boxes, project_extents
from service.geometry.camera import Camera
from service.geometry.ground import GroundPlane
from service.geometry.transforms import Array, pole_camera_pose, rigid, rotation_z
from service.lifting import LiftSettings
from service.measurements import Measurements
from service.residuals import BoxProblem

K = np.array([[642.0, 0.0, 641.5], [0.0, 642.0, 191.5], [0.0, 0.0, 1.0]])
WIDTH, HEIGHT = 1284, 384
SIGMAS = Sigmas(np.array(2.0), np.array([0.20, 0.06, 0.06]), float(np.deg2rad(4.0)))
GROUND_SIGMA_M, DEPTH_SIGMA = 0.05, 0.08
MARGIN_PX = 8.0
CARS = 2000
TRUE_GROUND = LiftSettings(ground_sigma_m=GROUND_SIGMA_M, ground_sigma_per_m=0.0)
NO_GROUND = LiftSettings(ground_sigma_m=1e3)
LIFT_RIGS = {"5 m, pitch 10 deg": (5.0, 10.0), "1.65 m, level": (1.65, 0.0)}
FUSION_CAMERAS, FUSION_DISTANCE_M, FUSION_PITCH_RAD = 4, 25.0, float(np.deg2rad(11.0))
CALIBRATION_RAD = float(np.deg2rad(0.3))
EXACT = FusionSettings(calibration_sigma_m=0.0, calibration_sigma_rad=0.0)
INEXACT = FusionSettings(calibration_sigma_m=0.0, calibration_sigma_rad=CALIBRATION_RAD)


def _camera(name: str, xy: tuple[float, float], heading: float, height: float, pitch: float) -> Camera:
    return Camera(name, WIDTH, HEIGHT, K, pole_camera_pose([*xy, height], heading, pitch))


def _cars(count: int, xy: Array, rng: np.random.Generator) -> Array:
    """States (count, 7) of cars at positions (count, 2), at every yaw, a wheel's breadth off the ground."""
    dims = np.array([4.3, 1.8, 1.55]) + rng.normal(size=(count, 3)) * [0.4, 0.1, 0.1]
    z = dims[:, 2] / 2 + GROUND_SIGMA_M * rng.normal(size=count)
    return np.concatenate([xy, z[:, None], dims, rng.uniform(-np.pi, np.pi, (count, 1))], 1)


def _measured(camera: Camera, truth: Array, size_bias: Array | float, rng: np.random.Generator) -> Measurements:
    """One camera's noisy measurements of states (N, 7); size_bias (N, 3), metres, is added to the sizes."""
    xyxy, _ = project_extents(camera, truth[:, :3], truth[:, 3:6], truth[:, 6])
    noise = rng.normal(size=(len(truth), 8))
    dims = truth[:, 3:6] + SIGMAS.dims_lwh * noise[:, 4:7] + size_bias
    yaw = truth[:, 6] + SIGMAS.yaw_rad * noise[:, 7]
    return measurements_of(np.zeros(len(truth), np.int64), xyxy + SIGMAS.px * noise[:, :4], dims, yaw, SIGMAS)


def surface_depth(camera: Camera, truth: Array) -> Array:
    """Depth (N,) at which the ray through each 2D box's centre meets the 3D box, NaN where it misses it."""
    xyxy, _ = project_extents(camera, truth[:, :3], truth[:, 3:6], truth[:, 6])
    rays = camera.rays_world(0.5 * (xyxy[:, :2] + xyxy[:, 2:]))
    turn = rotation_z(truth[:, 6])
    along = np.einsum("nij,ni->nj", turn, rays)
    start = np.einsum("nij,ni->nj", turn, camera.position_m - truth[:, :3])
    with np.errstate(divide="ignore", invalid="ignore"):
        faces = np.stack([(-0.5 * truth[:, 3:6] - start) / along, (0.5 * truth[:, 3:6] - start) / along])
    enter, leave = faces.min(0).max(1), faces.max(0).min(1)
    return np.where(enter <= leave, enter, np.nan)


def lift_table(height: float, pitch_deg: float, seed: int = 0, count: int = CARS) -> dict[str, Row]:
    """The paper's solve and the MAP with ever more terms, on one camera."""
    rng = np.random.default_rng(seed)
    camera = _camera("pole", (0.0, 0.0), 0.0, height, float(np.deg2rad(pitch_deg)))
    truth = _visible_cars(camera, count, rng)
    edges = _measured(camera, truth, 0.0, rng)
    surface = surface_depth(camera, truth)
    sigma = DEPTH_SIGMA * surface
    depth = replace(edges, depth_m=surface + sigma * rng.normal(size=count), sigma_depth_m=sigma)
    variants = {
        "paper": ("paper", edges, NO_GROUND),
        "map, edges only": ("map", edges, NO_GROUND),
        "map + ground": ("map", edges, TRUE_GROUND),
        "map + ground + depth": ("map", depth, TRUE_GROUND),
    }
    return {name: score(lift_all(method, [camera], GroundPlane(), m, s), truth) for name, (method, m, s) in variants.items()}


def _visible_cars(camera: Camera, count: int, rng: np.random.Generator) -> Array:
    """States (count, 7) of cars 10 to 40 m before a camera, wholly in its image."""
    found = np.zeros((0, 7))
    while len(found) < count:
        distance, azimuth = rng.uniform(10.0, 40.0, 4 * count), rng.uniform(-0.7, 0.7, 4 * count)
        truth = _cars(4 * count, np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth)], 1), rng)
        xyxy, in_front = project_extents(camera, truth[:, :3], truth[:, 3:6], truth[:, 6])
        low, high = xyxy[:, :2] > MARGIN_PX, xyxy[:, 2:] < np.array([WIDTH, HEIGHT]) - 1.0 - MARGIN_PX
        found = np.concatenate([found, truth[in_front & low.all(1) & high.all(1)]])
    return found[:count]


def fusion_table(inexact: bool, seed: int = 0, count: int = CARS // 4) -> dict[str, Row]:
    """Four cameras 25 m away around each car; with 0.3 degrees of calibration error and shared size errors if ``inexact``."""
    rng = np.random.default_rng(seed)
    angles = np.arange(FUSION_CAMERAS) * 2 * np.pi / FUSION_CAMERAS
    places = [(-FUSION_DISTANCE_M * np.cos(a), -FUSION_DISTANCE_M * np.sin(a)) for a in angles]
    named = zip(angles, places, strict=True)
    true = [_camera(f"pole{i}", xy, a, 5.0, FUSION_PITCH_RAD) for i, (a, xy) in enumerate(named)]
    truth = _cars(count, rng.uniform(-2.0, 2.0, (count, 2)), rng)
    bias = SIGMAS.dims_lwh * rng.normal(size=(count, 3)) if inexact else 0.0
    # Each car meets its own calibration errors, so that the figures do not hang on one draw of four. Views go by car.
    believed = [_turned(camera, rng) if inexact else camera for _ in range(count) for camera in true]
    seen = [_measured(camera, truth, bias, rng) for camera in true]
    order = np.arange(FUSION_CAMERAS * count).reshape(FUSION_CAMERAS, count).T.ravel()
    together = Measurements(**{f.name: np.concatenate([getattr(m, f.name) for m in seen])[order] for f in fields(Measurements)})
    measured = replace(together, camera_index=np.arange(len(together)))
    rows: dict[str, Row] = {}
    for label, method, settings in (("paper", "paper", NO_GROUND), ("map + ground", "map", TRUE_GROUND)):
        boxes, terms = lift_with(method, believed, GroundPlane(), measured, settings)
        rows[f"{label}, one camera"] = score(boxes, np.repeat(truth, FUSION_CAMERAS, axis=0))
        rows[f"{label}, fused"] = _fused_row(boxes, terms, true, truth, INEXACT if inexact else EXACT)
    return rows


def _turned(camera: Camera, rng: np.random.Generator) -> Camera:
    """A camera whose heading is believed wrong by the calibration error."""
    turn = rigid(rotation_z(CALIBRATION_RAD * rng.normal()), np.zeros(3))
    here = rigid(np.eye(3), camera.position_m)
    back = rigid(np.eye(3), -camera.position_m)
    return replace(camera, T_cam_world=camera.T_cam_world @ here @ turn @ back)


def _fused_row(boxes: Boxes, terms: BoxProblem | None, cameras: list[Camera], truth: Array, settings: FusionSettings) -> Row:
    """Each car's boxes fused; the fused box is the one that the first camera's went into."""
    owner = np.arange(len(cameras))
    parts, joined = [], 0
    for row in range(len(truth)):
        mine = row * len(cameras) + owner
        result = fuse(boxes.take(mine), owner, cameras, settings, None if terms is None else terms.take(mine))
        parts.append(result.boxes.take(result.source[:1]))
        joined += int((result.source[1:] == result.source[0]).sum())
    pairs = len(truth) * (len(cameras) - 1)
    return {**score(Boxes.concatenate(parts), truth), "association_recall": round(joined / pairs, 4)}


def run_rigs(seed: int = 0) -> dict[str, dict[str, Row]]:
    """All tables."""
    tables = {f"lift, camera {name}": lift_table(*rig, seed) for name, rig in LIFT_RIGS.items()}
    tables["fusion, four cameras at 25 m, independent noise"] = fusion_table(False, seed)
    tables["fusion, 0.3 deg calibration error and shared size errors"] = fusion_table(True, seed)
    return tables
