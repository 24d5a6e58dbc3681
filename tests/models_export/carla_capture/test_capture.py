from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from models_export.data.carla_capture import MAX_DROPS, START_NS, CaptureRequest, Progress, capture
from models_export.data.carla_images import intrinsics
from models_export.data.carla_rig import parse_rig
from models_export.data.carla_sensors import Inbox, MissingPictureError
from models_export.data.carla_session import ServerOptions
from models_export.data.carla_weather import PRESETS, Weather
from models_export.data.dataset import open_scene
from models_export.data.kitti import read_calib, read_labels
from models_export.data.labels import kitti_labels
from service.errors import QuadliftError
from service.geometry.transforms import wrap_angle

carla: Any = pytest.importorskip("carla", reason="needs CARLA's client: pip install 'quadlift[carla]'")
Captured = Callable[..., list[Progress]]


def test_a_scene_is_read_back(captured: Captured, world: Any, tmp_path: Path) -> None:
    course = captured()
    assert [progress.written for progress in course] == [1, 2, 3]
    assert course[-1] == Progress(3, 0, 4, 0)
    assert world._as_found()
    scene = open_scene(tmp_path / "s")
    assert (scene.steps, scene.rate_hz, scene.world, scene.seed, scene.camera_ids) == (3, 5.0, "Town99", 3, ("north", "east"))
    truth = scene.truth(0)
    assert len(truth) == 4
    assert truth.captured_at_ns == START_NS
    assert scene.truth(2).captured_at_ns == START_NS + 400_000_000
    assert set(truth.classes) <= {"Car", "Van"}
    np.testing.assert_array_equal(truth.ids, scene.truth(2).ids)
    np.testing.assert_allclose(truth.dims_lwh, np.tile([4.4, 1.8, 1.5], (4, 1)), atol=1e-5)
    np.testing.assert_allclose(scene.truth(2).center - truth.center, 0.4 * truth.velocity, atol=1e-4)
    heading = np.arctan2(truth.velocity[:, 1], truth.velocity[:, 0])
    assert np.abs(wrap_angle(heading - truth.yaw)).max() < 1e-5
    picture = cv2.imdecode(np.frombuffer(scene.frame_bytes("east", 1), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert picture.shape == (112, 192, 3)


def test_boxes_lie_where_the_depth_says(captured: Captured, tmp_path: Path) -> None:
    """Every depth pixel, unprojected by the written site, lies on the ground or on the surface of a written box."""
    captured()
    scene = open_scene(tmp_path / "s")
    truth = scene.truth(1)
    on_boxes = np.zeros(len(truth), dtype=int)
    for camera in scene.site.cameras:
        depth = scene.depth(camera.id, 1)
        v, u = np.nonzero(depth)
        points = camera.unproject(np.stack([u, v], -1).astype(float), depth[v, u])
        distance = np.abs(points[:, 2])
        for k in range(len(truth)):
            c, s = np.cos(truth.yaw[k]), np.sin(truth.yaw[k])
            local = np.abs((points - truth.center[k]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])) - truth.dims_lwh[k] / 2
            surface = np.abs(local.max(1))
            on_boxes[k] += int(((surface < 0.02) & (distance > 0.1)).sum())
            distance = np.minimum(distance, surface)
        assert distance.max() < 0.02
    assert (on_boxes[truth.visible.max(1) > 0.3] > 20).all()


def test_visibility_labels_and_calibration(captured: Captured, tmp_path: Path) -> None:
    captured()
    scene = open_scene(tmp_path / "s")
    truth = scene.truth(0)
    assert truth.visible.max() == 1.0
    assert ((truth.visible > 0) <= (truth.truncated < 1)).all()
    for index, camera in enumerate(scene.site.cameras):
        folder = scene.path / "cameras" / camera.id
        labels = read_labels(folder / "label_2" / "000000.txt")
        assert len(labels) == (truth.visible[:, index] > 0).sum() > 0
        assert [label.location for label in labels] == [
            pytest.approx(label.location, abs=1e-4) for label in kitti_labels(camera, index, truth)
        ]
        calib = read_calib(folder / "calib" / "000000.txt")
        np.testing.assert_allclose(calib.P2[:, :3], intrinsics(192, 112, 80.0), atol=1e-6)


def test_the_same_seed_gives_the_same_scene(captured: Captured, package: Any, new_world: Any, tmp_path: Path) -> None:
    captured("a")
    package.client._world = new_world()
    captured("b")
    first, second = ((tmp_path / name / "boxes" / "000002.json").read_text() for name in "ab")
    assert first == second


def test_the_server_is_told_and_left_as_it_was(package: Any, rig_document: dict[str, Any], world: Any, tmp_path: Path) -> None:
    request = CaptureRequest(steps=2, weather=Weather.RAIN, vehicles=2, seed=9)
    course = capture(package, ServerOptions(), parse_rig(rig_document), request, tmp_path / "s")
    next(course)
    assert world._settings.synchronous_mode
    assert world._settings.fixed_delta_seconds == pytest.approx(0.1)
    assert world._weather.precipitation == pytest.approx(PRESETS[Weather.RAIN]["precipitation"])
    assert not any(world._parked.values())
    assert len(world._sensors) == 6
    assert {sensor._set["fov"] for sensor in world._sensors} == {"80.0"}
    assert all(actor._port == ServerOptions.traffic_port for actor in world._actors)
    assert "traffic seed 9" in world._log
    list(course)
    assert world._as_found()
    assert world._log.index("traffic sync False") > world._log.index("sync False")


def test_the_site_knows_where_on_the_globe_it_is(captured: Captured, tmp_path: Path) -> None:
    """The anchor lies 40 m East and 25 m North of 48 N 11 E; 0.9.16's own answer has it South."""
    captured()
    origin = open_scene(tmp_path / "s").site.origin
    assert (origin.lat - 48.0) * 111_200 == pytest.approx(25.0, abs=0.1)
    assert (origin.lon - 11.0) * 111_300 * np.cos(np.deg2rad(48)) == pytest.approx(40.0, abs=0.2)


def test_actors_without_a_box_are_left_out_and_counted(captured: Captured, world: Any, new_actor: Any, tmp_path: Path) -> None:
    flat = new_actor(5, "vehicle.c.bike", carla.Transform(carla.Location(45, -22, 0)), "bicycle")
    flat.bounding_box = carla.BoundingBox(carla.Location(0, 0, 1), carla.Vector3D(0.9, 0.0, 0.8))
    walker = new_actor(6, "walker.pedestrian.0001", carla.Transform(carla.Location(44, -28, 0)))
    world._actors += [flat, walker]
    assert captured()[-1].without_box == 1
    truth = open_scene(tmp_path / "s").truth(0)
    assert 5 not in truth.ids
    assert truth.classes[truth.ids.tolist().index(6)] == "Pedestrian"
    # What others put there stays.
    assert {actor.id for actor in world._actors} == {5, 6}


# ------------------------------------------------------------------ pictures that come late, early or never


def test_pictures_out_of_order(captured: Captured, package: Any, new_world: Any, tmp_path: Path) -> None:
    captured("ordered")
    other = new_world()
    other._reverse = True
    package.client._world = other
    captured("mixed")
    for step in range(3):
        for path in (f"boxes/{step:06d}.json", f"cameras/north/depth/{step:06d}.png", f"cameras/east/image_2/{step:06d}.jpg"):
            assert (tmp_path / "ordered" / path).read_bytes() == (tmp_path / "mixed" / path).read_bytes(), path


def test_early_pictures_are_kept_and_old_ones_dropped() -> None:
    inbox = Inbox("north.rgb")
    images = {frame: SimpleNamespace(frame=frame) for frame in (5, 6, 7, 8)}
    for frame in (7, 5, 8, 6):
        inbox.put(images[frame])
    assert [inbox.take(frame, time.monotonic() + 1) for frame in (6, 7, 8)] == [images[6], images[7], images[8]]
    with pytest.raises(MissingPictureError, match="frame 5"):
        inbox.take(5, time.monotonic())


def test_a_missing_picture_drops_its_step_and_is_counted(captured: Captured, world: Any, tmp_path: Path) -> None:
    # Four ticks of warm-up and two until the sensors draw; then every second frame is a step: 1008, 1010, ...
    world._lost = lambda frame, sensor: frame == 1010 and sensor is world._sensors[4]
    course = captured(wait_s=1.0)
    assert course[-1] == Progress(3, 1, 4, 0)
    scene = open_scene(tmp_path / "s")
    assert [scene.truth(step).captured_at_ns - START_NS for step in range(3)] == [0, 400_000_000, 600_000_000]
    assert json.loads((scene.path / "scene.json").read_text())["dropped"] == 1


def test_a_sensor_that_stays_silent_ends_the_capture(captured: Captured, world: Any, tmp_path: Path) -> None:
    world._lost = lambda frame, sensor: frame > 1008 and sensor is world._sensors[1]
    with pytest.raises(QuadliftError, match=f"frame {1008 + 2 * MAX_DROPS}") as caught:
        captured(wait_s=0.5)
    assert caught.value.field == "north.depth"
    assert world._as_found()
    # The step that was whole is a scene of its own.
    assert open_scene(tmp_path / "s").steps == 1
