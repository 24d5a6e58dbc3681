"""PandaSet's conventions against ours: on cuboids made here, and on the real drive where it lies beside the checkout."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.recordings import PANDASET_CLIP, recording
from models_export.data.pandaset import PandasetClip, boxes_of, open_pandaset, rotation_of
from service.errors import InputError, NotFoundError
from service.geometry.boxes import project_extents


def cuboid(uuid: str, **changes: Any) -> dict[str, Any]:
    plain = {"label": "Car", "yaw": 0.0, "center_xyz": [1, 2, 3], "dimensions_xyz": [1.8, 4.5, 1.5]}
    return {"uuid": uuid, "sensor_id": -1, "sibling_id": "-", **plain, **changes}


@pytest.fixture(scope="module")
def drive() -> PandasetClip:
    try:
        return open_pandaset(recording(PANDASET_CLIP))
    except NotFoundError as error:
        pytest.skip(str(error))


def test_a_cuboid_is_a_box_whose_length_runs_along_its_front() -> None:
    boxes = boxes_of([cuboid("a"), cuboid("b", yaw=3.0)])
    assert boxes.dims_lwh[0].tolist() == [4.5, 1.8, 1.5]
    np.testing.assert_allclose(boxes.yaw, [np.pi / 2, 3.0 + np.pi / 2 - 2 * np.pi])


def test_an_object_that_both_lidars_have_counts_once() -> None:
    pair = [cuboid("a", sensor_id=1, sibling_id="b"), cuboid("b", sensor_id=0, sibling_id="a")]
    alone = cuboid("c", sensor_id=1, sibling_id="of another step")
    assert boxes_of([*pair, alone]).ids == ("b", "c")
    same_sensor = [cuboid("d", sensor_id=0, sibling_id="e"), cuboid("e", sensor_id=0, sibling_id="d")]
    assert boxes_of(same_sensor).ids == ("d",)
    assert len(boxes_of([])) == 0


def test_quaternions_turn_as_scipy_has_them() -> None:
    for quaternion in np.random.default_rng(1).normal(size=(10, 4)):
        expected = Rotation.from_quat(quaternion[[1, 2, 3, 0]]).as_matrix()
        np.testing.assert_allclose(rotation_of(quaternion.tolist()), expected, atol=1e-12)


def test_what_is_no_drive_is_named(tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="no such recording"):
        open_pandaset(tmp_path / "none.zip")
    (tmp_path / "text.zip").write_text("no zip")
    with pytest.raises(InputError, match="not a zip file"):
        open_pandaset(tmp_path / "text.zip")
    with zipfile.ZipFile(tmp_path / "empty.zip", "w") as archive:
        archive.writestr("readme.txt", json.dumps({}))
    with pytest.raises(InputError, match=r"one cameras\.json"):
        open_pandaset(tmp_path / "empty.zip")


def test_real_vehicles_drive_where_they_head(drive: PandasetClip) -> None:
    first, last = drive.boxes(0), drive.boxes(drive.steps - 1)
    moved = 0
    for row, (identity, label) in enumerate(zip(first.ids, first.labels, strict=True)):
        if label != "Car" or identity not in last.ids:
            continue
        way = last.center[last.ids.index(identity)] - first.center[row]
        if np.hypot(way[0], way[1]) > 10:
            moved += 1
            assert np.cos(np.arctan2(way[1], way[0]) - first.yaw[row]) > np.cos(np.radians(10))
    assert moved >= 5


def test_real_cameras_look_in_the_directions_of_their_names(drive: PandasetClip) -> None:
    step = 10
    heading = drive.camera("front_camera", step + 1).position_m - drive.camera("front_camera", step).position_m
    ahead = heading[:2] / np.linalg.norm(heading[:2])
    left = np.array([-ahead[1], ahead[0]])
    for name, direction in (("front", ahead), ("back", -ahead), ("left", left), ("right", -left), ("front_left", ahead + left)):
        camera = drive.camera(f"{name}_camera", step)
        looks = camera.R_cam_world[2, :2]
        assert looks @ direction / np.linalg.norm(direction) / np.linalg.norm(looks) > np.cos(np.radians(20)), name
        assert abs(camera.R_cam_world[2, 2]) < 0.1


def test_real_boxes_fall_into_the_pictures(drive: PandasetClip) -> None:
    boxes = drive.boxes(0)
    extents, in_front = project_extents(drive.camera("front_camera", 0), boxes.center, boxes.dims_lwh, boxes.yaw)
    inside = in_front & (extents[:, 0] > 0) & (extents[:, 2] < 1280) & (extents[:, 1] > 0) & (extents[:, 3] < 720)
    assert inside.sum() > 20
    assert drive.frame_bytes("front_camera", 0).startswith(b"\xff\xd8")
