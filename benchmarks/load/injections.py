"""What goes wrong: each injector makes one fault happen and says whether its trace was seen."""

from __future__ import annotations

import asyncio
import os
import resource
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.load.fault_load import Load, LoadSite
from benchmarks.load.faulty_service import NetworkFault, fault_file
from benchmarks.load.target_service import Target
from clients.client import AsyncClient, ServiceError

RECOVER_S = 15.0
"""A service that has not answered all sites in full after this time has not survived."""
FAULT_S = 0.8
"""How long a camera is away or wrong: more than the time between two of its frames."""
_STRIKES = 5
"""Requests made until one of them meets the fault that is laid out."""
_CLOCK_STEP_NS = 3_600_000_000_000


@dataclass(frozen=True)
class Scene:
    """What an injector works with."""

    load: Load
    target: Target
    folder: Path
    """Where the faulty service looks for its faults."""


Inject = Callable[[Scene, int], Awaitable[bool]]
"""Injects the n-th fault of a kind, lets it pass, and says whether its trace was seen."""


async def camera_loss(scene: Scene, number: int) -> bool:
    """A camera falls silent for a while: sets go on without it."""
    streamer = scene.load.streamer
    before = streamer.statuses["missing"]
    streamer.muted = {list(streamer.site.cameras)[number % len(streamer.site.cameras)]}
    await asyncio.sleep(FAULT_S)
    streamer.muted = set()
    await until(lambda: streamer.statuses["missing"] > before)
    return streamer.statuses["missing"] > before


async def garbage_frame(scene: Scene, number: int) -> bool:
    """Random bytes instead of a JPEG, posted and streamed."""
    return await _broken_frame(scene, number, lambda frame: os.urandom(len(frame)))


async def truncated_jpeg(scene: Scene, number: int) -> bool:
    """A JPEG that ends too early; every second one with an end marker, so that only decoding shows it."""
    share = (number % 10 + 1) / 12
    end = b"\xff\xd9" if number % 2 else b""
    return await _broken_frame(scene, number, lambda frame: frame[: round(len(frame) * share)] + end)


async def _broken_frame(scene: Scene, number: int, broken: Callable[[bytes], bytes]) -> bool:
    target, streamer = scene.load.target, scene.load.streamer
    frames = target.site.frames(scene.load.clip, number)
    camera = list(frames)[number % len(frames)]
    status, message = await target.post(frames | {camera: broken(frames[camera])})
    is_told = status == 422 or (status == 200 and message is not None and message.cameras[camera].status == "bad")
    # A busy service may turn the request away before it looks at the frame; that is no answer to this question.
    is_told = is_told or status == 503
    before = streamer.statuses["bad"]
    camera = list(streamer.site.cameras)[number % len(streamer.site.cameras)]
    streamer.replaced = {camera: broken(streamer.site.frames(scene.load.clip, number)[camera])}
    await asyncio.sleep(FAULT_S)
    streamer.replaced = {}
    await until(lambda: streamer.statuses["bad"] > before)
    return is_told and streamer.statuses["bad"] > before


def network_fault(fault: NetworkFault) -> Inject:
    """A fault of the networks or of the worker that runs them."""

    async def inject(scene: Scene, number: int) -> bool:
        target = scene.load.target
        path = fault_file(scene.folder, target.site.id, fault)
        failed_before = target.account.statuses[500]
        path.touch()
        # A busy service may refuse a request before it reaches the networks; the fault then waits for the next one.
        for _ in range(_STRIKES):
            struck = asyncio.create_task(target.post())
            scene.load.background.append(struck)
            await until(partial(_is_met, path, struck))
            if not path.exists():
                break
        if fault is NetworkFault.RAISE:
            await struck
            return target.account.statuses[500] > failed_before
        # Nobody waits for the struck request: the others' answers are looked at while it hangs. It is in the account.
        return not path.exists()

    return inject


def _is_met(path: Path, struck: asyncio.Task[Any]) -> bool:
    """Whether a request has met its fault, or was refused before."""
    return not path.exists() or struck.done()


async def clock_step(scene: Scene, number: int) -> bool:
    """The clock of one camera, or of all, jumps by an hour and later back."""
    streamer = scene.load.streamer
    cameras = list(streamer.site.cameras)
    stepping = cameras if number % 2 else cameras[number // 2 % len(cameras) :][:1]
    shift_ns = _CLOCK_STEP_NS if number % 4 < 2 else -_CLOCK_STEP_NS
    missing, seen = streamer.statuses["missing"], streamer.account.seen
    streamer.shift_ns = dict.fromkeys(stepping, shift_ns)
    await asyncio.sleep(FAULT_S)
    # One camera alone is left out; where all step, their sets go on.
    noticed = await until(lambda: streamer.account.seen > seen if number % 2 else streamer.statuses["missing"] > missing)
    streamer.shift_ns = {}
    return noticed


async def disk_full(scene: Scene, number: int) -> bool:
    """Nothing can be written any more, or the data folder is no folder any more: sites cannot be kept, frames are answered."""
    pid, site = scene.target.process.pid, scene.load.target.site
    moved = scene.target.data_dir.with_name("moved")
    limits = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    if number % 2:
        scene.target.data_dir.rename(moved)
        scene.target.data_dir.touch()
    else:
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, limits[1]))
    try:
        refused = await _put(scene, site) is not None
        answered = await _until_posted(scene)
    finally:
        if number % 2:
            scene.target.data_dir.unlink()
            moved.rename(scene.target.data_dir)
        else:
            resource.prlimit(pid, resource.RLIMIT_FSIZE, limits)
    return refused and answered and await _put(scene, site) is None


async def _put(scene: Scene, site: LoadSite) -> int | None:
    """Put a site; None when it is kept, else the status of the refusal."""
    try:
        async with AsyncClient(scene.target.url) as client:
            await client.put_site(dict(site.document))
    except ServiceError as error:
        return error.status or 0
    return None


async def _until_posted(scene: Scene) -> bool:
    began = time.monotonic()
    while time.monotonic() - began < RECOVER_S:
        if (await scene.load.target.post())[0] == 200:
            return True
    return False


async def until(is_so: Callable[[], bool], within_s: float = 4.0) -> bool:
    """Wait for something, for a time; whether it came."""
    began = time.monotonic()
    while not is_so() and time.monotonic() - began < within_s:
        await asyncio.sleep(0.02)
    return is_so()


KINDS: dict[str, Inject] = {
    "camera_loss": camera_loss,
    "garbage_frame": garbage_frame,
    "truncated_jpeg": truncated_jpeg,
    "network_raises": network_fault(NetworkFault.RAISE),
    "worker_hangs": network_fault(NetworkFault.HANG),
    "worker_killed": network_fault(NetworkFault.KILL),
    "clock_step": clock_step,
    "disk_full": disk_full,
}
