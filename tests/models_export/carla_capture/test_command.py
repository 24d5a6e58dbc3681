from __future__ import annotations

import json
import socket
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from models_export.data import carla_cli
from models_export.data.carla_session import import_carla
from models_export.data.dataset import open_scene
from service.errors import NotFoundError

carla: Any = pytest.importorskip("carla", reason="needs CARLA's client: pip install 'quadlift[carla]'")


@pytest.fixture
def rig_file(rig_document: dict[str, Any], tmp_path: Path) -> Path:
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(rig_document))
    return path


def run(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(carla_cli.app, ["capture", *arguments], env={"COLUMNS": "400"})
    return result.exit_code, result.output


def test_without_a_server_the_command_says_how_to_start_one(rig_file: Path, tmp_path: Path) -> None:
    """The real client against a port that nobody listens on."""
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        port = str(held.getsockname()[1])
        code, said = run("--rig", str(rig_file), "--out", str(tmp_path / "s"), "--port", port, "--timeout", "0.3")
    assert code == 1
    assert "no CARLA server answers" in said
    assert "CarlaUE4.sh -RenderOffScreen" in said
    assert not (tmp_path / "s").exists()


def test_the_command_captures(package: Any, rig_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(carla_cli, "import_carla", lambda: package)
    out = tmp_path / "s"
    code, said = run("--rig", str(rig_file), "--out", str(out), "--steps", "2", "--vehicles", "3", "--weather", "night")
    assert code == 0, said
    assert "2 frame sets" in said
    assert json.loads((out / "scene.json").read_text())["condition"] == "night"


def test_an_interrupted_command_leaves_whole_steps(
    package: Any, world: Any, rig_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(now: int) -> None:
        if now == 1055:
            raise KeyboardInterrupt

    world._after_tick = interrupt
    monkeypatch.setattr(carla_cli, "import_carla", lambda: package)
    code, said = run("--rig", str(rig_file), "--out", str(tmp_path / "s"))
    assert code == 130
    assert "2 frame sets" in said
    assert open_scene(tmp_path / "s").steps == 2
    assert world._as_found()


def test_a_bad_rig_is_named(tmp_path: Path) -> None:
    code, said = run("--rig", str(tmp_path / "absent.json"), "--out", str(tmp_path / "s"))
    assert code == 1
    assert "absent.json" in said


def test_without_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "carla", None)
    with pytest.raises(NotFoundError, match="cannot be imported") as caught:
        import_carla()
    assert "quadlift[carla]" in (caught.value.remedy or "")
