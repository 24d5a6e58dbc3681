"""Settings: read from the environment, typed, limited; cores counted as a container grants them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from pydantic import ValidationError

from service.settings import Settings, usable_cores


def test_environment_is_read_and_arguments_win(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("QUADLIFT_MAX_CAMERAS", "5")
    monkeypatch.setenv("QUADLIFT_PORT", "9000")
    monkeypatch.setenv("QUADLIFT_VIEWER", "false")
    settings = Settings(port=9001)
    assert (settings.max_cameras, settings.port, settings.viewer) == (5, 9001, False)


@pytest.mark.parametrize(
    "wrong",
    [
        {"port": 70000},
        {"workers": 0},
        {"score_threshold": 2},
        {"deadline_ms": 0},
        {"max_pixels": "x"},
        {"provider": "x"},
        {"hard_mode": "on"},
    ],
)
def test_impossible_values_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError, match=next(iter(wrong))):
        Settings(**wrong)  # type: ignore[arg-type]


def test_every_setting_is_documented() -> None:
    assert [name for name, field in Settings.model_fields.items() if not field.description] == []


@pytest.mark.parametrize(("content", "cores"), [("100000 100000", 1), ("50000 100000", 1), ("max 100000", None), ("", None)])
def test_a_containers_quota_counts(tmp_path: Path, content: str, cores: int | None) -> None:
    path = tmp_path / "cpu.max"
    path.write_text(content)
    affinity = len(os.sched_getaffinity(0))
    assert usable_cores(path) == (cores or affinity)
    assert usable_cores(tmp_path / "none") == affinity


def test_frame_limits_follow() -> None:
    limits = Settings(max_frame_bytes=2048, max_pixels=1000).frame_limits
    assert (limits.max_frame_bytes, limits.max_pixels) == (2048, 1000)
