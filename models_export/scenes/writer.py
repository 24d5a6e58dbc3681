"""Scene folders: what :mod:`models_export.data.dataset` reads."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np

from models_export.data.dataset import step_name, write_truth
from models_export.data.kitti import calib_of, write_calib, write_labels
from models_export.data.labels import kitti_labels
from models_export.scenes.film import develop, encode
from models_export.scenes.generate import SceneMaker, Step
from models_export.scenes.plan import ScenePlan
from models_export.scenes.renderer import Renderer, Shot
from models_export.scenes.request import SceneRequest
from service.geometry.camera import Camera
from service.site import save_site

GENERATOR = "quadlift-scenes 2"
_PNG_SPEED = [cv2.IMWRITE_PNG_COMPRESSION, 1]


def scene_document(plan: ScenePlan) -> dict[str, object]:
    """``scene.json``: the request, what was drawn for it, and the generator."""
    document = asdict(plan.request)
    del document["weather"]
    axes = [round(axis, 6) for axis in plan.axes_rad]
    return {**document, "condition": plan.light.weather, "axes_rad": axes, "generator": GENERATOR}


class SceneWriter:
    """Writes a scene folder; encoding runs on threads while the next step renders."""

    def __init__(self, maker: SceneMaker, path: Path, pool: ThreadPoolExecutor) -> None:
        self._plan, self._path, self._pool = maker.plan, path, pool
        self._pending: list[Future[None]] = []
        for camera in self._plan.site.cameras:
            for kind in ("image_2", "label_2", "calib", "depth"):
                if kind != "calib" or not camera.has_distortion:
                    (path / "cameras" / camera.id / kind).mkdir(parents=True, exist_ok=True)
        (path / "boxes").mkdir(exist_ok=True)
        save_site(self._plan.site, path / "site.json")

    def add(self, step: Step) -> None:
        """Write one step."""
        ids = tuple(camera.id for camera in self._plan.site.cameras)
        write_truth(self._path / "boxes" / f"{step_name(step.index)}.json", step.index, step.truth, ids)
        # A few steps in flight at most: frames are large.
        while len(self._pending) >= 3 * len(ids):
            self._pending.pop(0).result()
        for index, (camera, shot) in enumerate(zip(self._plan.site.cameras, step.shots, strict=True)):
            self._pending.append(self._pool.submit(self._write_camera, index, camera, step, shot))

    def close(self) -> None:
        """Wait for the files, then mark the scene complete by writing ``scene.json``."""
        for pending in self._pending:
            pending.result()
        (self._path / "scene.json").write_text(json.dumps(scene_document(self._plan), indent=1), "utf-8")

    def _write_camera(self, index: int, camera: Camera, step: Step, shot: Shot) -> None:
        folder, name = self._path / "cameras" / camera.id, step_name(step.index)
        seed, film = (self._plan.request.seed, step.index, index), self._plan.films[index]
        (folder / "image_2" / f"{name}.jpg").write_bytes(encode(develop(shot.image, film, seed), film))
        encoded, png = cv2.imencode(".png", np.ascontiguousarray(shot.depth), _PNG_SPEED)
        assert encoded
        (folder / "depth" / f"{name}.png").write_bytes(png.tobytes())
        write_labels(folder / "label_2" / f"{name}.txt", kitti_labels(camera, index, step.truth))
        # KITTI's calibration cannot say how a lens distorts; site.json does.
        if not camera.has_distortion:
            write_calib(folder / "calib" / f"{name}.txt", calib_of(camera))


def render_scene(request: SceneRequest, path: Path, renderer: Renderer, pool: ThreadPoolExecutor) -> Iterator[Step]:
    """Render one scene into a folder, yielding each step when it is drawn."""
    maker = SceneMaker(request, renderer)
    writer = SceneWriter(maker, path, pool)
    for step in maker.steps():
        writer.add(step)
        yield step
    writer.close()
