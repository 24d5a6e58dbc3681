from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from models_export.data import carla_truth
from models_export.data.carla_weather import PRESETS, Weather

carla: Any = pytest.importorskip("carla", reason="needs CARLA's client: pip install 'quadlift[carla]'")


def test_the_package_has_every_name_of_the_fakes(real_names: dict[type, str]) -> None:
    for fake, real in real_names.items():
        target = getattr(carla, real)
        methods = {name for name in vars(fake) if not name.startswith("_")}
        fields = _fields(fake)
        assert methods | fields
        assert {name for name in methods | fields if not hasattr(target, name)} == set(), real
        for name in methods:
            wanted = [p for p in inspect.signature(getattr(fake, name)).parameters if p != "self"]
            assert any(len(wanted) in counts for counts in _arities(getattr(target, name))), f"{real}.{name}{wanted}"


def _fields(fake: type) -> set[str]:
    """Public attributes that a class gives itself."""
    stores = (node for node in ast.walk(ast.parse(inspect.getsource(fake))) if isinstance(node, ast.Attribute))
    own = (n.attr for n in stores if isinstance(n.ctx, ast.Store) and isinstance(n.value, ast.Name) and n.value.id == "self")
    return {name for name in own if not name.startswith("_")}


def _arities(method: Any) -> Iterator[range]:
    """How many arguments, without self, each overload of a Boost.Python method takes, by its documentation."""
    for line in re.findall(r"^\w+\( .*\) -> .*:$", method.__doc__, re.MULTILINE):
        required, _, optional = line.partition("[")
        total = len(re.findall(r"\(\w+\)\w+", line)) - 1
        yield range(len(re.findall(r"\(\w+\)\w+", required)) - 1 if optional else total, total + 1)


def test_every_name_that_the_modules_take_from_the_package_exists() -> None:
    """All chains such as ``session.carla.command.DestroyActor``, annotations included."""
    found = set()
    for path in sorted((Path(carla_truth.__file__).parent).glob("carla_*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            chain = _chain(node)
            for root in ("carla", "carla_module"):
                if root in chain[:2] and len(chain) > chain.index(root) + 1:
                    found.add(tuple(chain[chain.index(root) + 1 :]))
    assert {("WeatherParameters",), ("command", "DestroyActor"), ("WorldSnapshot",), ("Client",)} <= found
    for names in sorted(found):
        target = carla
        for name in names:
            assert hasattr(target, name), f"carla.{'.'.join(names)}"
            target = getattr(target, name)


def _chain(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Attribute):
        return [*_chain(node.value), node.attr]
    return [node.id] if isinstance(node, ast.Name) else []


@pytest.mark.parametrize("weather", list(Weather))
def test_presets_use_attributes_that_exist(weather: Weather) -> None:
    made = carla.WeatherParameters(**PRESETS[weather])
    for name, value in PRESETS[weather].items():
        assert getattr(made, name) == pytest.approx(value)


def test_settings_that_are_changed_exist() -> None:
    fields = {"synchronous_mode", "fixed_delta_seconds", "no_rendering_mode", "substepping", "max_substep_delta_time"}
    source = (Path(carla_truth.__file__).parent / "carla_session.py").read_text("utf-8")
    used = set(re.findall(r"settings\.(\w+) =", source))
    assert fields <= used
    assert all(hasattr(carla.WorldSettings, name) for name in used)
    labels = re.search(r"_PARKED = \((.*)\)", source)
    assert labels
    assert all(hasattr(carla.CityObjectLabel, name) for name in re.findall(r'"(\w+)"', labels[1]))
