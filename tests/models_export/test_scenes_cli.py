"""``quadlift scenes`` on the command line. Needs OpenGL."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest
from typer.testing import CliRunner

from models_export.data.dataset import list_scenes, open_scene
from models_export.scenes.cli import app
from models_export.scenes.renderer import open_context
from service.errors import QuadliftError

runner = CliRunner()


@pytest.fixture(autouse=True, scope="module")
def _opengl() -> None:
    try:
        open_context().release()
    except QuadliftError as error:
        pytest.skip(str(error))


def test_render_writes_scenes_that_open(tmp_path: Path) -> None:
    options = "--world mix --scenario hard --rig mix --seed 3 --scenes 2 --steps 1 --cameras 2 --size 640x480 --distorted"
    result = runner.invoke(app, ["render", "--out", str(tmp_path), *options.split()])
    assert result.exit_code == 0, result.output
    assert "4 images in" in result.output
    assert "images/s" in result.output
    folders = list_scenes(tmp_path)
    assert len(folders) == 2
    for folder in folders:
        scene = open_scene(folder)
        assert {(c.width, c.height) for c in scene.site.cameras} == {(640, 480)}
        assert len(scene.truth(0).kinds) == len(scene.truth(0))
        assert json.loads((folder / "scene.json").read_text())["scenario"] == "hard"
        for camera in scene.site.cameras:
            assert camera.has_distortion
            assert scene.depth(camera.id, 0).shape == (480, 640)
            # KITTI's calibration cannot hold a distorting lens.
            assert not (folder / "cameras" / camera.id / "calib").exists()


def test_preview_of_one_world_and_weather(tmp_path: Path) -> None:
    out = tmp_path / "sheet.jpg"
    options = "--world curve --weather night --scenes 2 --cameras 3 --scale 0.25 --boxes"
    result = runner.invoke(app, ["preview", "--out", str(out), *options.split()])
    assert result.exit_code == 0, result.output
    assert cv2.imread(str(out)).shape == (2 * 96, 3 * 321, 3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("render --seed 9000001 --scenes 1", "reserved for evaluation"),
        ("render --world garage --weather fog", "has no weather"),
        ("render --world straight --scenario moderate", "no vehicle turns"),
        ("render --world mix --scenario easy --weather rain", "no world goes with"),
        ("render --size 10x10", "no picture size"),
        ("preview --world straight --rig turn", "has no turn"),
    ],
)
def test_what_does_not_go_together_is_said(tmp_path: Path, options: str, message: str) -> None:
    command, *rest = options.split()
    result = runner.invoke(app, [command, "--out", str(tmp_path / "x.png"), *rest])
    assert result.exit_code == 1
    assert message in " ".join(result.output.split())
