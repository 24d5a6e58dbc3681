"""A runner that worker processes can import: it does what a frame's bytes say."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from service.errors import FrameError, PackError
from service.frames import FrameSet
from service.sightings import Sightings
from service.site import Site


class OddError(Exception):
    """Cannot be made again from its arguments."""

    def __init__(self, a: int, b: int) -> None:
        super().__init__(f"{a} and {b}")


class Scripted:
    """Does what a frame's bytes say."""

    def __init__(self) -> None:
        self.warm = 0
        self.sites: list[Site] = []

    def warm_up(self) -> None:
        self.warm += 1

    def run(self, frame_set: FrameSet) -> Any:
        match frame_set.frames[0].data.split():
            case [b"pid"]:
                return os.getpid(), self.warm
            case [b"site"]:
                is_known = any(site is frame_set.site for site in self.sites)
                self.sites.append(frame_set.site)
                return frame_set.site.cameras[0].id, is_known
            case [b"frame-error"]:
                raise FrameError("not a JPEG.", field="north", remedy="Send one.")
            case [b"odd-error"]:
                raise OddError(1, 2)
            case [b"hang"]:
                time.sleep(60)
            case [b"die"]:
                os.kill(os.getpid(), signal.SIGKILL)
            case [b"wait", path]:
                Path(path.decode()).touch()
                time.sleep(0.5)
        return "done"


class Divisible(Scripted):
    """Also does it with parts of sets; what it saw tells who saw it, and its result is who saw each frame."""

    def see(self, frame_set: FrameSet) -> Sightings:
        for frame in frame_set.frames:
            self.run(replace(frame_set, frames=(frame,)))
        cameras = tuple(frame_set.site.camera(frame.camera_id) for frame in frame_set.frames)
        seen = Sightings.of_none({})
        pids = (os.getpid(),) * len(cameras)
        times = {"see": 1.0, "total": 1.0}
        return replace(seen, cameras=cameras, captured_at_ns=pids, timing_ms=times)

    def fuse(self, site: Site, seen: Sequence[Sightings]) -> Any:
        whole = Sightings.together(seen)
        assert [camera.id for camera in whole.cameras] == [camera.id for camera in site.cameras]
        return whole.captured_at_ns, whole.timing_ms["see"]


def refuse() -> Scripted:
    raise PackError("detector.onnx is missing.", field="edge")


def end() -> Scripted:
    """A library that takes the process down."""
    os._exit(3)


def noted(log: Path) -> Scripted:
    """A runner whose process is known."""
    log.write_text(str(os.getpid()))
    return Scripted()
