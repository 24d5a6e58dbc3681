from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from models_export.data.carla_convert import CarlaPose, camera_from_enu, flip_y
from models_export.data.carla_images import intrinsics
from models_export.data.carla_rig import load_rig, parse_rig
from service.errors import CalibrationError
from service.geometry.camera import Camera
from service.geometry.transforms import pole_camera_pose
from service.site import Site, save_site, site_document

POLE = pole_camera_pose([-12.0, 3.0, 6.0], 0.2, 0.3)
K = intrinsics(640, 360, 80.0)
MAP_CAMERA: dict[str, Any] = {
    "id": "north",
    "width": 640,
    "height": 360,
    "fov_deg": 80.0,
    "location": {"x": 30.0, "y": -20.0, "z": 7.0},
    "rotation": {"pitch": -20.0, "yaw": 115.0},
}
SITE_CAMERA: dict[str, Any] = {"id": "east", "width": 640, "height": 360, "K": K.tolist(), "T_cam_world": POLE.tolist()}
RIG: dict[str, Any] = {
    "id": "junction",
    "map": "Town05",
    "anchor": {"x": 25.0, "y": -18.0, "z": 0.5, "yaw": -90.0},
    "cameras": [MAP_CAMERA, SITE_CAMERA],
}


def test_both_forms_of_a_camera() -> None:
    rig = parse_rig(RIG)
    assert (rig.site.id, rig.map, rig.has_origin) == ("junction", "Town05", False)
    assert [camera.id for camera in rig.site.cameras] == ["north", "east"]
    np.testing.assert_allclose(rig.site.cameras[0].position_m, [5.0, 2.0, 6.5], atol=1e-9)
    assert rig.mounts[0].pose == CarlaPose(30.0, -20.0, 7.0, -20.0, 115.0, 0.0)
    assert rig.mounts[1].fov_deg == pytest.approx(80.0)


def test_an_anchor_s_yaw_turns_the_cameras_not_the_world() -> None:
    """Yaw -90 is a quarter turn counter-clockwise: 12 m behind and 3 m left of the anchor lie at East -3, North -12."""
    camera = parse_rig(RIG).mounts[1]
    np.testing.assert_allclose(camera.camera.position_m, [-3.0, -12.0, 6.0], atol=1e-9)
    np.testing.assert_allclose([camera.pose.x, camera.pose.y, camera.pose.z], [22.0, -6.0, 6.5], atol=1e-9)
    assert camera.pose.pitch == pytest.approx(np.rad2deg(-0.3))
    assert camera.pose.yaw == pytest.approx(-90 - np.rad2deg(0.2))


def test_pose_and_camera_agree() -> None:
    rig = parse_rig(RIG)
    points = np.random.default_rng(0).uniform(-50, 50, (20, 3))
    for mount in rig.mounts:
        direct = points @ camera_from_enu(mount.pose)[:3, :3].T + camera_from_enu(mount.pose)[:3, 3]
        moved = rig.to_site(points)
        through_site = moved @ mount.camera.R_cam_world.T + mount.camera.T_cam_world[:3, 3]
        np.testing.assert_allclose(direct, through_site, atol=1e-9)
    np.testing.assert_allclose(rig.to_site(flip_y([25.0, -18.0, 0.5])), np.zeros(3))


def test_a_site_is_a_rig(tmp_path: Path) -> None:
    site = Site("plain", (Camera("east", 640, 360, K, POLE),))
    save_site(site, tmp_path / "site.json")
    rig = load_rig(tmp_path / "site.json")
    np.testing.assert_allclose(rig.site.cameras[0].T_cam_world, POLE, atol=1e-12)
    np.testing.assert_allclose(rig.site.cameras[0].K, K)
    assert rig.has_origin
    assert site_document(rig.site).keys() == site_document(site).keys()


def changed(**changes: Any) -> dict[str, Any]:
    return {**copy.deepcopy(RIG), **changes}


def camera_with(base: dict[str, Any], **changes: Any) -> dict[str, Any]:
    return changed(cameras=[{**copy.deepcopy(base), **changes}])


@pytest.mark.parametrize(
    ("document", "field"),
    [
        (changed(cameras=[]), "cameras"),
        (changed(id="no spaces"), "id"),
        (changed(anchor={"x": float("nan")}), "anchor.x"),
        (changed(extra=1), "extra"),
        (changed(cameras=[MAP_CAMERA, {**MAP_CAMERA}]), "cameras.1.id"),
        (camera_with(MAP_CAMERA, fov_deg=200), "cameras.0.fov_deg"),
        (camera_with(MAP_CAMERA, location={"x": 1}), "cameras.0.location.y"),
        (camera_with(SITE_CAMERA, T_cam_world=np.ones((4, 4)).tolist()), "cameras.0.T_cam_world"),
        (camera_with(SITE_CAMERA, K=[[500, 0, 300], [0, 500, 179.5], [0, 0, 1]]), "cameras.0.K"),
        (camera_with(SITE_CAMERA, K=[[500, 0, 319.5], [0, 510, 179.5], [0, 0, 1]]), "cameras.0.K"),
        (camera_with(SITE_CAMERA, distortion=[0.1, 0, 0, 0]), "cameras.0.distortion"),
        ([], "rig"),
    ],
)
def test_bad_rigs_name_the_field(document: Any, field: str) -> None:
    with pytest.raises(CalibrationError) as caught:
        parse_rig(document)
    assert caught.value.field == field
    assert caught.value.remedy


def test_a_camera_that_carla_has_not_is_told_what_it_could_be() -> None:
    with pytest.raises(CalibrationError, match=r"319\.5"):
        parse_rig(camera_with(SITE_CAMERA, K=[[500, 0, 300], [0, 500, 179.5], [0, 0, 1]]))


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "bad.json").write_text("{")
    for name in ("bad.json", "absent.json"):
        with pytest.raises(CalibrationError, match="cannot be read") as caught:
            load_rig(tmp_path / name)
        assert name in (caught.value.field or "")


def test_the_example_of_the_documentation_is_a_rig() -> None:
    page = (Path(__file__).parents[2] / "docs" / "carla.md").read_text("utf-8")
    example = page.split("```json", 1)[1].split("```", 1)[0]
    rig = parse_rig(json.loads(example))
    assert len(rig.mounts) == 2
