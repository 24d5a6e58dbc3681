from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from models_export.data.dataset import SceneTruth, list_scenes, open_scene, write_truth
from service.errors import InputError, NotFoundError
from service.geometry.camera import Camera
from service.geometry.transforms import pole_camera_pose
from service.site import Site, save_site


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A scene folder of two cameras and one step."""
    K = np.array([[60.0, 0, 31.5], [0, 60.0, 15.5], [0, 0, 1]])
    cameras = tuple(
        Camera(name, 64, 32, K, pole_camera_pose([0, 0, 6], 0.1 * k, 0.3)) for k, name in enumerate(("north", "east"))
    )
    scene = tmp_path / "data" / "scene-a"
    save_site(Site("a", cameras), scene / "site.json")
    (scene / "boxes").mkdir()
    (scene / "scene.json").write_text(json.dumps({"seed": 3, "world": "straight", "rate_hz": 10.0, "steps": 1}))
    for kind in ("image_2", "depth"):
        (scene / "cameras" / "north" / kind).mkdir(parents=True)
    (scene / "cameras" / "north" / "image_2" / "000000.jpg").write_bytes(b"jpeg")
    depth = np.arange(64 * 32, dtype=np.uint16).reshape(32, 64)
    cv2.imwrite(str(scene / "cameras" / "north" / "depth" / "000000.png"), depth)
    write_truth(scene / "boxes" / "000000.json", 0, truth(), ("north", "east"))
    return scene


def truth() -> SceneTruth:
    rng = np.random.default_rng(0)
    return SceneTruth(
        123_456_789_012_345_678,
        np.array([17, 4]),
        ("Car", "Car"),
        rng.normal(size=(2, 3)),
        rng.uniform(1, 5, (2, 3)),
        rng.uniform(-3, 3, 2),
        rng.normal(size=(2, 3)),
        np.array([[0.93, 0.0], [0.25, 1.0]]),
        np.array([[0.0, 1.0], [0.5, 0.0]]),
    )


def test_truth_comes_back(folder: Path) -> None:
    found, given = open_scene(folder).truth(0), truth()
    assert found.captured_at_ns == given.captured_at_ns
    assert found.classes == given.classes
    for name in ("ids", "center", "dims_lwh", "yaw", "velocity", "visible", "truncated"):
        np.testing.assert_allclose(getattr(found, name), getattr(given, name), atol=1e-6, err_msg=name)


def test_a_camera_that_sees_nothing_of_a_vehicle_is_left_out(folder: Path) -> None:
    boxes = json.loads((folder / "boxes" / "000000.json").read_text())["boxes"]
    assert boxes[0]["visible"] == {"north": 0.93}
    assert boxes[0]["truncated"] == {"north": 0.0}


def test_an_empty_step(folder: Path) -> None:
    (folder / "boxes" / "000000.json").write_text('{"step": 0, "captured_at_ns": 5, "boxes": []}')
    found = open_scene(folder).truth(0)
    assert len(found) == 0
    assert found.center.shape == (0, 3)
    assert found.visible.shape == (0, 2)


def test_frames_and_depth(folder: Path) -> None:
    scene = open_scene(folder)
    assert (scene.steps, scene.rate_hz, scene.camera_ids) == (1, 10.0, ("north", "east"))
    assert scene.frame_bytes("north", 0) == b"jpeg"
    depth = scene.depth("north", 0)
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth.ravel(), np.arange(64 * 32) / 256)


def test_what_is_not_there_is_named(folder: Path) -> None:
    scene = open_scene(folder)
    with pytest.raises(NotFoundError, match="step 1 of 1"):
        scene.truth(1)
    with pytest.raises(NotFoundError, match="south"):
        scene.frame_bytes("south", 0)
    with pytest.raises(NotFoundError, match=r"000000\.jpg"):
        scene.frame_bytes("east", 0)
    with pytest.raises(NotFoundError, match=r"scene\.json"):
        open_scene(folder / "boxes")


def test_damaged_files_are_named(folder: Path) -> None:
    scene = open_scene(folder)
    boxes = folder / "boxes" / "000000.json"
    for text in ("{", '{"boxes": [{}], "captured_at_ns": 1}', "[]"):
        boxes.write_text(text)
        with pytest.raises(InputError, match=r"000000\.json"):
            scene.truth(0)
    (folder / "cameras" / "north" / "depth" / "000000.png").write_bytes(b"no")
    with pytest.raises(InputError, match="PNG"):
        scene.depth("north", 0)
    (folder / "scene.json").write_text('{"steps": "x"}')
    with pytest.raises(InputError, match=r"scene\.json"):
        open_scene(folder)


def test_listing(folder: Path, tmp_path: Path) -> None:
    assert list_scenes(folder.parent) == [folder]
    assert list_scenes(folder) == [folder]
    with pytest.raises(NotFoundError, match="quadlift scenes render"):
        list_scenes(folder / "boxes")
