"""Lifting on KITTI's labels: 2D boxes (true ones, then a detector's) into 3D, against the labelled 3D boxes."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.geometry_scores import METHODS, Row, Sigmas, lift_all, measurements_of, score
from benchmarks.recordings import recording
from models_export.data.kitti import KittiCalib, KittiObject, kitti_to_box, read_calib, read_labels
from service.geometry.camera import Camera
from service.geometry.ground import GroundPlane
from service.geometry.iou import iou_2d
from service.geometry.transforms import Array, pole_camera_pose, rigid
from service.lifting import LiftSettings

ARCHIVE = "kitti_text.zip"
ROOT = "kitti/training/"
RANGE_M = 40.0
CAMERA_HEIGHT_M = 1.65
"""Nominal height of KITTI's camera above the road."""
MATCH_IOU = 0.7
YAW_SIGMA_RAD = float(np.deg2rad(4.0))
TRUE_SIZE_SIGMA_M, TRUE_YAW_SIGMA_RAD = 0.01, 0.005
"""Labels are rounded to a centimetre and a hundredth of a radian."""
TRUE_BOX_SIGMA_PX = np.array([0.6, 0.6, 0.2, 0.7])
"""How far labelled 2D boxes lie from the projected 3D ones, left top right bottom (rms without the worst 1 %)."""
DETECTED_BOX_SIGMA_PX = np.array([4.3, 2.2, 3.9, 2.5])
"""The same of the detector's boxes (1.48 times the median deviation)."""
NO_GROUND = LiftSettings(ground_sigma_m=1e3)
GROUNDS = {
    "none": NO_GROUND,
    "plane 0.06 m + 0.008 Z": LiftSettings(ground_sigma_m=0.06, ground_sigma_per_m=0.008),
    "plane 0.10 m constant": LiftSettings(ground_sigma_m=0.10, ground_sigma_per_m=0.0),
    "plane 0.10 m constant, squared": LiftSettings(ground_sigma_m=0.10, ground_sigma_per_m=0.0, ground_tail_sigmas=1e9),
}


@dataclass(frozen=True, eq=False)
class KittiCars:
    """The untruncated cars within range, all frames together, in a world whose z = 0 is the nominal road."""

    cameras: list[Camera]
    camera_index: NDArray[np.int64]
    """(N,)."""
    xyxy_px: Array
    """(N, 4) labelled 2D boxes."""
    detected_px: Array
    """(N, 4) the detector's boxes; NaN for cars it has no box on with IoU >= 0.7."""
    truth: Array
    """(N, 7) x y z l w h yaw."""

    def take(self, index: NDArray[np.bool_]) -> KittiCars:
        """The cars at a mask (N,)."""
        return KittiCars(self.cameras, *(getattr(self, f.name)[index] for f in fields(self)[1:]))


def load_cars() -> KittiCars:
    """All counted cars of the recording. Raises NotFoundError when it is not there."""
    with zipfile.ZipFile(recording(ARCHIVE)) as archive:
        return _gather(list(_frames(zipfile.Path(archive, ROOT))))


def _frames(root: Any) -> Iterator[tuple[KittiCalib, list[KittiObject], list[KittiObject]]]:
    """Calibration, labels and detections of every frame, in order."""
    names = sorted(entry.name for entry in (root / "label_2").iterdir())
    for name in names:
        yield tuple(read(root / folder / name) for read, folder in _FOLDERS)  # type: ignore[misc]


_FOLDERS = ((read_calib, "calib"), (read_labels, "label_2"), (read_labels, "2d_detections"))


def _gather(frames: list[tuple[KittiCalib, list[KittiObject], list[KittiObject]]]) -> KittiCars:
    """Frames with the same projection share a camera; the image's size is where its labels end."""
    keys = [calib.P2.tobytes() for calib, _, _ in frames]
    sizes: dict[bytes, Array] = {}
    for key, (_, objects, _) in zip(keys, frames, strict=True):
        ends = np.array([o.bbox_xyxy[2:] for o in objects], dtype=np.float64).reshape(-1, 2).max(0, initial=0.0)
        sizes[key] = np.maximum(sizes.get(key, np.zeros(2)), np.ceil(ends) + 1.0)
    cameras = [_camera(np.frombuffer(key).reshape(3, 4), size) for key, size in sizes.items()]
    number = {key: index for index, key in enumerate(sizes)}
    index, boxes, found, truth = [], [], [], []
    for key, (_, objects, detections) in zip(keys, frames, strict=True):
        cars = [o for o in objects if o.type == "Car" and o.truncated == 0 and o.location[2] <= RANGE_M]
        if cars:
            mine = np.array([o.bbox_xyxy for o in cars])
            index += [number[key]] * len(cars)
            boxes.append(mine)
            found.append(_matched(mine, np.array([d.bbox_xyxy for d in detections if d.type == "Car"]).reshape(-1, 4)))
            truth.append(_truth(cameras[number[key]], cars))
    return KittiCars(cameras, np.array(index), *(np.concatenate(part) for part in (boxes, found, truth)))


def _camera(P2: Array, size: Array) -> Camera:
    """The colour camera, looking East from the nominal height; KITTI's frame is that of the grey camera beside it."""
    K = P2[:, :3]
    level = pole_camera_pose([0.0, 0.0, CAMERA_HEIGHT_M], 0.0, 0.0)
    T_cam_grey = rigid(np.eye(3), np.linalg.solve(K, P2[:, 3]))
    return Camera("kitti", int(size[0]), int(size[1]), K, T_cam_grey @ level)


def _truth(camera: Camera, cars: list[KittiObject]) -> Array:
    """States (N, 7) in the world."""
    hwl = np.array([o.dims_hwl for o in cars])
    grey = replace(camera, T_cam_world=pole_camera_pose([0.0, 0.0, CAMERA_HEIGHT_M], 0.0, 0.0))
    center, yaw = kitti_to_box(grey, [o.location for o in cars], [o.rotation_y for o in cars], hwl[:, 0])
    return np.concatenate([center, hwl[:, ::-1], yaw[:, None]], 1)


def _matched(boxes: Array, detections: Array) -> Array:
    """For each label (N, 4) the detection of greatest IoU; NaN below ``MATCH_IOU``."""
    if len(detections) == 0:
        return np.full_like(boxes, np.nan)
    iou = iou_2d(boxes, detections)
    best = iou.argmax(1)
    return np.where((iou.max(1) >= MATCH_IOU)[:, None], detections[best], np.nan)


def run_kitti(seed: int = 0, every: int = 1) -> dict[str, dict[str, Row]]:
    """Each experiment's rows by ``method, ground``, on every n-th car.

    The paper's method knows no ground, so it has one row an experiment.
    """
    cars = load_cars()
    cars = cars.take(np.arange(len(cars.truth)) % every == 0)
    rng = np.random.default_rng(seed)
    turned = cars.truth[:, 6] + YAW_SIGMA_RAD * rng.normal(size=len(cars.truth))
    mean, spread = cars.truth[:, 3:6].mean(0), cars.truth[:, 3:6].std(0)
    means = np.broadcast_to(mean, (len(turned), 3))
    exact = Sigmas(TRUE_BOX_SIGMA_PX, np.full(3, TRUE_SIZE_SIGMA_M), TRUE_YAW_SIGMA_RAD)
    guessed = Sigmas(TRUE_BOX_SIGMA_PX, spread, YAW_SIGMA_RAD)
    seen = np.isfinite(cars.detected_px).all(1)
    detected = replace(cars.take(seen), xyxy_px=cars.detected_px[seen])
    return {
        "true boxes, sizes and yaw": _rows(cars, cars.truth[:, 3:6], cars.truth[:, 6], exact, {"none": NO_GROUND}),
        "true boxes, mean sizes, yaw + 4 deg": _rows(cars, means, turned, guessed, GROUNDS),
        "detected boxes, mean sizes, yaw + 4 deg": _rows(
            detected, means[seen], turned[seen], replace(guessed, px=DETECTED_BOX_SIGMA_PX), GROUNDS
        ),
    }


def _rows(cars: KittiCars, dims: Array, yaw: Array, sigmas: Sigmas, grounds: dict[str, LiftSettings]) -> dict[str, Row]:
    measured = measurements_of(cars.camera_index, cars.xyxy_px, dims, yaw, sigmas)
    rows = {}
    for method in METHODS:
        for name, settings in grounds.items() if method == "map" else [("none", NO_GROUND)]:
            boxes = lift_all(method, cars.cameras, GroundPlane(), measured, settings)
            rows[f"{method}, ground: {name}"] = score(boxes, cars.truth)
    return rows
