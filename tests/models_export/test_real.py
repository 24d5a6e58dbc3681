"""Recordings as they are read for training: NanoDet's decoding, the traffic videos, PandaSet's cuboids in its cameras."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from benchmarks.drive_centres import road_height
from models_export.data import pandaset_samples, traffic_videos
from models_export.data.detection import ANY_VEHICLE, IGNORED, Labels
from models_export.data.mix import MixConfig
from models_export.data.nanodet import WEIGHTS, in_order, open_nanodet
from models_export.data.pandaset import PandasetBoxes, PandasetClip, open_pandaset
from models_export.data.pandaset_samples import kind_of, pandaset_sample, partial_extents, visible_fraction
from models_export.data.real import RealData
from service.errors import NotFoundError
from service.geometry.camera import Camera, yaw_from_alpha
from service.geometry.transforms import pole_camera_pose, wrap_angle

CLASSES = ("car", "van", "truck", "bus")
DATA = Path(os.environ.get("QUADLIFT_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))


def archive(name: str) -> Path:
    path = DATA / name
    if not path.is_file():
        pytest.skip(f"{path} is absent")
    return path


@pytest.fixture(scope="module")
def drive() -> PandasetClip:
    return open_pandaset(archive(pandaset_samples.ARCHIVE))


def row_of_cars() -> tuple[Camera, PandasetBoxes]:
    """A level camera that looks along +x at three equal cars, one right behind another, and one beside them."""
    K = np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 95.5], [0.0, 0.0, 1.0]])
    center = np.array([[10.0, 0.0, 0.75], [16.0, 0.0, 0.75], [12.0, 5.0, 0.75], [-8.0, 0.0, 0.75]])
    boxes = PandasetBoxes(center, np.tile([4.5, 1.8, 1.5], (4, 1)), np.zeros(4), ("Car",) * 4, tuple("abcd"))
    return Camera("c", 320, 192, K, pole_camera_pose([0.0, 0.0, 1.0], 0.0, 0.0)), boxes


def test_nearer_cars_hide_farther_ones() -> None:
    camera, boxes = row_of_cars()
    visible = visible_fraction(camera, boxes)
    assert visible[0] > 0.95
    assert visible[1] < 0.1
    assert visible[2] > 0.95
    assert visible[3] == 0  # behind the camera


def test_extents_of_a_car_behind_are_empty() -> None:
    camera, boxes = row_of_cars()
    extents, whole = partial_extents(camera, boxes)
    assert whole.tolist() == [True, True, True, False]
    assert np.all(extents[3] == 0)
    assert extents[0, 0] < extents[1, 0] < extents[1, 2] < extents[0, 2]


def test_labels_become_kinds() -> None:
    car = np.array([4.5, 1.8, 1.5])
    assert kind_of("Car", car) == "car"
    assert kind_of("Car", np.array([5.2, 2.0, 2.1])) == ANY_VEHICLE
    assert kind_of("Semi-truck", np.array([9.0, 2.5, 3.0])) == "truck"
    assert kind_of("Other Vehicle - Construction Vehicle", car) == IGNORED
    assert kind_of("Pedestrian", car) is None


def test_headings_come_back_from_alpha(drive: PandasetClip) -> None:
    sample = pandaset_sample(drive, "front_camera", 0, CLASSES, 672)
    assert sample.image_size == (640, 360)
    wanted = ~sample.ignore
    assert wanted.sum() >= 3
    boxes = drive.boxes(0)
    centers = (sample.xyxy_px[:, :2] + sample.xyxy_px[:, 2:]) / 2
    yaw = yaw_from_alpha(sample.camera, sample.alpha, centers)
    for row in np.flatnonzero(wanted):
        same = np.all(np.isclose(boxes.dims_lwh, sample.dims_lwh[row]), axis=1)
        assert np.abs(wrap_angle(boxes.yaw[same] - yaw[row])).min() < 1e-9


def test_the_road_of_a_drive_is_where_its_cars_stand(drive: PandasetClip) -> None:
    """The nominal road, which knows no cuboid, against the bottoms of near cars."""
    for step in (0, 30, 59):
        boxes, camera = drive.boxes(step), drive.camera("front_camera", step)
        near = np.linalg.norm(boxes.center - camera.position_m, axis=1) < 25
        near &= np.array([label == "Car" for label in boxes.labels])
        bottoms = boxes.center[near, 2] - boxes.dims_lwh[near, 2] / 2
        assert road_height(drive, "front_camera", step) == pytest.approx(float(np.median(bottoms)), abs=0.08)


def test_no_step_is_on_both_sides() -> None:
    assert max(pandaset_samples.TRAINING_STEPS) + 5 <= min(pandaset_samples.HELD_OUT_STEPS)


def test_frames_of_the_videos_are_named_and_taught() -> None:
    path = archive(traffic_videos.ARCHIVE)
    frames = dict(traffic_videos.read_frames(path, every=100))
    assert "strudl_vid0/000000" in frames
    assert not any(name.startswith("bgs_video") for name in frames)
    label = Labels(np.array([[0.1, 0.1, 0.3, 0.3]]), (ANY_VEHICLE,))
    (sample,) = traffic_videos.load_videos(path, {"strudl_vid0/000000": label}, CLASSES, 672)
    assert sample.source.split("/")[0] in dict(MixConfig().shares)
    assert not sample.class_known.any()


def test_an_absent_folder_says_so(tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="no such archive"):
        RealData(tmp_path).detection(CLASSES, 672)


def test_outputs_are_ordered_by_kind_and_stride() -> None:
    shapes = [(169, 80), (169, 44), (676, 80), (2704, 80), (676, 44), (2704, 44)]
    ordered = in_order([np.zeros((1, *shape), np.float32) for shape in shapes])
    assert [o.shape for o in ordered] == [(2704, 80), (676, 80), (169, 80), (2704, 44), (676, 44), (169, 44)]


def test_nanodet_finds_the_cars_of_a_real_frame(drive: PandasetClip) -> None:
    nanodet = open_nanodet(archive(WEIGHTS))
    sample = pandaset_sample(drive, "front_camera", 0, CLASSES, nanodet.max_width)
    width, height = sample.image_size
    (found,) = nanodet.detect([np.ascontiguousarray(sample.canvas[:height, :width])])
    # The largest car: each edge of its box within a tenth of the picture's width.
    ahead = sample.xyxy_px[
        np.argmax(np.where(sample.ignore, 0, np.prod(sample.xyxy_px[:, 2:] - sample.xyxy_px[:, :2], axis=1)))
    ]
    assert np.abs(found.xyxy_px - ahead).max(1).min() < width / 10
