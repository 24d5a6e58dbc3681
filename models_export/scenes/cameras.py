"""Cameras on poles: where they stand, how they look, and the site they make."""

from __future__ import annotations

import numpy as np

from models_export.scenes.mesh import Array
from service.geometry.camera import Camera
from service.geometry.transforms import pole_camera_pose

WIDTH_PX, HEIGHT_PX = 1284, 384
CAMERA_IDS = ("north", "west", "south", "east")
"""In the order of the worlds' poles."""


def pole_cameras(poles: tuple[tuple[Array, Array], ...], count: int, rng: np.random.Generator) -> tuple[Camera, ...]:
    """``count`` cameras (1..8) on poles given as foot (2,) and target (2,) on the ground, metres.

    More cameras than poles put further ones on the same poles, turned aside; their ids then carry a number.
    """
    cameras = []
    for index in range(count):
        foot, target = poles[index % len(poles)]
        lap = index // len(poles)
        heading = np.arctan2(*(target - foot)[::-1]) + lap * np.deg2rad(70)
        name = CAMERA_IDS[index % len(poles)] + (str(lap + 1) if lap else "")
        position = np.array([*foot, rng.uniform(5.0, 8.0)])
        focal = rng.uniform(560, 800)
        # Mostly the horizon is in the picture or just above it: a long lens that looks far down would see little road.
        steepest = np.rad2deg(np.arctan(0.5 * HEIGHT_PX / focal)) + 4 if rng.random() < 0.85 else 25.0
        pitch, roll = np.deg2rad(rng.uniform(10, steepest)), np.deg2rad(rng.uniform(-1, 1))
        center = np.array([WIDTH_PX - 1, HEIGHT_PX - 1]) / 2 + rng.normal(0, 4, 2)
        K = np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]])
        cameras.append(Camera(name, WIDTH_PX, HEIGHT_PX, K, pole_camera_pose(position, heading, pitch, roll)))
    return tuple(cameras)
