"""Meshes of vehicles and people: exact extents, smooth bodies, fronts that differ from rears."""

from __future__ import annotations

import numpy as np
import pytest

from models_export.scenes.actor import KITTI_CLASS, VEHICLE_KINDS, ActorModel
from models_export.scenes.mesh import MeshBuilder, Surface
from models_export.scenes.people import sample_walkers
from models_export.scenes.roads import build_world
from models_export.scenes.vehicles import STYLES, sample_vehicle


def one_of_each(lamps_on: bool = False) -> dict[str, ActorModel]:
    rng = np.random.default_rng(1)
    found: dict[str, ActorModel] = {}
    for _ in range(900):
        model = sample_vehicle(rng, lamps_on=lamps_on)
        found.setdefault(model.shape, model)
    return found


@pytest.fixture(scope="module")
def fleet() -> dict[str, ActorModel]:
    return one_of_each()


def test_all_styles_are_on_the_road(fleet: dict[str, ActorModel]) -> None:
    assert set(fleet) == {style.name for style in STYLES}
    assert {model.kind for model in fleet.values()} == set(VEHICLE_KINDS)
    assert {KITTI_CLASS[kind] for kind in VEHICLE_KINDS} == {"Car", "Van", "Truck"}


def test_meshes_are_exactly_as_large_as_their_label(fleet: dict[str, ActorModel]) -> None:
    for style in STYLES:
        model = fleet[style.name]
        low, high = model.mesh.extents()
        np.testing.assert_allclose(high - low, model.dims_lwh, atol=1e-9)
        np.testing.assert_allclose(high + low, 0, atol=1e-9)
        for size, (least, most) in zip(model.dims_lwh, (style.length_m, style.width_m, style.height_m), strict=True):
            assert least <= size <= most


def test_bodies_are_smooth(fleet: dict[str, ActorModel]) -> None:
    for model in fleet.values():
        assert len(model.mesh) >= 1500
        np.testing.assert_allclose(np.linalg.norm(model.mesh.normals, axis=-1), 1, atol=1e-9)
        assert np.all(np.isfinite(model.mesh.corners))


def test_bodies_fill_their_boxes(fleet: dict[str, ActorModel]) -> None:
    """The stretch to the label's size is small: the builders aim at it, so wheels stay round."""
    for model in fleet.values():
        points = model.mesh.corners.reshape(-1, 3) / model.dims_lwh
        # Something of the body is near each face of the box, over much of its length.
        sides = np.abs(points[:, 1]) > 0.47
        assert np.ptp(points[sides, 0]) > 0.55
        assert np.ptp(points[points[:, 2] < -0.49, 0]) > 0.4


def test_front_and_rear_look_different(fleet: dict[str, ActorModel]) -> None:
    for model in fleet.values():
        mesh, length = model.mesh, model.dims_lwh[0]
        middle = mesh.corners.mean(1)
        lamps = mesh.looks[:, 6] > 0
        red = lamps & (mesh.looks[:, 0] > 2 * mesh.looks[:, 1].astype(int))
        assert middle[red, 0].max() < -0.4 * length
        assert middle[lamps & ~red, 0].min() > 0.4 * length


def test_both_sides_are_alike(fleet: dict[str, ActorModel]) -> None:
    for model in fleet.values():
        area = np.linalg.norm(
            np.cross(model.mesh.corners[:, 1] - model.mesh.corners[:, 0], model.mesh.corners[:, 2] - model.mesh.corners[:, 0]),
            axis=1,
        )
        y = model.mesh.corners.mean(1)[:, 1]
        assert area[y > 1e-6].sum() == pytest.approx(area[y < -1e-6].sum(), rel=2e-3)


def test_lamps_sit_at_the_ends_and_only_when_lit(fleet: dict[str, ActorModel]) -> None:
    assert all(len(model.head_lamps) == 0 for model in fleet.values())
    for model in one_of_each(lamps_on=True).values():
        half = 0.5 * model.dims_lwh
        assert model.head_lamps.shape == model.tail_lamps.shape == (2, 3)
        assert np.all(model.head_lamps[:, 0] > 0.9 * half[0])
        assert np.all(model.tail_lamps[:, 0] < -0.9 * half[0])
        assert np.all(np.abs(np.vstack([model.head_lamps, model.tail_lamps])) <= half)


def test_people_have_exact_boxes() -> None:
    rng = np.random.default_rng(3)
    kinds = set()
    for walker in sample_walkers(build_world("straight", rng), rng, 24):
        low, high = walker.model.mesh.extents()
        np.testing.assert_allclose(high - low, walker.model.dims_lwh, atol=1e-9)
        np.testing.assert_allclose(high + low, 0, atol=1e-9)
        assert 1.4 < walker.model.dims_lwh[2] < 2.0
        kinds.add(walker.model.kind)
    assert kinds == {"pedestrian", "cyclist"}


def test_normals_point_outwards() -> None:
    builder = MeshBuilder()
    builder.box([-1, -1, -1], [1, 1, 1], Surface((1, 1, 1)))
    mesh = builder.build()
    assert np.all(np.einsum("fvk,fvk->fv", mesh.corners, mesh.normals) > 0)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=-1), 1)
    vertices, indices = mesh.buffers()
    assert len(vertices) == 32 * 20
    assert len(indices) == 4 * 3 * len(mesh)
