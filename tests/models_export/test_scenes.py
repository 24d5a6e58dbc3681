"""What the simulator says about its pictures must be what the pictures show. Needs OpenGL."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import moderngl
import numpy as np
import pytest
from numpy.typing import NDArray

from models_export.data.dataset import SceneTruth, open_scene
from models_export.data.kitti import kitti_to_box, read_calib, read_labels
from models_export.scenes import renderer as renderer_module
from models_export.scenes.film import sample_film
from models_export.scenes.generate import SceneMaker, Step
from models_export.scenes.lamplight import Lamps
from models_export.scenes.lens import Lens
from models_export.scenes.light import WEATHERS, sample_light
from models_export.scenes.mesh import Mesh, MeshBuilder, Surface
from models_export.scenes.plan import Moment
from models_export.scenes.projection import model_matrix
from models_export.scenes.renderer import Cast, Renderer, Shot, open_context
from models_export.scenes.request import SceneRequest
from models_export.scenes.roads import WORLDS
from models_export.scenes.truth import Sight, measure_sight
from models_export.scenes.writer import GENERATOR, render_scene
from service.errors import QuadliftError
from service.geometry.boxes import project_extents
from service.geometry.camera import Camera
from service.geometry.transforms import Array, pole_camera_pose, transform_points


@pytest.fixture(scope="module")
def renderer() -> Iterator[Renderer]:
    try:
        made = Renderer()
    except QuadliftError as error:
        pytest.skip(str(error))
    yield made
    made.release()


@pytest.fixture(scope="module")
def scene(renderer: Renderer) -> tuple[SceneMaker, Step]:
    maker = SceneMaker(SceneRequest(5, "intersection", steps=1, vehicles=18, weather="day"), renderer)
    return maker, next(maker.steps())


@pytest.fixture(scope="module")
def folder(renderer: Renderer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scenes") / "straight-3"
    with ThreadPoolExecutor(2) as pool:
        list(render_scene(SceneRequest(3, "straight", steps=2, rate_hz=2.0), path, renderer, pool))
    return path


def boxes_alone(
    renderer: Renderer, poses: list[list[float]], dims: list[float], camera: Camera, wall: float | None = None
) -> tuple[Shot, Sight, tuple[Array, Array, Array]]:
    """A shot of plain boxes on bare ground, perhaps with a wall across x = ``wall``."""
    builder = MeshBuilder()
    builder.quads([[-90, -90, 0], [90, -90, 0], [90, 90, 0], [-90, 90, 0]], Surface((0.4, 0.4, 0.4)))
    if wall is not None:
        builder.box([wall, -60, 0], [wall + 0.2, 60, 30], Surface((0.6, 0.6, 0.6)))
    solid = MeshBuilder()
    low, high = -0.5 * np.array(dims), 0.5 * np.array(dims)
    solid.box(low, high, Surface((0.7, 0.1, 0.1)))
    renderer.set_scene(builder.build(), 1)
    ids = list(range(1, len(poses) + 1))
    renderer.keep_actors(dict.fromkeys(ids, solid.build()))
    placed = {k: model_matrix(np.array(p), dims[2]) for k, p in zip(ids, poses, strict=True)}
    rng = np.random.default_rng(0)
    light = sample_light(rng, "day")
    cast = Cast(ids, placed, np.array([[*p, dims[0], dims[1], 0.0] for p in poses]), Lamps.none())
    renderer.cast_light(light, cast)
    lens = Lens(camera)
    shot = renderer.shoot(lens.source, light, sample_film(rng, light), cast)
    arrays = (
        np.array([[p[0], p[1], dims[2] / 2] for p in poses]),
        np.array([dims] * len(poses)),
        np.array([p[2] for p in poses]),
    )
    return lens.bend(shot), measure_sight(renderer, lens, shot, cast, arrays), arrays


BARREL = np.array([-0.12, 0.01, 0.001, -0.0008, 0.0])


def pole(distortion: Array | None = None) -> Camera:
    K = np.array([[700.0, 0, 640.2], [0, 700.0, 190.3], [0, 0, 1]])
    pose = pole_camera_pose([0, 0, 6.5], 0.0, 0.3, 0.01)
    return Camera("pole", 1284, 384, K, pose, np.zeros(0) if distortion is None else distortion)


def mask_extents(mask: NDArray[np.bool_]) -> list[int]:
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return [columns[0], rows[0], columns[-1], rows[-1]]


@pytest.mark.parametrize("distortion", [None, BARREL, -0.4 * BARREL], ids=["pinhole", "barrel", "pincushion"])
def test_projected_boxes_are_where_their_pixels_are(renderer: Renderer, distortion: Array | None) -> None:
    camera = pole(distortion)
    poses = [[15, -8, 0.3], [18, 5, 1.2], [30, -6, -2.0], [35, 12, 2.6], [55, 0, 0.9], [24, 0.5, 0.0]]
    shot, sight, arrays = boxes_alone(renderer, poses, [4.2, 1.8, 1.5], camera)
    xyxy, _ = project_extents(camera, *arrays)
    seen = np.flatnonzero((sight.visible > 0.99) & (sight.truncated < 0.001))
    assert len(seen) >= 5
    error = np.array([mask_extents(shot.instance == k + 1) for k in seen]) - xyxy[seen]
    # A pixel counts when its centre is covered: masks end at most one pixel within the true outline, and a bent edge
    # bulges a little beyond its corners.
    assert np.median(np.abs(error)) < (0.6 if distortion is None else 0.8)
    assert np.abs(error).max() < (1.6 if distortion is None else 2.5)
    # Half a pixel of offset in either direction would show as a shift of the middle.
    assert np.abs((error[:, :2] + error[:, 2:]).mean(0) / 2).max() < 0.3


def cuboid(dims_lwh: Array) -> Mesh:
    solid = MeshBuilder()
    solid.box(-0.5 * dims_lwh, 0.5 * dims_lwh, Surface((0.7, 0.1, 0.1)))
    return solid.build()


def unoccluded(maker: SceneMaker, moment: Moment) -> Iterator[tuple[int, NDArray[np.int64], Camera, SceneTruth]]:
    """Index, mask extents, camera and truth of all that a rendered moment shows whole."""
    step = maker.render(moment)
    for c, (camera, shot) in enumerate(zip(maker.plan.site.cameras, step.shots, strict=True)):
        for k in np.flatnonzero((step.truth.visible[:, c] > 0.97) & (step.truth.truncated[:, c] < 1e-3)):
            yield int(k), np.array(mask_extents(shot.instance == k + 1)), camera, step.truth


@pytest.mark.parametrize("distorted", [False, True], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("world", WORLDS)
def test_boxes_of_all_worlds_project_onto_their_masks(renderer: Renderer, world: str, distorted: bool) -> None:
    errors, gaps = [], []
    for seed in (5, 6, 7):
        maker = SceneMaker(SceneRequest(seed, world, steps=1, vehicles=20, distorted=distorted), renderer)
        moment = next(maker.plan.moments())
        maker.start()
        for k, mask, camera, truth in unoccluded(maker, moment):
            # The smooth body agrees with its own mesh, and stays within its box.
            matrix = model_matrix(moment.poses[k], truth.dims_lwh[k, 2], moment.ground[k])
            pixels, _ = camera.project(transform_points(matrix, moment.models[k].mesh.corners.reshape(-1, 3)))
            gaps.append(np.abs(mask - np.array([*pixels.min(0), *pixels.max(0)])))
        maker.start()
        plain = [replace(m, build=partial(cuboid, m.dims_lwh)) for m in moment.models]
        for k, mask, camera, truth in unoccluded(maker, replace(moment, models=plain)):
            xyxy, _ = project_extents(camera, truth.center[[k]], truth.dims_lwh[[k]], truth.yaw[[k]])
            errors.append(np.abs(mask - xyxy[0]))
    assert min(len(errors), len(gaps)) > 8
    assert np.median(errors) < 0.8
    assert np.median(gaps) < 0.8


def test_smooth_bodies_stay_within_their_boxes(scene: tuple[SceneMaker, Step]) -> None:
    maker, step = scene
    truth, seen = step.truth, 0
    for c, (camera, shot) in enumerate(zip(maker.plan.site.cameras, step.shots, strict=True)):
        xyxy, _ = project_extents(camera, truth.center, truth.dims_lwh, truth.yaw)
        for k in np.flatnonzero((truth.visible[:, c] > 0.97) & (truth.truncated[:, c] < 1e-3)):
            mask = np.array(mask_extents(shot.instance == k + 1))
            assert np.all(mask[:2] >= xyxy[k, :2] - 1)
            assert np.all(mask[2:] <= xyxy[k, 2:] + 1)
            seen += 1
    assert seen > 5


def test_depth_is_along_the_optical_axis(scene: tuple[SceneMaker, Step]) -> None:
    maker, step = scene
    for camera, shot in zip(maker.plan.site.cameras, step.shots, strict=True):
        v, u = np.mgrid[200:384:9, 0:1284:13]
        background = (shot.instance[v, u] == 0) & (shot.depth[v, u] > 0)
        points = camera.unproject(np.stack([u, v], -1)[background], shot.depth[v, u][background] / 256.0)
        # Most of the lower picture is road at z = 0 or sidewalk at z = 0.13.
        assert np.mean((np.abs(points[:, 2]) < 0.05) | (np.abs(points[:, 2] - 0.13) < 0.05)) > 0.7


def test_depth_of_vehicles_lies_in_their_boxes(scene: tuple[SceneMaker, Step]) -> None:
    maker, step = scene
    truth = step.truth
    for camera, shot in zip(maker.plan.site.cameras, step.shots, strict=True):
        v, u = np.nonzero(shot.instance)
        k = shot.instance[v, u].astype(int) - 1
        offset = camera.unproject(np.stack([u, v], -1), shot.depth[v, u] / 256.0) - truth.center[k]
        c, s = np.cos(truth.yaw[k]), np.sin(truth.yaw[k])
        local = np.stack([c * offset[:, 0] + s * offset[:, 1], -s * offset[:, 0] + c * offset[:, 1], offset[:, 2]], -1)
        near = camera.project(truth.center[k])[1] < 60
        assert np.all(np.abs(local[near]) <= truth.dims_lwh[k[near]] / 2 + 0.02)


def test_visible_fraction_of_known_arrangements(renderer: Renderer) -> None:
    dims = [4.0, 1.8, 1.5]
    _, alone, _ = boxes_alone(renderer, [[25, 0, 0.4]], dims, pole())
    assert alone.visible[0] == pytest.approx(1.0, abs=0.02)
    assert alone.truncated[0] == pytest.approx(0.0, abs=1e-6)
    _, hidden, _ = boxes_alone(renderer, [[25, 0, 0.4]], dims, pole(), wall=20.0)
    assert hidden.visible[0] == 0.0
    # Level camera, box across the image's left edge: half of its front stands outside.
    level = Camera(
        "level", 1284, 384, np.array([[700.0, 0, 641.5], [0, 700.0, 191.5], [0, 0, 1]]), pole_camera_pose([0, 0, 0.75], 0, 0)
    )
    edge = 20 * 642 / 700
    _, cut, _ = boxes_alone(renderer, [[20.05, edge, np.pi / 2]], [4.0, 0.1, 1.5], level)
    assert cut.truncated[0] == pytest.approx(0.5, abs=0.03)
    assert cut.visible[0] == pytest.approx(1.0, abs=0.03)


def test_same_seed_same_bytes(renderer: Renderer, folder: Path, tmp_path: Path) -> None:
    with ThreadPoolExecutor(2) as pool:
        list(render_scene(SceneRequest(3, "straight", steps=2, rate_hz=2.0), tmp_path / "again", renderer, pool))
        list(render_scene(SceneRequest(4, "straight", steps=1, rate_hz=2.0), tmp_path / "other", renderer, pool))
    files = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    assert len(files) == 2 * (4 * 4 + 1) + 2
    for file in files:
        assert (folder / file).read_bytes() == (tmp_path / "again" / file).read_bytes(), file
    assert (folder / "boxes" / "000000.json").read_bytes() != (tmp_path / "other" / "boxes" / "000000.json").read_bytes()


def test_files_agree_with_each_other(folder: Path) -> None:
    scene = open_scene(folder)
    truth = scene.truth(1)
    assert truth.captured_at_ns - scene.truth(0).captured_at_ns == 500_000_000
    labelled = 0
    for c, camera in enumerate(scene.site.cameras):
        image = cv2.imdecode(np.frombuffer(scene.frame_bytes(camera.id, 1), np.uint8), cv2.IMREAD_COLOR)
        assert image.shape == (camera.height, camera.width, 3) == (*scene.depth(camera.id, 1).shape, 3)
        calib = read_calib(folder / "cameras" / camera.id / "calib" / "000001.txt")
        np.testing.assert_allclose(calib.P2[:, :3], camera.K)
        labels = read_labels(folder / "cameras" / camera.id / "label_2" / "000001.txt")
        assert len(labels) == np.sum(truth.visible[:, c] > 0)
        for label in labels:
            center, yaw = kitti_to_box(camera, [label.location], [label.rotation_y], [label.dims_hwl[0]])
            k = np.linalg.norm(truth.center - center, axis=1).argmin()
            # Far below the centimetre and the tenth of a degree that labels must keep.
            np.testing.assert_allclose(center[0], truth.center[k], atol=1e-4)
            np.testing.assert_allclose(np.exp(1j * yaw[0]), np.exp(1j * truth.yaw[k]), atol=1e-4)
            np.testing.assert_allclose(label.dims_hwl, truth.dims_lwh[k, [2, 1, 0]], atol=1e-5)
            assert label.type == truth.classes[k]
            labelled += 1
    assert labelled > 4
    assert set(truth.kinds) <= {"car", "van", "truck", "bus", "pedestrian", "cyclist"}
    document = json.loads((folder / "scene.json").read_text())
    assert document["generator"] == GENERATOR == "quadlift-scenes 2"
    assert document["condition"] in WEATHERS


def test_pictures_are_neither_black_nor_burnt_out(scene: tuple[SceneMaker, Step]) -> None:
    for shot in scene[1].shots:
        assert 50 < shot.image.mean() < 200
        assert shot.image.std() > 20


def test_without_opengl_the_error_names_the_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(**_: object) -> None:
        raise RuntimeError("libEGL.so.1 not found")

    monkeypatch.setattr(renderer_module.moderngl, "create_context", fail)
    with pytest.raises(QuadliftError, match="libegl1 libgl1-mesa-dri libgles2"):
        open_context()
    assert moderngl is renderer_module.moderngl
