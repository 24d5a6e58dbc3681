from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from models_export.data.carla_capture import Progress
from models_export.data.carla_session import ticks_a_step
from models_export.data.dataset import open_scene
from service.errors import InputError, NotFoundError, QuadliftError

carla: Any = pytest.importorskip("carla", reason="needs CARLA's client: pip install 'quadlift[carla]'")
Captured = Callable[..., list[Progress]]


class Stop(Exception):
    """Stands for any fault of the program."""


@pytest.mark.parametrize("error", [KeyboardInterrupt, Stop, MemoryError])
@pytest.mark.parametrize("frame", [1001, 1004, 1006, 1008, 1011])
def test_whatever_ends_a_capture_the_server_is_as_found(
    captured: Captured, world: Any, error: type[BaseException], frame: int
) -> None:
    def fail(now: int) -> None:
        if now == frame:
            raise error

    world._after_tick = fail
    with pytest.raises(error):
        captured()
    assert world._as_found()


def test_a_server_that_dies_is_an_error_with_a_remedy(captured: Captured, package: Any, world: Any) -> None:
    def die(now: int) -> None:
        if now == 1008:
            raise RuntimeError("time-out of 30000ms while waiting for the simulator")

    world._after_tick = die
    with pytest.raises(QuadliftError, match="time-out") as caught:
        captured()
    assert "CarlaUE4" in (caught.value.remedy or "")
    # No long wait for each answer of a server that is gone.
    assert package.client._timeouts[-1] <= 5.0


def test_one_failing_step_of_the_clean_up_does_not_keep_the_others(captured: Captured, world: Any) -> None:
    def refuse(mode_switch: bool) -> None:
        if not mode_switch:
            raise RuntimeError("no")

    world._traffic.set_synchronous_mode = refuse  # type: ignore[method-assign]
    with pytest.raises(QuadliftError, match="no"):
        captured()
    assert world._as_found()


def test_a_camera_that_the_server_moved_is_noticed(captured: Captured, world: Any) -> None:
    def shift(now: int) -> None:
        if world._sensors:
            world._sensors[3]._transform = carla.Transform(carla.Location(40, -5, 9))

    world._after_tick = shift
    with pytest.raises(QuadliftError, match="the server put it at") as caught:
        captured()
    assert caught.value.field == "east.rgb"
    assert world._as_found()


def test_ids_that_are_not_the_actors_are_noticed(captured: Captured, world: Any) -> None:
    world._wrong_ids = True
    with pytest.raises(QuadliftError, match="carry their ids"):
        captured()
    assert world._as_found()


def test_another_client_s_ticks_are_noticed(captured: Captured, world: Any) -> None:
    world._deaf = True
    with pytest.raises(QuadliftError, match="asked for frame 1001"):
        captured()
    assert world._as_found()


def test_a_server_of_another_version(captured: Captured, package: Any) -> None:
    package.client._version = "0.9.15"
    with pytest.raises(QuadliftError, match=r"server is CARLA 0\.9\.15, the client package 0\.9\.16"):
        captured()


def test_maps(captured: Captured, tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="no map 'Town77'") as caught:
        captured(map="Town77")
    assert "Town01, Town99" in (caught.value.remedy or "")
    captured(map="Town01")
    assert open_scene(tmp_path / "s").world == "Town01"


def test_an_anchor_far_from_any_road(captured: Captured, world: Any) -> None:
    with pytest.raises(InputError, match="no spawn point of Town99"):
        captured(anchor={"x": -900.0})
    assert world._as_found()


def test_a_scene_is_not_overwritten(captured: Captured) -> None:
    captured()
    with pytest.raises(InputError, match="holds a scene already"):
        captured()


@pytest.mark.parametrize(("rate_hz", "ticks"), [(10.0, 1), (30.0, 1), (5.0, 2), (3.0, 4), (1.0, 10), (0.1, 100)])
def test_no_tick_is_longer_than_the_physics_allow(rate_hz: float, ticks: int) -> None:
    assert ticks_a_step(rate_hz) == ticks
