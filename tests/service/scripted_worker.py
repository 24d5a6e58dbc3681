"""A runner that worker processes can import: it does what a frame's bytes say."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

from service.errors import FrameError, PackError
from service.frames import FrameSet
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


def refuse() -> Scripted:
    raise PackError("detector.onnx is missing.", field="edge")


def end() -> Scripted:
    """A library that takes the process down."""
    os._exit(3)


def noted(log: Path) -> Scripted:
    """A runner whose process is known."""
    log.write_text(str(os.getpid()))
    return Scripted()
