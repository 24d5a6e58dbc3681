"""What geometry costs: lifting, fusing and tracking 1 to 512 boxes over four cameras, one core.

Vehicles stand on a grid at a crossing and are projected into four cameras on its corners, so every box is one that a camera
could have seen. Times are medians over repeated runs of one and the same frame set, the tracker's over a run of sets.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from service.fusion import fuse
from service.geometry.boxes import clip_extents, project_extents
from service.geometry.camera import Camera
from service.geometry.ground import GroundPlane
from service.geometry.transforms import Array, pole_camera_pose
from service.lifting import lift_with_terms
from service.measurements import Measurements
from service.tracking import Tracker

BOXES = (1, 4, 16, 64, 128, 256, 512)
BUDGET_MS = {64: 2.0, 256: 6.0}
"""What lifting, fusing and tracking together may take at most, ms, by number of boxes."""
_CAMERAS = 4
_SIGMA_DIMS = np.array([0.2, 0.06, 0.06])
_K = np.array([[642.0, 0.0, 641.5], [0.0, 642.0, 191.5], [0.0, 0.0, 1.0]])
_STEP_NS = 100_000_000


def run_speed(repeats: int = 60) -> dict[str, dict[str, dict[str, float]]]:
    """Median milliseconds of each step by number of boxes, microseconds a box, and the budget where there is one."""
    rows = {}
    for count in BOXES:
        budget = {"budget_ms": BUDGET_MS[count]} if count in BUDGET_MS else {}
        rows[f"{count} boxes"] = _cost(count, repeats) | budget
    return {"speed": rows}


def crossing_cameras(radius_m: float = 25.0) -> list[Camera]:
    """Four cameras 6 m up around a crossing, looking at its middle, 14 degrees down."""
    cameras = []
    for row, azimuth in enumerate(np.pi / 4 + np.arange(_CAMERAS) * np.pi / 2):
        position = [radius_m * np.cos(azimuth), radius_m * np.sin(azimuth), 6.0]
        cameras.append(Camera(f"c{row}", 1284, 384, _K, pole_camera_pose(position, azimuth + np.pi, np.deg2rad(14))))
    return cameras


def crossing_boxes(count: int, cameras: list[Camera], seed: int = 0) -> Measurements:
    """``count`` noisy 2D boxes, spread over the cameras, of cars on a grid wide enough for all of them."""
    rng = np.random.default_rng(seed)
    vehicles = -(-count // len(cameras))
    side = int(np.ceil(np.sqrt(vehicles)))
    k = np.arange(vehicles)
    center = np.stack([7.0 * (k % side - (side - 1) / 2), 4.0 * (k // side - (side - 1) / 2), np.full(vehicles, 0.75)], 1)
    dims = np.array([4.3, 1.8, 1.5]) + rng.normal(size=(vehicles, 3)) * [0.3, 0.08, 0.08]
    yaw = np.where(rng.random(vehicles) < 0.5, 0.1, 0.1 - np.pi)
    camera_index = np.sort(np.arange(count) % len(cameras))
    vehicle = np.concatenate([np.arange((camera_index == row).sum()) for row in range(len(cameras))])
    xyxy = np.zeros((count, 4))
    for row, camera in enumerate(cameras):
        mine = camera_index == row
        extents, _ = project_extents(camera, center[vehicle[mine]], dims[vehicle[mine]], yaw[vehicle[mine]])
        xyxy[mine] = clip_extents(camera, extents + 2.0 * rng.normal(size=extents.shape))
    return Measurements(
        camera_index=camera_index,
        xyxy_px=xyxy,
        sigma_px=np.full((count, 4), 2.0),
        dims_lwh=dims[vehicle] + _SIGMA_DIMS * rng.normal(size=(count, 3)),
        sigma_dims=np.tile(_SIGMA_DIMS, (count, 1)),
        yaw=yaw[vehicle] + 0.07 * rng.normal(size=count),
        sigma_yaw=np.full(count, 0.07),
        flip_log_odds=np.full(count, 2.2),
        score=rng.uniform(0.5, 0.95, count),
        cls=np.zeros(count, np.int64),
        depth_m=np.full(count, np.nan),
        sigma_depth_m=np.full(count, np.nan),
    )


def _cost(count: int, repeats: int) -> dict[str, float]:
    # A crossing as wide as its traffic, so that many vehicles do not stand behind the cameras.
    cameras = crossing_cameras(radius_m=15.0 + 4.0 * np.sqrt(count / _CAMERAS))
    measurements, ground = crossing_boxes(count, cameras), GroundPlane()
    boxes, terms = lift_with_terms(cameras, ground, measurements)
    fused = fuse(boxes, measurements.camera_index, cameras, terms=terms)
    tracker, now_ns = Tracker(), 10**18

    def track() -> None:
        nonlocal now_ns
        now_ns += _STEP_NS
        tracker.update(fused, now_ns)

    lift_ms = _median_ms(lambda: lift_with_terms(cameras, ground, measurements), repeats)
    fuse_ms = _median_ms(lambda: fuse(boxes, measurements.camera_index, cameras, terms=terms), repeats)
    track_ms = _median_ms(track, repeats)
    total = lift_ms + fuse_ms + track_ms
    figures = {"lift_ms": lift_ms, "fuse_ms": fuse_ms, "track_ms": track_ms, "total_ms": total, "us_a_box": 1e3 * total / count}
    return {"vehicles": len(fused.boxes), **{name: round(value, 3) for name, value in figures.items()}}


def _median_ms(call: Callable[[], object], repeats: int) -> float:
    call()
    times: Array = np.zeros(repeats)
    for row in range(repeats):
        began = time.perf_counter()
        call()
        times[row] = time.perf_counter() - began
    return 1e3 * float(np.median(times))
