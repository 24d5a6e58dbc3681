from __future__ import annotations

import json
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clients.clip import SHIPPED, Clip, ClipError, open_clip
from models_export.data.dataset import Scene, open_scene
from models_export.scenes.clip import ClipPlan, build_clip
from service.errors import InputError
from service.frames import read_header
from service.site import load_site, parse_site

MAX_SHIPPED_BYTES = 8_000_000


@pytest.fixture
def scene(tmp_path: Path, site_document: dict[str, Any]) -> Scene:
    """A scene of eight steps at 20 Hz whose pictures hold noise, which JPEG cannot compress away."""
    folder = tmp_path / "scene"
    (folder / "boxes").mkdir(parents=True)
    (folder / "site.json").write_text(json.dumps({**site_document, "id": "intersection-7"}))
    (folder / "scene.json").write_text(json.dumps({"seed": 7, "world": "intersection", "rate_hz": 20.0, "steps": 8}))
    rng = np.random.default_rng(3)
    for step in range(8):
        box = {"id": 5, "class": "Car", "center": [step, 0, 0.7], "dims_lwh": [4, 2, 1.4], "yaw": 0.1, "velocity": [9, 0, 0]}
        box |= {"visible": {"north": 1.0}, "truncated": {"north": 0.0}}
        document = {"step": step, "captured_at_ns": step * 50_000_000, "boxes": [box]}
        (folder / "boxes" / f"{step:06d}.json").write_text(json.dumps(document))
        for camera in site_document["cameras"]:
            image_folder = folder / "cameras" / camera["id"] / "image_2"
            image_folder.mkdir(parents=True, exist_ok=True)
            noise = rng.integers(0, 255, (camera["height"], camera["width"], 3), dtype=np.uint8)
            (image_folder / f"{step:06d}.jpg").write_bytes(cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_QUALITY, 95])[1])
    return open_scene(folder)


def test_a_clip_gives_its_frames_and_truth(clip_folder: Path, frames: dict[str, bytes]) -> None:
    clip = open_clip(clip_folder)
    assert (clip.steps, clip.rate_hz, clip.camera_ids) == (3, 10.0, ("north", "east"))
    assert clip.frames(2) == frames
    assert [step["step"] for step in clip.truth] == [0, 1, 2]


@given(start_ns=st.integers(0, 2**61), rate_hz=st.floats(0.5, 60), count=st.integers(2, 40))
def test_playing_goes_round_while_time_goes_on(start_ns: int, rate_hz: float, count: int) -> None:
    clip = Clip(Path(), {"cameras": []}, 10.0, ({}, {}, {}))
    moments = list(islice(clip.play(start_ns, rate_hz), count))
    assert [m.step for m in moments] == [number % 3 for number in range(count)]
    times = [m.captured_at_ns for m in moments]
    assert times[0] == start_ns
    assert np.diff(times) == pytest.approx(1e9 / rate_hz, abs=1.0)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("truth.json", "{"),
        ("truth.json", "{}"),
        ("truth.json", '{"rate_hz": 0, "steps": [{}]}'),
        ("site.json", "[]"),
        ("site.json", None),
    ],
)
def test_a_damaged_clip_is_named(clip_folder: Path, name: str, content: str | None) -> None:
    if content is None:
        (clip_folder / name).unlink()
    else:
        (clip_folder / name).write_text(content)
    with pytest.raises(ClipError, match=str(clip_folder)):
        open_clip(clip_folder)


def test_a_missing_frame_is_named(clip_folder: Path) -> None:
    (clip_folder / "east" / "000001.jpg").unlink()
    with pytest.raises(ClipError, match=r"east/000001\.jpg"):
        open_clip(clip_folder).frames(1)


def test_a_scene_becomes_a_clip(scene: Scene, tmp_path: Path) -> None:
    out = tmp_path / "out"
    build_clip(scene, out, ClipPlan(start=1, steps=3, stride=2))
    clip = open_clip(out)
    assert (clip.steps, clip.rate_hz, clip.site["id"]) == (3, 10.0, "demo")
    assert [step["boxes"][0]["center"][0] for step in clip.truth] == [1, 3, 5]
    assert [step["captured_at_ns"] for step in clip.truth] == [50_000_000, 150_000_000, 250_000_000]
    assert [camera.id for camera in load_site(out / "site.json").cameras] == list(clip.camera_ids)
    first = cv2.imdecode(np.frombuffer(clip.frame("east", 0), np.uint8), cv2.IMREAD_COLOR)
    source = cv2.imdecode(np.frombuffer(scene.frame_bytes("east", 1), np.uint8), cv2.IMREAD_COLOR)
    assert np.corrcoef(first.ravel(), source.ravel())[0, 1] > 0.8


def test_the_quality_is_the_highest_that_fits(scene: Scene, tmp_path: Path) -> None:
    def size(folder: Path) -> int:
        return sum(path.stat().st_size for path in folder.glob("*/*.jpg"))

    best = build_clip(scene, tmp_path / "best", ClipPlan(steps=8))
    budget = size(tmp_path / "best") // 2
    quality = build_clip(scene, tmp_path / "small", ClipPlan(steps=8, budget_bytes=budget))
    assert quality < best
    assert 0.9 * budget < size(tmp_path / "small") <= budget


def test_what_cannot_be_built_leaves_the_old_clip_alone(scene: Scene, clip_folder: Path) -> None:
    for plan in (ClipPlan(steps=9), ClipPlan(steps=8, budget_bytes=100)):
        with pytest.raises(InputError):
            build_clip(scene, clip_folder, plan)
        assert open_clip(clip_folder).steps == 3
        assert not list(clip_folder.parent.glob(".clip.*"))


def test_the_shipped_clip_is_whole() -> None:
    clip = open_clip(SHIPPED)
    site = parse_site(clip.site)
    assert len(site.cameras) == 4
    assert clip.steps / clip.rate_hz >= 9.9
    assert clip.rate_hz >= 10
    total = 0
    for step in range(clip.steps):
        for camera in site.cameras:
            data = clip.frame(camera.id, step)
            header = read_header(data)
            assert (header.kind, header.width, header.height) == ("jpeg", camera.width, camera.height)
            total += len(data)
    assert total <= MAX_SHIPPED_BYTES
    assert sum(len(step["boxes"]) for step in clip.truth) > clip.steps
