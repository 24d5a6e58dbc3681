"""Vehicles, traffic, lights and cameras of the simulator; no OpenGL needed."""

from __future__ import annotations

import numpy as np
import pytest

from models_export.scenes.cameras import pole_cameras
from models_export.scenes.light import CONDITIONS, sample_film, sample_light
from models_export.scenes.mesh import MeshBuilder, Surface
from models_export.scenes.roads import build_world
from models_export.scenes.traffic import Traffic
from models_export.scenes.vehicles import SHAPES, sample_vehicle
from service.geometry.iou import intersection_bev


def test_meshes_are_exactly_as_large_as_their_label() -> None:
    rng = np.random.default_rng(1)
    shapes = set()
    for _ in range(70):
        vehicle = sample_vehicle(rng)
        low, high = vehicle.mesh.extents()
        np.testing.assert_allclose(high - low, vehicle.dims_lwh, atol=1e-9)
        np.testing.assert_allclose(high + low, 0, atol=1e-9)
        assert np.all(vehicle.dims_lwh >= [3.6, 1.65, 1.4])
        assert np.all(vehicle.dims_lwh <= [5.2, 2.0, 1.95])
        shapes.add(vehicle.shape)
    assert len(shapes) == len(SHAPES)


def test_front_and_rear_look_different() -> None:
    mesh = sample_vehicle(np.random.default_rng(2)).mesh
    length = np.ptp(mesh.corners[..., 0])
    middle = mesh.corners.mean(1)
    lamps = mesh.looks[:, 6] > 0
    red = lamps & (mesh.looks[:, 0] > 2 * mesh.looks[:, 1].astype(int))
    assert middle[red, 0].max() < -0.4 * length
    assert middle[lamps & ~red, 0].min() > 0.4 * length


def test_normals_point_outwards() -> None:
    builder = MeshBuilder()
    builder.box([-1, -1, -1], [1, 1, 1], Surface((1, 1, 1)))
    mesh = builder.build()
    assert np.all(np.einsum("fvk,fvk->fv", mesh.corners, mesh.normals) > 0)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=-1), 1)
    vertices, indices = mesh.buffers()
    assert len(vertices) == 32 * 20
    assert len(indices) == 4 * 3 * len(mesh)


@pytest.mark.parametrize(("kind", "seed"), [("intersection", 0), ("intersection", 8), ("straight", 1), ("straight", 5)])
def test_vehicles_move_and_never_overlap(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    traffic = Traffic(build_world(kind, rng), rng, moving=16, parked=4)
    travelled: dict[int, float] = {}
    for _ in range(60):
        before = {v.id: v.pose()[:2] for v in traffic.vehicles}
        traffic.step(0.5)
        poses = np.array([v.pose() for v in traffic.vehicles])
        dims = np.array([v.model.dims_lwh for v in traffic.vehicles])
        overlap = intersection_bev(poses[:, :2], dims[:, :2], poses[:, 2], poses[:, :2], dims[:, :2], poses[:, 2])
        np.fill_diagonal(overlap, 0)
        assert overlap.max() < 1e-6
        for v in traffic.vehicles:
            if v.id in before:
                step = float(np.linalg.norm(v.pose()[:2] - before[v.id]))
                assert step < 0.5 * 22
                travelled[v.id] = travelled.get(v.id, 0.0) + step
    moved = [travelled.get(v.id, 0.0) for v in traffic.vehicles if v.route is not None]
    assert np.mean(moved) > 15
    assert all(travelled[v.id] == 0 for v in traffic.vehicles if v.route is None)


def test_velocity_is_what_positions_do() -> None:
    rng = np.random.default_rng(3)
    traffic = Traffic(build_world("intersection", rng), rng, moving=10, parked=0)
    traffic.step(5.0)
    before = {v.id: (v.pose(), v.velocity()) for v in traffic.vehicles}
    traffic.step(0.05)
    after = {v.id: (v.pose(), v.velocity()) for v in traffic.vehicles}
    kept = [k for k in before if k in after]
    assert len(kept) > 5
    for k in kept:
        mean = 0.5 * (before[k][1] + after[k][1])[:2]
        np.testing.assert_allclose((after[k][0] - before[k][0])[:2] / 0.05, mean, atol=0.25)


def test_vehicles_turn_at_the_intersection() -> None:
    world = build_world("intersection", np.random.default_rng(4))
    turns = []
    for route in world.routes:
        steps = np.diff(route.points, axis=0)
        heading = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
        assert np.abs(np.diff(heading)).max() < 0.2
        turns.append(round(float(heading[-1] - heading[0]) / (np.pi / 2)))
    assert set(turns) == {-1, 0, 1}


@pytest.mark.parametrize("kind", ["intersection", "straight"])
def test_cameras_stand_where_they_should(kind: str) -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        world = build_world(kind, rng)
        cameras = pole_cameras(world.poles, 4, rng)
        assert [c.id for c in cameras] == ["north", "west", "south", "east"]
        for camera in cameras:
            assert (camera.width, camera.height) == (1284, 384)
            assert 5 <= camera.position_m[2] <= 8
            axis = camera.T_world_cam[:3, 2]
            assert 10 - 1e-6 <= np.rad2deg(np.arcsin(-axis[2])) <= 25 + 1e-6
            assert 560 <= camera.K[0, 0] <= 800
            clear = min(np.linalg.norm(r.points - camera.position_m[:2], axis=1).min() for r in world.routes)
            assert clear > 1.5


def test_more_cameras_than_poles_get_their_own_ids() -> None:
    rng = np.random.default_rng(0)
    ids = [c.id for c in pole_cameras(build_world("straight", rng).poles, 6, rng)]
    assert len(set(ids)) == 6


@pytest.mark.parametrize("condition", CONDITIONS)
def test_lights(condition: str) -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        light = sample_light(rng, condition)
        assert light.condition == condition
        assert np.linalg.norm(light.sun_direction) == pytest.approx(1)
        assert light.sun_direction[2] > 0
        assert 75 <= sample_film(rng, light).jpeg_quality <= 95
