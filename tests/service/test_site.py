import copy
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import CalibrationError, NotFoundError
from service.geometry.transforms import pole_camera_pose
from service.site import load_site, parse_site, save_site, site_document


def camera_document(camera_id="north", position=(0.0, 0.0, 6.0)):
    return {
        "id": camera_id,
        "width": 1284,
        "height": 384,
        "K": [[642.0, 0.0, 641.5], [0.0, 642.0, 191.5], [0.0, 0.0, 1.0]],
        "distortion": [-0.1, 0.01, 0.0, 0.0, 0.0],
        "T_cam_world": pole_camera_pose(position, 0.3, 0.2).tolist(),
    }


def document():
    return {
        "id": "crossing",
        "origin": {"lat": 48.1, "lon": 11.6, "alt": 500.0},
        "ground": {"normal": [0.0, 0.0, 1.0], "offset": 0.25},
        "accuracy": {"ground_m": 0.02, "ground_per_m": 0.0, "camera_m": 0.03, "camera_rad": 0.001},
        "cameras": [camera_document("north"), camera_document("east", (20.0, 0.0, 7.0))],
    }


def changed(path, value):
    """The document with the value at a dotted path replaced."""
    result = document()
    *parents, last = [int(part) if part.isdigit() else part for part in path.split(".")]
    target = result
    for part in parents:
        target = target[part]
    target[last] = value
    return result


def test_a_site_survives_the_round_trip_through_json():
    once = site_document(parse_site(document()))
    twice = site_document(parse_site(json.loads(json.dumps(once))))
    np.testing.assert_allclose(twice["cameras"][1]["T_cam_world"], document()["cameras"][1]["T_cam_world"], atol=1e-12)
    for site in (once, twice):
        for camera in site["cameras"]:
            camera.pop("T_cam_world")
    expected = document()
    for camera in expected["cameras"]:
        camera.pop("T_cam_world")
    assert once == twice == expected


def test_save_and_load(tmp_path):
    path = tmp_path / "new" / "site.json"
    site = parse_site(document())
    save_site(site, path)
    save_site(site, path)
    assert site_document(load_site(path)) == site_document(site)
    assert [file.name for file in path.parent.iterdir()] == ["site.json"]


def test_a_site_without_cameras_is_a_site():
    assert parse_site({"id": "new"}).cameras == ()


def test_cameras_are_added_replaced_and_dropped():
    site = parse_site(document())
    other = parse_site({"id": "other", "cameras": [camera_document("east", (5.0, 5.0, 5.0)), camera_document("west")]})
    grown = site.with_camera(other.camera("west")).with_camera(other.camera("east"))
    assert sorted(camera.id for camera in grown.cameras) == ["east", "north", "west"]
    np.testing.assert_allclose(grown.camera("east").position_m, [5.0, 5.0, 5.0])
    assert [camera.id for camera in site.cameras] == ["north", "east"]
    assert [camera.id for camera in site.without_camera("north").cameras] == ["east"]
    with pytest.raises(NotFoundError, match="north, east"):
        site.without_camera("south")


def test_a_slightly_rounded_rotation_is_made_exact():
    rounded = document()
    rounded["cameras"][0]["T_cam_world"] = np.round(rounded["cameras"][0]["T_cam_world"], 5).tolist()
    R = parse_site(rounded).cameras[0].R_cam_world
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)


def test_ground_is_normalised():
    ground = parse_site(changed("ground", {"normal": [0.0, 0.0, 2.0], "offset": 3.0})).ground
    np.testing.assert_allclose(ground.height_at([7.0, 8.0]), 1.5)


GRID = {"origin_xy": [-10.0, -20.0], "cell_m": 5.0, "heights": [[0.0, 0.5, 1.0], [0.25, 0.5, 0.75]]}


def test_ground_may_be_a_grid_of_heights_and_is_written_as_one():
    site = parse_site(changed("ground", {"grid": GRID}))
    assert site.ground.height_at([-5.0, -20.0]) == 0.5
    assert site.ground.height_at([-10.0, -15.0]) == 0.25
    assert site_document(site)["ground"] == {"grid": GRID}
    np.testing.assert_array_equal(parse_site(site_document(site)).ground.heights, GRID["heights"])


@pytest.mark.parametrize(
    ("key", "value", "field"),
    [
        ("heights", [[0.0, 1.0], [0.0]], "ground.grid.heights.1"),
        ("heights", [[0.0, 1.0], [0.0, 1.0, 2.0]], "ground.grid.heights"),
        ("heights", [[0.0] * 600] * 600, "ground.grid.heights"),
        ("heights", [[0.0, float("inf")], [0.0, 0.0]], "ground.grid.heights.0.1"),
        ("cell_m", 0.0, "ground.grid.cell_m"),
        ("origin_xy", [0.0], "ground.grid.origin_xy"),
    ],
)
def test_a_grid_that_cannot_be_is_refused_by_name(key, value, field):
    with pytest.raises(CalibrationError) as caught:
        parse_site(changed("ground", {"grid": {**GRID, key: value}}))
    assert caught.value.field == field


MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0]).tolist()
SCALED = np.diag([2.0, 2.0, 2.0, 1.0]).tolist()


@pytest.mark.parametrize(
    ("path", "value", "field"),
    [
        ("id", "../etc", "id"),
        ("cameras.0.id", "a b", "cameras.0.id"),
        ("cameras.1.id", "north", "cameras.1.id"),
        ("cameras.0.width", 0, "cameras.0.width"),
        ("cameras.0.height", 10**9, "cameras.0.height"),
        ("cameras.0.K", [[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]], "cameras.0.K"),
        ("cameras.0.K", [[float("nan"), 0.0, 1.0], [0.0, 600.0, 1.0], [0.0, 0.0, 1.0]], "cameras.0.K.0.0"),
        ("cameras.0.K", [[600.0, 0.0, 1.0], [0.0, -600.0, 1.0], [0.0, 0.0, 1.0]], "cameras.0.K"),
        ("cameras.0.K", [[600.0, 0.0], [0.0, 600.0], [0.0, 0.0]], "cameras.0.K.0"),
        ("cameras.0.T_cam_world", np.zeros((4, 4)).tolist(), "cameras.0.T_cam_world"),
        ("cameras.0.T_cam_world", MIRROR, "cameras.0.T_cam_world"),
        ("cameras.1.T_cam_world", SCALED, "cameras.1.T_cam_world"),
        ("cameras.0.T_cam_world.0.3", float("inf"), "cameras.0.T_cam_world.0.3"),
        ("cameras.0.T_cam_world.0.3", 1e300, "cameras.0.T_cam_world.0.3"),
        ("cameras.0.distortion", [0.1, 0.2], "cameras.0.distortion"),
        ("cameras.0.distortion", [float("nan")] * 5, "cameras.0.distortion.0"),
        ("ground.normal", [0.0, 0.0, 0.0], "ground.normal"),
        ("ground.normal", [1.0, 0.0, 0.0], "ground.normal"),
        ("origin.lat", 91.0, "origin.lat"),
        ("accuracy.ground_m", 0.0, "accuracy.ground_m"),
        ("accuracy.camera_rad", float("nan"), "accuracy.camera_rad"),
        ("colour", "red", "colour"),
    ],
)
def test_bad_values_are_refused_with_field_and_remedy(path, value, field):
    with pytest.raises(CalibrationError) as caught:
        parse_site(changed(path, value))
    assert caught.value.field == field
    assert caught.value.remedy
    assert caught.value.status == 422


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)
rows = st.lists(st.floats(), min_size=4, max_size=4)
paths = st.sampled_from(["id", "origin", "ground", "ground.normal", "cameras", "cameras.0", "cameras.0.K", "cameras.1.K.0.0"])
changes = st.tuples(paths, json_values) | st.tuples(st.just("cameras.0.T_cam_world.2"), rows)


@given(changes)
def test_whatever_stands_in_a_site_file_it_is_a_site_or_a_calibration_error(change):
    try:
        site = parse_site(changed(*change))
    except CalibrationError:
        return
    assert all(np.isfinite(camera.T_world_cam).all() for camera in site.cameras)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[]", b'{"cameras": []}'])
def test_files_that_are_no_site(tmp_path, content):
    path = tmp_path / "site.json"
    path.write_bytes(content)
    with pytest.raises(CalibrationError):
        load_site(path)
    with pytest.raises(CalibrationError, match=r"absent\.json"):
        load_site(tmp_path / "absent.json")


def test_a_failed_save_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "site.json"
    save_site(parse_site(document()), path)
    before = path.read_bytes()

    def full_disk(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr("os.fsync", full_disk)
    changed_site = parse_site(copy.deepcopy(document()) | {"id": "other"})
    with pytest.raises(OSError, match="no space"):
        save_site(changed_site, path)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["site.json"]
