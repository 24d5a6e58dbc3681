"""The service with a pipeline that fails when a file asks for it: faults are injected here, so that the service has no hook.

A file ``SITE.raise``, ``SITE.hang`` or ``SITE.kill`` in the folder that ``BENCH_FAULTS`` names strikes the next frame set of
that site, once.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path

from service.frames import FrameSet
from service.pipeline import Pipeline, SetResult
from service.scheduler import FrameSetRunner
from service.settings import Settings
from service.sightings import Sightings
from service.site import Site

FOLDER_VARIABLE = "BENCH_FAULTS"
PROGRAM = "from benchmarks.load.faulty_service import main; main()"
HANG_S = 8.0
"""Long enough that the service must act, short enough that a service which does not comes back by itself."""


class NetworkFault(StrEnum):
    """What the pipeline does instead of its work."""

    RAISE = "raise"
    HANG = "hang"
    KILL = "kill"
    """Ends the worker's process, as the system does when memory runs out."""


class FaultyRunner:
    """A pipeline's work with faults before it, on whole sets or parts of them. Thread-safe: each file strikes once."""

    def __init__(self, pipeline: Pipeline, folder: Path) -> None:
        self._pipeline = pipeline
        self._folder = folder

    def run(self, frame_set: FrameSet) -> SetResult:
        """The result of a frame set, unless a fault strikes it."""
        self._strike(frame_set.site.id)
        return self._pipeline.run(frame_set)

    def see(self, frame_set: FrameSet) -> Sightings:
        """What a part of a frame set shows, unless a fault strikes it."""
        self._strike(frame_set.site.id)
        return self._pipeline.see(frame_set)

    def fuse(self, site: Site, seen: Sequence[Sightings]) -> SetResult:
        """As the pipeline's own."""
        return self._pipeline.fuse(site, seen)

    def warm_up(self) -> None:
        """As the pipeline's own."""
        self._pipeline.warm_up()

    def _strike(self, site_id: str) -> None:
        fault = self._claim(site_id)
        if fault is NetworkFault.RAISE:
            raise RuntimeError("an injected fault of the networks")
        if fault is NetworkFault.HANG:
            time.sleep(HANG_S)
        if fault is NetworkFault.KILL:
            os.kill(os.getpid(), signal.SIGKILL)

    def _claim(self, site_id: str) -> NetworkFault | None:
        for fault in NetworkFault:
            try:
                # Only one worker can remove it.
                fault_file(self._folder, site_id, fault).unlink()
            except FileNotFoundError:
                continue
            return fault
        return None


def fault_file(folder: Path, site_id: str, fault: NetworkFault) -> Path:
    """The file that asks for a fault."""
    return folder / f"{site_id}.{fault}"


def load_faulty(settings: Settings) -> FrameSetRunner:
    """The service's pipeline, wrapped; in a worker process."""
    from service.runners import load_pipeline

    return FaultyRunner(load_pipeline(settings), Path(os.environ[FOLDER_VARIABLE]))


def main() -> None:
    """``quadlift serve`` with workers that run the wrapped pipeline."""
    import service.api.app as app
    from service.cli import main as serve
    from service.runners import make_runner

    app.default_pipeline = lambda settings: make_runner(settings, load_faulty)
    serve()
