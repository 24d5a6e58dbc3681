"""The command line: clear errors, lazy sub-commands, limits handed to the server."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from service import __version__
from service.api.server import server_config
from service.cli import add_commands, app
from service.geometry.camera import Camera
from service.geometry.transforms import pole_camera_pose
from service.settings import Settings
from service.site import Site, save_site

runner = CliRunner()


def camera(camera_id: str, position: list[float], pitch_deg: float) -> Camera:
    K = np.array([[642.0, 0, 641.5], [0, 642.0, 191.5], [0, 0, 1]])
    return Camera(camera_id, 1284, 384, K, pole_camera_pose(position, 0.0, np.radians(pitch_deg)))


@pytest.fixture
def site_file(tmp_path: Path) -> Path:
    path = tmp_path / "demo.json"
    save_site(Site("demo", (camera("north", [1, 2, 6], 20.0), camera("east", [0, 0, 5], 10.0))), path)
    return path


def test_version() -> None:
    assert runner.invoke(app, ["version"]).stdout.strip() == __version__


def test_sites_check_shows_each_camera(site_file: Path) -> None:
    result = runner.invoke(app, ["sites", "check", str(site_file)], env={"COLUMNS": "160"})
    assert result.exit_code == 0, result.output
    for shown in ("north", "1.00, 2.00, 6.00", "20.0", "east", "horizon"):
        assert shown in result.output
    # By hand: the lowest row lies atan(191.5 / 642) = 16.6 degrees under the axis, the highest as much above it.
    near = 6 / np.tan(np.radians(20) + np.arctan(191.5 / 642))
    far = 6 / np.tan(np.radians(20) - np.arctan(191.5 / 642))
    assert f"{near:.1f} to {far:.1f}" in result.output


def test_sites_check_refuses_what_cannot_work(site_file: Path, tmp_path: Path) -> None:
    document = json.loads(site_file.read_text())
    document["cameras"][0]["K"][0][0] = float("nan")
    site_file.write_text(json.dumps(document))
    result = runner.invoke(app, ["sites", "check", str(site_file)])
    assert result.exit_code == 1
    assert "cameras.0.K.0.0" in result.output
    assert runner.invoke(app, ["sites", "check", str(tmp_path / "none.json")]).exit_code == 1
    for bad in (camera("sky", [0, 0, 5], -40.0), camera("under", [0, 0, -5], 10.0)):
        save_site(Site("demo", (bad,)), site_file)
        result = runner.invoke(app, ["sites", "check", str(site_file)])
        assert result.exit_code == 1
        assert bad.id in result.output


def test_bad_starts_end_in_one_clear_line(site_file: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    for arguments, says in (
        (["--site", str(tmp_path / "none.json")], "none.json"),
        (["--pack", str(empty)], "manifest.json"),
        (["--port", "70000"], "QUADLIFT_PORT"),
        (["--workers", "0"], "workers"),
        (["--data-dir", str(site_file)], "data_dir"),
    ):
        result = runner.invoke(app, ["serve", *arguments])
        assert result.exit_code == 1, result.output
        assert says in result.output
        assert "Traceback" not in result.output


def test_the_server_gets_the_limits() -> None:
    settings = Settings(host="0.0.0.0", port=1234, limit_concurrency=7, timeout_keep_alive_s=3, ws_max_size=2048)
    config = server_config(settings, lambda: None)
    assert (config.host, config.port, config.limit_concurrency) == ("0.0.0.0", 1234, 7)
    assert (config.timeout_keep_alive, config.ws_max_size) == (3, 2048)


@pytest.fixture
def plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> typer.Typer:
    """A command line with three sub-commands from outside: one that works, and two that miss a package."""
    (tmp_path / "plug_in.py").write_text(
        "import typer\napp = typer.Typer()\n"
        "@app.command()\ndef echo(word: str, times: int = 1) -> None:\n    print(word * times)\n"
    )
    package = tmp_path / "models_export"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "needy.py").write_text("import torch_that_is_not_there\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "models_export", raising=False)
    target = typer.Typer()
    target.command()(lambda: None)
    found = {"echo": "plug_in:app", "train": "models_export.needy:app", "gone": "nowhere_at_all:app"}
    add_commands(target, [EntryPoint(name, value, "quadlift.commands") for name, value in found.items()])
    return target


def test_sub_commands_are_listed_without_being_loaded(plugins: typer.Typer) -> None:
    result = runner.invoke(plugins, ["--help"])
    assert result.exit_code == 0
    for name in ("echo", "train", "gone"):
        assert name in result.output


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["echo", "ab", "--times", "2"], 0, "abab"),
        (["echo", "--help"], 0, "quadlift echo"),
        (["echo"], 2, "Missing argument"),
        (["train"], 1, "pip install 'quadlift[train]'"),
        (["train", "--help"], 1, "torch_that_is_not_there"),
        (["gone"], 1, "nowhere_at_all"),
    ],
)
def test_sub_commands_load_when_they_run(plugins: typer.Typer, arguments: list[str], code: int, says: str) -> None:
    result = runner.invoke(plugins, arguments)
    assert (result.exit_code, says in result.output) == (code, True), result.output


def test_help_imports_nothing_heavy() -> None:
    program = (
        "import sys; from service.cli import main; sys.argv = ['quadlift', '--help']\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code\n"
        "heavy = {'torch', 'onnxruntime', 'cv2', 'fastapi', 'numpy'} & set(sys.modules)\n"
        "print('heavy:', sorted(heavy))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert "heavy: []" in done.stdout
    for name in ("serve", "sites", "version"):
        assert name in done.stdout


def test_schemas_import_nothing_heavy() -> None:
    program = (
        "import sys, service.schemas; print(sorted({'numpy', 'cv2', 'fastapi', 'orjson', 'onnxruntime'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("given", [{"QUADLIFT_TLS_CERT": "cert.pem"}, {"QUADLIFT_TLS_KEY": "key.pem"}])
def test_half_of_tls_ends_in_one_line(given: dict[str, str], site_file: Path) -> None:
    result = runner.invoke(app, ["serve", "--site", str(site_file)], env=given)
    assert result.exit_code == 1
    assert "tls_" in result.output


def test_unusable_tokens_end_in_one_line(site_file: Path) -> None:
    result = runner.invoke(app, ["serve", "--site", str(site_file)], env={"QUADLIFT_TOKENS": "read short"})
    assert result.exit_code == 1
    assert "QUADLIFT_TOKENS, line 1" in result.output
