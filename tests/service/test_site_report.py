"""The site report: heights, pitches and visible ground of cameras whose answers are known by hand."""

from __future__ import annotations

import numpy as np
import pytest

from service.geometry.camera import Camera
from service.geometry.ground import GroundPlane
from service.geometry.transforms import pole_camera_pose
from service.site import Site
from service.site_report import CameraReport, camera_reports

HALF_VIEW_RAD = np.arctan(191.5 / 642)


def report(height_m: float, pitch_deg: float, ground: GroundPlane | None = None) -> CameraReport:
    K = np.array([[642.0, 0, 641.5], [0, 642.0, 191.5], [0, 0, 1]])
    camera = Camera("north", 1284, 384, K, pole_camera_pose([30.0, -8.0, height_m], 0.7, np.radians(pitch_deg)))
    return camera_reports(Site("demo", (camera,), ground or GroundPlane()))[0]


@pytest.mark.parametrize("pitch_deg", [18.0, 30.0, 60.0])
def test_a_pitched_camera_sees_a_stretch_of_ground(pitch_deg: float) -> None:
    got = report(6.0, pitch_deg)
    assert got.pitch_deg == pytest.approx(pitch_deg)
    assert got.height_m == pytest.approx(6.0)
    assert got.near_m == pytest.approx(6.0 / np.tan(np.radians(pitch_deg) + HALF_VIEW_RAD))
    assert got.far_m == pytest.approx(6.0 / np.tan(np.radians(pitch_deg) - HALF_VIEW_RAD))
    assert got.problem is None


def test_a_level_camera_sees_the_horizon() -> None:
    got = report(6.0, 0.0)
    assert np.isinf(got.far_m)
    assert got.near_m == pytest.approx(6.0 / np.tan(HALF_VIEW_RAD))


def test_what_cannot_work_is_said() -> None:
    assert report(6.0, -30.0).problem == "sees no ground"
    assert report(-1.0, -30.0).problem == "below the ground"


def test_height_is_over_the_sites_own_ground() -> None:
    assert report(6.0, 20.0, GroundPlane(offset=-2.0)).height_m == pytest.approx(8.0)
