"""The accuracy that the shipped pack has to reach on the shipped clip, and the real roadside cameras end to end."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.clip_score import score_clip
from benchmarks.recordings import ROADSIDE_STEPS, RoadsideClip, open_roadside_clip
from service.errors import NotFoundError
from service.nets.pack import load_pack
from service.pipeline import Pipeline


@pytest.fixture(scope="module")
def roadside() -> RoadsideClip:
    try:
        return open_roadside_clip()
    except NotFoundError as error:
        pytest.skip(str(error))


def test_vehicles_of_the_clip_are_found() -> None:
    summary = score_clip(Pipeline(load_pack("edge")))
    assert summary["vehicles"] > 200
    assert summary["recall_percent"] >= 85
    assert summary["false_percent"] <= 15


def test_the_calibration_becomes_a_site(roadside: RoadsideClip) -> None:
    assert [camera.id for camera in roadside.site.cameras] == ["infra_0", "infra_1", "infra_2"]
    for camera in roadside.site.cameras:
        # Masts of a highway junction; the road is z = 0.
        assert 5 < camera.position_m[2] < 12
        assert (camera.width, camera.height) == (640, 360)


def test_the_site_projects_as_the_recording_says(roadside: RoadsideClip) -> None:
    """K [R | t] of the site against the recording's own projection matrices."""
    import json
    import zipfile

    with zipfile.ZipFile(roadside.path) as archive:
        calibration = json.loads(archive.read("tumtraf_clip/calibration.json"))
    points = np.random.default_rng(0).uniform([20, -20, -8], [60, 20, -5], (50, 3))
    world = points + roadside.T_world_lidar[:3, 3]
    for camera in roadside.site.cameras:
        P = np.array(calibration[camera.id]["P_lidar_south_to_image"])
        expected = points @ P[:, :3].T + P[:, 3]
        pixels, depth = camera.project(world)
        np.testing.assert_allclose(pixels[depth > 1], (expected[:, :2] / expected[:, 2:])[depth > 1], atol=0.05)


def test_the_protocol_counts_329_reference_vehicles(roadside: RoadsideClip) -> None:
    counts = [len(roadside.reference_2d(c.id, step)) for step in ROADSIDE_STEPS for c in roadside.site.cameras]
    assert sum(counts) == 329
