"""The recorded clip that ships with the package: frames of all cameras of a site, with the truth.

    clip/
      site.json               the site, as PUT /sites/{id} takes it
      truth.json              {"rate_hz", "steps": [{"step", "captured_at_ns", "boxes": [...]}, ...]}
      <camera>/000000.jpg     one JPEG a step

Clips are written by ``models_export.scenes.clip``.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SHIPPED = Path(__file__).resolve().parent / "clip"
"""The clip of the demo."""


class ClipError(Exception):
    """A clip's folder cannot be read; the message names the file."""


@dataclass(frozen=True, eq=False)
class Moment:
    """One step of a clip that is being played."""

    step: int
    captured_at_ns: int
    """Later than that of every moment before, also when the clip begins again."""


@dataclass(frozen=True, eq=False)
class Clip:
    """A clip on disk; frames are read when they are asked for."""

    path: Path
    site: dict[str, Any]
    """The site document."""
    rate_hz: float
    truth: tuple[dict[str, Any], ...]
    """One document a step, with the ``boxes`` that were really there."""

    @property
    def steps(self) -> int:
        """How many frame sets the clip has."""
        return len(self.truth)

    @property
    def camera_ids(self) -> tuple[str, ...]:
        """The site's cameras, in their order."""
        return tuple(camera["id"] for camera in self.site["cameras"])

    def frame(self, camera_id: str, step: int) -> bytes:
        """One camera's JPEG of one step. Raises ClipError."""
        path = self.path / camera_id / f"{step:06d}.jpg"
        try:
            return path.read_bytes()
        except OSError as error:
            raise ClipError(f"{path}: {error.strerror}.") from error

    def frames(self, step: int) -> dict[str, bytes]:
        """All cameras' JPEGs of one step, by camera id. Raises ClipError."""
        return {camera_id: self.frame(camera_id, step) for camera_id in self.camera_ids}

    def moment(self, number: int, start_ns: int, rate_hz: float | None = None) -> Moment:
        """The ``number``-th moment since ``start_ns`` of playing the clip again and again, at its own rate or another."""
        return Moment(number % self.steps, start_ns + round(number * 1e9 / (rate_hz or self.rate_hz)))

    def play(self, start_ns: int, rate_hz: float | None = None) -> Iterator[Moment]:
        """Moments without end: after the last step comes the first one, later."""
        number = 0
        while True:
            yield self.moment(number, start_ns, rate_hz)
            number += 1


def open_clip(path: Path = SHIPPED) -> Clip:
    """A clip from its folder. Raises ClipError when a document is missing or unusable."""
    site = _read(path / "site.json")
    truth = _read(path / "truth.json")
    try:
        clip = Clip(path, site, float(truth["rate_hz"]), tuple(truth["steps"]))
        camera_ids = clip.camera_ids
    except (KeyError, TypeError, ValueError) as error:
        raise ClipError(f"{path}: not the documents of a clip ({error!r}).") from error
    if not clip.steps or not camera_ids or not clip.rate_hz > 0:
        raise ClipError(f"{path}: {clip.steps} steps, {len(camera_ids)} cameras, {clip.rate_hz} Hz; each must be above 0.")
    return clip


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise ClipError(f"{path}: {error}.") from error
