"""Worlds, traffic, lights and cameras of the simulator; no OpenGL needed."""

from __future__ import annotations

import numpy as np
import pytest

from models_export.scenes.cameras import RIGS, Optics, mounts_of, rig_cameras
from models_export.scenes.film import QUALITIES, develop, encode, sample_film
from models_export.scenes.layout import resampled
from models_export.scenes.light import INDOOR_WEATHERS, WEATHERS, sample_light
from models_export.scenes.people import sample_walkers
from models_export.scenes.request import FIRST_RESERVED_SEED, SceneRequest, parse_size, world_of
from models_export.scenes.roads import WORLDS, build_world
from models_export.scenes.scenario import rotation_from_axes
from models_export.scenes.traffic import Traffic
from service.errors import InputError
from service.geometry.camera import Camera
from service.geometry.iou import intersection_bev


def run_traffic(
    kind: str, seed: int, moving: int, seconds: float, step: float, turning: bool | None = None
) -> tuple[Traffic, dict[int, float]]:
    """Traffic that is watched for overlaps while it runs, and how far each vehicle went."""
    rng = np.random.default_rng(seed)
    traffic = Traffic(build_world(kind, rng), rng, moving=moving, parked=4, turning=turning)
    travelled: dict[int, float] = {}
    for _ in range(round(seconds / step)):
        before = {v.id: v.pose()[:2] for v in traffic.vehicles}
        traffic.step(step)
        poses = np.array([v.pose() for v in traffic.vehicles])
        dims = np.array([v.model.dims_lwh for v in traffic.vehicles])
        overlap = intersection_bev(poses[:, :2], dims[:, :2], poses[:, 2], poses[:, :2], dims[:, :2], poses[:, 2])
        np.fill_diagonal(overlap, 0)
        assert overlap.max() < 1e-6
        for v in traffic.vehicles:
            if v.id in before:
                moved = float(np.linalg.norm(v.pose()[:2] - before[v.id]))
                assert moved < step * 22
                travelled[v.id] = travelled.get(v.id, 0.0) + moved
    return traffic, travelled


@pytest.mark.parametrize("seed", [0, 5, 8, 13])
@pytest.mark.parametrize("kind", WORLDS)
def test_vehicles_move_and_never_overlap(kind: str, seed: int) -> None:
    moving = 5 if kind == "garage" else 16
    traffic, travelled = run_traffic(kind, seed, moving, 30.0, 0.5)
    moved = [travelled.get(v.id, 0.0) for v in traffic.vehicles if v.route is not None]
    assert np.mean(moved) > (8 if kind == "garage" else 15)
    assert all(travelled[v.id] == 0 for v in traffic.vehicles if v.route is None)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("kind", ["intersection", "t-junction"])
def test_turning_vehicles_never_overlap(kind: str, seed: int) -> None:
    traffic, travelled = run_traffic(kind, seed, 14, 30.0, 0.5, turning=True)
    assert np.mean([travelled.get(v.id, 0.0) for v in traffic.vehicles if v.route is not None]) > 10


def test_queues_form_at_red_lights() -> None:
    waiting = 0
    for seed in range(4):
        traffic, _ = run_traffic("intersection", seed, 18, 12.0, 0.5)
        waiting = max(waiting, sum(v.route is not None and v.speed_mps < 0.3 for v in traffic.vehicles))
    assert waiting >= 3


def test_velocity_is_what_positions_do() -> None:
    rng = np.random.default_rng(3)
    traffic = Traffic(build_world("curve", rng), rng, moving=10, parked=0)
    traffic.step(5.0)
    before = {v.id: (v.pose(), v.velocity()) for v in traffic.vehicles}
    traffic.step(0.05)
    after = {v.id: (v.pose(), v.velocity()) for v in traffic.vehicles}
    kept = [k for k in before if k in after]
    assert len(kept) > 5
    for k in kept:
        mean = 0.5 * (before[k][1] + after[k][1])[:2]
        np.testing.assert_allclose((after[k][0] - before[k][0])[:2] / 0.05, mean, atol=0.25)


@pytest.mark.parametrize(("kind", "turns"), [("intersection", {-1, 0, 1}), ("t-junction", {-1, 0, 1}), ("straight", {0})])
def test_routes_turn_as_the_world_does(kind: str, turns: set[int]) -> None:
    world = build_world(kind, np.random.default_rng(4))
    found = []
    for route in world.routes:
        steps = np.diff(route.points, axis=0)
        heading = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
        assert np.abs(np.diff(heading)).max() < 0.2
        found.append(round(float(heading[-1] - heading[0]) / (np.pi / 2)))
        assert route.turns == (found[-1] != 0)
    assert set(found) == turns


def test_nobody_comes_from_or_goes_to_the_missing_arm() -> None:
    for seed in range(6):
        for route in build_world("t-junction", np.random.default_rng(seed)).routes:
            assert route.points[:, 1].min() > -12


@pytest.mark.parametrize("turning", [True, False])
def test_traffic_of_one_scenario(turning: bool) -> None:
    rng = np.random.default_rng(1)
    traffic = Traffic(build_world("intersection", rng), rng, moving=10, parked=0, turning=turning)
    assert {v.route.turns for v in traffic.vehicles if v.route is not None} == {turning}


def test_easy_traffic_has_no_angled_parking() -> None:
    angled = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        world = build_world("straight", rng)
        for turning in (False, None):
            vehicles = Traffic(world, rng, moving=0, parked=8, turning=turning).vehicles
            rotated = rotation_from_axes([v.pose()[2] for v in vehicles], world.axes_rad) > np.deg2rad(10)
            assert not (rotated.any() and turning is False)
            angled += int(rotated.sum())
    assert angled > 0


def test_long_vehicles_keep_to_routes_that_they_can_take() -> None:
    rng = np.random.default_rng(2)
    world = build_world("intersection", rng)
    for _ in range(12):
        for v in Traffic(world, rng, moving=14, parked=6).vehicles:
            longest = 5.6 if v.route is None else v.route.longest_m
            assert v.model.dims_lwh[0] <= longest


@pytest.mark.parametrize("kind", WORLDS)
def test_people_stay_on_the_walks(kind: str) -> None:
    rng = np.random.default_rng(5)
    world = build_world(kind, rng)
    for walker in sample_walkers(world, rng, 6):
        for _ in range(50):
            before = walker.pose()
            walker.step(0.5)
            assert np.linalg.norm(walker.pose()[:2] - before[:2]) <= 0.5 * walker.speed_mps + 0.1
            near = min(np.linalg.norm(resampled(line) - walker.pose()[:2], axis=1).min() for line in world.walks)
            assert near < 1.0
        if kind != "garage":
            assert world.clear_of_routes(walker.pose()[:2]) > 1.0


PLAIN = Optics()


def cameras_of(kind: str, rig: str, seed: int, optics: Optics = PLAIN, count: int = 4) -> tuple[Camera, ...]:
    rng = np.random.default_rng(seed)
    return rig_cameras(mounts_of(build_world(kind, rng), rig, rng), rig, count, optics, rng)


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("kind", WORLDS)
def test_cameras_stand_where_they_should(kind: str, rig: str) -> None:
    if (kind, rig) == ("straight", "turn"):
        with pytest.raises(InputError, match="no turn"):
            cameras_of(kind, rig, 0)
        return
    for seed in range(12):
        cameras = cameras_of(kind, rig, seed)
        assert len({c.id for c in cameras}) == 4
        for camera in cameras:
            assert (camera.width, camera.height) == (1284, 384)
            assert (2.4 if kind == "garage" else 3.0) <= camera.position_m[2] <= 9.0
            assert 5 - 1e-6 <= np.rad2deg(np.arcsin(-camera.T_world_cam[2, 2])) <= 35 + 1e-6
            assert 450 <= camera.K[0, 0] <= 1300
        if rig == "poles" and kind != "garage":
            rng = np.random.default_rng(seed)
            world = build_world(kind, rng)
            assert min(world.clear_of_routes(foot) for foot, _ in world.poles) > 1.2


def test_the_papers_sides_look_along_and_across_the_road() -> None:
    for seed in range(8):
        axes = np.array([c.T_world_cam[:2, 2] for c in cameras_of("straight", "sides", seed)])
        angle = np.rad2deg(np.arctan2(axes[:, 1], axes[:, 0]))
        np.testing.assert_allclose(np.sort(angle % 360) % 90, 0, atol=1e-6)
        assert len({round(a) % 360 for a in angle}) == 4


def test_sizes_distortion_and_more_cameras_than_mounts() -> None:
    cameras = cameras_of("straight", "poles", 0, Optics((960, 540), distorted=True), count=6)
    assert len({c.id for c in cameras}) == 6
    assert {(c.width, c.height) for c in cameras} == {(960, 540)}
    assert all(c.has_distortion for c in cameras)
    assert len({cameras_of("straight", "poles", s, Optics(None))[0].width for s in range(20)}) > 3


@pytest.mark.parametrize("weather", WEATHERS)
def test_lights_and_films(weather: str) -> None:
    qualities = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        light = sample_light(rng, weather)
        assert light.weather == weather
        assert np.linalg.norm(light.sun_direction) == pytest.approx(1)
        assert light.sun_direction[2] > 0
        assert (light.wet > 0) == (light.rain > 0) == ("rain" in weather)
        assert (light.haze_per_m > 0.0105) == (weather == "fog") or weather == "rain"
        assert light.dark == (weather in ("dusk", "night", "night-rain", "dim"))
        film = sample_film(rng, light)
        qualities.append(film.jpeg_quality)
        assert np.all(film.gain > 0)
    assert min(qualities) < 50
    assert QUALITIES[0] <= min(qualities) < max(qualities) <= QUALITIES[1]


def test_indoor_light_is_for_indoor_worlds() -> None:
    drawn = {sample_light(np.random.default_rng(s), indoor=True).weather for s in range(30)}
    assert drawn == set(INDOOR_WEATHERS)


def test_developing_is_repeatable_and_keeps_the_picture() -> None:
    rng = np.random.default_rng(0)
    picture = np.full((120, 200, 3), 100, np.uint8)
    picture[:, 100:] = 180
    for weather in ("day", "night-rain"):
        film = sample_film(rng, sample_light(rng, weather))
        first, second = (develop(picture, film, (1, 2, 3)) for _ in range(2))
        assert encode(first, film) == encode(second, film)
        assert not np.array_equal(first, develop(picture, film, (1, 2, 4)))
        assert abs(float(first[:, :90].mean()) - 100) < 25
        assert first[:, 110:].mean() > first[:, :90].mean() + 40


def test_requests_that_cannot_be_met() -> None:
    for request, field in (
        (SceneRequest(1, "moon"), "world"),
        (SceneRequest(1, "garage", weather="fog"), "weather"),
        (SceneRequest(1, "straight", weather="indoor"), "weather"),
        (SceneRequest(1, rig="drone"), "rig"),
        (SceneRequest(1, "straight", rig="turn"), "rig"),
        (SceneRequest(1, "curve", scenario="easy"), "scenario"),
        (SceneRequest(1, "straight", scenario="moderate"), "scenario"),
        (SceneRequest(1, scenario="impossible"), "scenario"),
        (SceneRequest(1, scenario="easy", weather="night"), "weather"),
    ):
        with pytest.raises(InputError) as caught:
            request.check()
        assert caught.value.field == field
        assert caught.value.remedy
    with pytest.raises(InputError, match="reserved for evaluation"):
        SceneRequest(FIRST_RESERVED_SEED).check(reserved=False)
    SceneRequest(FIRST_RESERVED_SEED).check()


def test_a_mix_takes_the_worlds_that_fit() -> None:
    assert {world_of("mix", k, None, None, "poles") for k in range(12)} == set(WORLDS)
    assert [world_of("mix", k, None, None, "poles") for k in (0, 3, 6)] == ["intersection"] * 3
    assert "garage" not in {world_of("mix", k, "fog", None, "poles") for k in range(12)}
    assert {world_of("mix", k, "indoor", None, "poles") for k in range(12)} == {"garage"}
    assert "curve" not in {world_of("mix", k, None, "easy", "poles") for k in range(12)}
    assert "straight" not in {world_of("mix", k, None, None, "mix") for k in range(12)}
    with pytest.raises(InputError):
        world_of("mix", 0, "fog", "easy", "poles")


def test_picture_sizes() -> None:
    assert parse_size("640x480") == (640, 480)
    assert parse_size("mix") is None
    for bad in ("640", "640x", "axb", "20x20", "9000x100"):
        with pytest.raises(InputError):
            parse_size(bad)
