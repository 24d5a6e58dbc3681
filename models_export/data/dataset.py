"""Scenes on disk: a folder of scene folders, each a site, world boxes with identities, and per camera KITTI files and depth.

<scene>/site.json                           the cameras in the world
<scene>/scene.json                          seed, world, rate_hz, steps, condition, generator
<scene>/boxes/000000.json                   world boxes of one step
<scene>/cameras/<camera>/image_2/000000.jpg
<scene>/cameras/<camera>/label_2/000000.txt KITTI labels, for tools that read them
<scene>/cameras/<camera>/calib/000000.txt
<scene>/cameras/<camera>/depth/000000.png   uint16, metres along the optical axis times 256; 0: none
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from service.errors import InputError, NotFoundError
from service.geometry.transforms import Array
from service.site import Site, load_site

DEPTH_UNITS_PER_M = 256.0
MAX_DEPTH_M = 255.0
UNKNOWN_CONDITION = "unknown"


@dataclass(frozen=True, eq=False)
class SceneTruth:
    """All vehicles of a world at one step: N rows, C cameras in the order of the scene's site."""

    captured_at_ns: int
    ids: NDArray[np.int64]
    """(N,) identities, constant over a scene."""
    classes: tuple[str, ...]
    """N class names, KITTI's."""
    center: Array
    """(N, 3) geometric centres in the world, metres."""
    dims_lwh: Array
    """(N, 3) metres."""
    yaw: Array
    """(N,) radians in [-pi, pi)."""
    velocity: Array
    """(N, 3) m/s in the world."""
    visible: Array
    """(N, C) visible pixels over the pixels inside the image that the vehicle would have alone; 0 where not seen."""
    truncated: Array
    """(N, C) part of the silhouette outside the image, 0..1; 1 where not seen."""
    kinds: tuple[str, ...] = ()
    """N kinds, finer than classes: car, van, truck, bus, pedestrian, cyclist; empty where they are not known."""

    def __len__(self) -> int:
        return len(self.ids)


def step_name(step: int) -> str:
    """File stem of a step."""
    return f"{step:06d}"


def write_truth(path: Path, step: int, truth: SceneTruth, camera_ids: tuple[str, ...]) -> None:
    """Write the boxes of one step."""
    boxes = []
    for k in range(len(truth)):
        seen = [c for c in range(len(camera_ids)) if truth.visible[k, c] > 0]
        boxes.append(
            {
                "id": int(truth.ids[k]),
                "class": truth.classes[k],
                **({"kind": truth.kinds[k]} if truth.kinds else {}),
                "center": _rounded(truth.center[k]),
                "dims_lwh": _rounded(truth.dims_lwh[k]),
                "yaw": round(float(truth.yaw[k]), 6),
                "velocity": _rounded(truth.velocity[k]),
                "visible": {camera_ids[c]: round(float(truth.visible[k, c]), 4) for c in seen},
                "truncated": {camera_ids[c]: round(float(truth.truncated[k, c]), 4) for c in seen},
            }
        )
    document = {"step": step, "captured_at_ns": truth.captured_at_ns, "boxes": boxes}
    path.write_text(json.dumps(document), "utf-8")


def _rounded(values: Array) -> list[float]:
    return [round(float(v), 6) for v in values]


@dataclass(frozen=True, eq=False)
class Scene:
    """One scene folder, read as it is asked for."""

    path: Path
    site: Site
    steps: int
    rate_hz: float
    world: str
    seed: int
    condition: str = UNKNOWN_CONDITION
    """Light and weather: day, night, fog, ..."""

    @cached_property
    def camera_ids(self) -> tuple[str, ...]:
        """Ids of the site's cameras, in order."""
        return tuple(camera.id for camera in self.site.cameras)

    def truth(self, step: int) -> SceneTruth:
        """World boxes of a step. Raises NotFoundError for a step outside the scene, InputError for a damaged file."""
        path = self.path / "boxes" / f"{self._stem(step)}.json"
        document = _json(path)
        try:
            return parse_truth(document, self.camera_ids)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"not a file of boxes: {error!r}.", field=str(path), remedy="Render the scene again.") from error

    def frame_bytes(self, camera_id: str, step: int) -> bytes:
        """The JPEG of a camera at a step. Raises NotFoundError."""
        return _bytes(self._file(camera_id, "image_2", step, "jpg"))

    def depth(self, camera_id: str, step: int) -> NDArray[np.float32]:
        """Depth (H, W) along the optical axis, metres; 0 where there is none. Raises NotFoundError, InputError."""
        path = self._file(camera_id, "depth", step, "png")
        stored = cv2.imdecode(np.frombuffer(_bytes(path), np.uint8), cv2.IMREAD_UNCHANGED)
        if stored is None or stored.dtype != np.uint16 or stored.ndim != 2:
            raise InputError("not a 16-bit grey PNG.", field=str(path), remedy="Render the scene again.")
        return stored.astype(np.float32) / np.float32(DEPTH_UNITS_PER_M)

    def _file(self, camera_id: str, kind: str, step: int, suffix: str) -> Path:
        self.site.camera(camera_id)
        return self.path / "cameras" / camera_id / kind / f"{self._stem(step)}.{suffix}"

    def _stem(self, step: int) -> str:
        if not 0 <= step < self.steps:
            raise NotFoundError(
                f"step {step} of {self.steps}.", field=str(self.path), remedy=f"Steps are 0 to {self.steps - 1}."
            )
        return step_name(step)


def open_scene(path: Path) -> Scene:
    """Open a scene folder. Raises NotFoundError or InputError naming the file that is missing or damaged."""
    document = _json(path / "scene.json")
    try:
        steps, rate_hz = int(document["steps"]), float(document["rate_hz"])
        world, seed = str(document["world"]), int(document["seed"])
        condition = str(document.get("condition", UNKNOWN_CONDITION))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"not a scene: {error!r}.", field=str(path / "scene.json"), remedy="Render the scene again."
        ) from error
    return Scene(path, load_site(path / "site.json"), steps, rate_hz, world, seed, condition)


def list_scenes(root: Path) -> list[Path]:
    """Scene folders of a dataset, by name; a scene folder itself lists as one. Raises NotFoundError when there are none."""
    if (root / "scene.json").is_file():
        return [root]
    found = sorted(path.parent for path in root.glob("*/scene.json"))
    if not found:
        raise NotFoundError("holds no scenes.", field=str(root), remedy="Render some: quadlift scenes render --out DIR.")
    return found


def parse_truth(document: Any, camera_ids: tuple[str, ...]) -> SceneTruth:
    """The truth in a parsed document of boxes. Raises KeyError, TypeError or ValueError when it is none."""
    boxes = document["boxes"]
    n = len(boxes)
    visible = np.array([[b["visible"].get(c, 0.0) for c in camera_ids] for b in boxes], dtype=np.float64)
    truncated = np.array([[b["truncated"].get(c, 1.0) for c in camera_ids] for b in boxes], dtype=np.float64)
    return SceneTruth(
        int(document["captured_at_ns"]),
        np.array([b["id"] for b in boxes], dtype=np.int64),
        tuple(str(b["class"]) for b in boxes),
        np.array([b["center"] for b in boxes], dtype=np.float64).reshape(n, 3),
        np.array([b["dims_lwh"] for b in boxes], dtype=np.float64).reshape(n, 3),
        np.array([b["yaw"] for b in boxes], dtype=np.float64),
        np.array([b["velocity"] for b in boxes], dtype=np.float64).reshape(n, 3),
        visible.reshape(n, len(camera_ids)),
        truncated.reshape(n, len(camera_ids)),
        tuple(str(b.get("kind", b["class"].lower())) for b in boxes),
    )


def _json(path: Path) -> Any:
    try:
        return json.loads(_bytes(path))
    except json.JSONDecodeError as error:
        raise InputError(f"not JSON: {error}.", field=str(path), remedy="Render the scene again.") from error


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise NotFoundError(f"cannot be read: {error}.", field=str(path), remedy="Check the path of the dataset.") from error
