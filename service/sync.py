"""Groups the frames of one site's cameras into frame sets by capture time. Pure: the caller passes the clock.

A set is the earliest pending frame and, of every other camera, its earliest pending frame within the tolerance. It goes out
as soon as every present camera is in it, and otherwise with the cameras it has when the wait of any pending frame ends.
Sets come in the order of their capture times, except where the whole site's clock steps back (then ``epoch`` rises).
Every frame ends in one set or in one counted drop.
"""

from __future__ import annotations

import statistics
from bisect import insort
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from service.frames import EncodedFrame
from service.telemetry import Drop

SyncStatus = Literal["ok", "stale", "missing"]

_REMEMBERED_TIMES = 64
"""Capture times kept of each camera to recognize a frame that is sent twice."""


@dataclass(frozen=True)
class SyncSettings:
    """How frames are grouped; all times in nanoseconds."""

    tolerance_ns: int = 20_000_000
    """Frames of one set differ by at most this; choose it below the shortest time between two frames of one camera."""
    wait_ns: int = 50_000_000
    """A frame is held this long for the other cameras; longer, by at most ``clock_ns``, where its own came ahead of theirs."""
    stale_ns: int = 50_000_000
    """A frame that missed its set may stand in for its camera in a set captured at most this much later; 0: never."""
    clock_ns: int = 250_000_000
    """Clock and delay of a camera may differ from the site's other cameras by this; frames beyond it are dropped."""
    absent_ns: int = 2_000_000_000
    """A camera that was silent for this long is not waited for any more."""
    max_pending: int = 8
    """Frames of one camera that may wait; the newest stay."""
    max_bytes: int = 64 * 2**20
    """Bytes of all frames that may wait; one more is dropped."""


@dataclass(frozen=True, eq=False)
class SyncedSet:
    """Frames that belong together."""

    frames: tuple[EncodedFrame, ...]
    """At most one a camera, sorted by camera id."""
    captured_at_ns: int
    """Of the earliest frame that is not stale; nanoseconds since 1970 (UTC)."""
    stale: frozenset[str]
    """Cameras whose frame was captured before this set and came too late for its own."""
    epoch: int
    """Counts the clock steps of the site; capture times rise within an epoch."""

    def status(self, camera_id: str) -> SyncStatus:
        """What a camera gave to this set."""
        if camera_id in self.stale:
            return "stale"
        return "ok" if any(frame.camera_id == camera_id for frame in self.frames) else "missing"


@dataclass(frozen=True, eq=False)
class _Pending:
    captured_at_ns: int
    due_ns: int
    """On the caller's clock."""
    frame: EncodedFrame


@dataclass(eq=False)
class _Camera:
    seen_ns: int
    offset_ns: int
    """Capture time minus time of arrival of its newest frame."""
    pending: list[_Pending] = field(default_factory=list)
    """By capture time."""
    late: EncodedFrame | None = None
    gone: bool = False
    """It left; its pending frames still go out, but nobody waits for more."""
    times: deque[int] = field(default_factory=lambda: deque(maxlen=_REMEMBERED_TIMES))


class Synchronizer:
    """The frames of one site that wait for their set. Memory is bounded by ``max_pending`` frames a camera."""

    def __init__(self, settings: SyncSettings, on_drop: Callable[[Drop], None] = lambda _: None) -> None:
        """on_drop: told of every frame that ends in no set."""
        self._settings = settings
        self._on_drop = on_drop
        self._cameras: dict[str, _Camera] = {}
        self._offset_ns: int | None = None
        self._last: SyncedSet | None = None
        self._epoch = 0
        self.dropped: Counter[Drop] = Counter()

    @property
    def pending(self) -> int:
        """Frames that are in no set yet and not dropped."""
        return sum(len(camera.pending) + (camera.late is not None) for camera in self._cameras.values())

    @property
    def present(self) -> frozenset[str]:
        """Cameras that sets wait for."""
        return frozenset(camera_id for camera_id, camera in self._cameras.items() if not camera.gone)

    @property
    def pending_bytes(self) -> int:
        """Bytes of the frames that are in no set yet and not dropped."""
        cameras = self._cameras.values()
        late = sum(len(camera.late.data) for camera in cameras if camera.late is not None)
        return late + sum(len(pending.frame.data) for camera in cameras for pending in camera.pending)

    @property
    def deadline_ns(self) -> int | None:
        """When :meth:`poll` has something to do at the latest, on the caller's clock; None while nothing is pending."""
        return min((frame.due_ns for camera in self._cameras.values() for frame in camera.pending), default=None)

    def push(self, frame: EncodedFrame, now_ns: int) -> list[SyncedSet]:
        """Take a frame with a capture time; its camera is present from now on. Gives the sets that are ready.

        now_ns: a clock that never goes back. Raises ValueError for a frame without a capture time.
        """
        if frame.captured_at_ns is None:
            raise ValueError("a frame without a capture time cannot be grouped")
        time_ns = frame.captured_at_ns
        camera = self._cameras.setdefault(frame.camera_id, _Camera(now_ns, time_ns - now_ns))
        camera.seen_ns, camera.gone = now_ns, False
        if time_ns in camera.times:
            self._drop(Drop.FRAME_DUPLICATE)
            return self.poll(now_ns)
        camera.times.append(time_ns)
        camera.offset_ns = time_ns - now_ns
        ready = self._follow_clocks()
        assert self._offset_ns is not None
        if abs(camera.offset_ns - self._offset_ns) > self._settings.clock_ns:
            self._drop(Drop.FRAME_CLOCK)
        elif self.pending_bytes + len(frame.data) > self._settings.max_bytes:
            self._drop(Drop.FRAME_BACKLOG)
        elif self._missed(frame.camera_id, time_ns):
            self._keep_late(camera, frame, time_ns)
        else:
            # A camera whose clock is ahead is held until the others can have caught up with it.
            due_ns = max(now_ns, time_ns - self._offset_ns) + self._settings.wait_ns
            insort(camera.pending, _Pending(time_ns, due_ns, frame), key=lambda pending: pending.captured_at_ns)
            if len(camera.pending) > self._settings.max_pending:
                del camera.pending[0]
                self._drop(Drop.FRAME_BACKLOG)
        return ready + self.poll(now_ns)

    def poll(self, now_ns: int) -> list[SyncedSet]:
        """The sets that are complete or whose wait has ended, in order; forgets cameras that fell silent."""
        self._forget_absent(now_ns)
        ready = []
        while (members := self._earliest()) and self._is_ready(members, now_ns):
            ready.append(self._take(members))
        self._forget_absent(now_ns)
        return ready

    def leave(self, camera_id: str, now_ns: int) -> list[SyncedSet]:
        """A camera is gone: its pending frames still go out, but nobody waits for more. Gives the sets that are ready."""
        if camera_id in self._cameras:
            self._cameras[camera_id].gone = True
        return self.poll(now_ns)

    def close(self) -> None:
        """The site is gone: everything pending is dropped and counted."""
        for camera_id in list(self._cameras):
            self._forget(camera_id)

    def _earliest(self) -> dict[str, _Pending]:
        """The next set as it stands: each camera's first frame, if it lies within the tolerance of the earliest."""
        heads = {camera_id: camera.pending[0] for camera_id, camera in self._cameras.items() if camera.pending}
        first_ns = min((head.captured_at_ns for head in heads.values()), default=0)
        return {c: head for c, head in heads.items() if head.captured_at_ns <= first_ns + self._settings.tolerance_ns}

    def _is_ready(self, members: dict[str, _Pending], now_ns: int) -> bool:
        deadline_ns = self.deadline_ns
        return self.present <= members.keys() or (deadline_ns is not None and deadline_ns <= now_ns)

    def _take(self, members: dict[str, _Pending]) -> SyncedSet:
        captured_at_ns = min(member.captured_at_ns for member in members.values())
        frames = {camera_id: member.frame for camera_id, member in members.items()}
        stale = set()
        for camera_id, camera in self._cameras.items():
            if camera_id in members:
                del camera.pending[0]
            if camera.late is None:
                continue
            if camera_id not in members and self._is_fresh(camera.late, captured_at_ns):
                frames[camera_id] = camera.late
                stale.add(camera_id)
            else:
                self._drop(Drop.FRAME_LATE)
            camera.late = None
        ordered = tuple(frames[camera_id] for camera_id in sorted(frames))
        self._last = SyncedSet(ordered, captured_at_ns, frozenset(stale), self._epoch)
        return self._last

    def _missed(self, camera_id: str, time_ns: int) -> bool:
        """Whether the set that a frame belongs to has gone out."""
        if self._last is None or time_ns > self._last.captured_at_ns + self._settings.tolerance_ns:
            return False
        return time_ns <= self._last.captured_at_ns or self._last.status(camera_id) != "ok"

    def _keep_late(self, camera: _Camera, frame: EncodedFrame, time_ns: int) -> None:
        """Keep the newest late frame of a camera for the next set."""
        if camera.late is not None:
            self._drop(Drop.FRAME_LATE)
            if (camera.late.captured_at_ns or 0) > time_ns:
                return
        camera.late = frame

    def _is_fresh(self, late: EncodedFrame, captured_at_ns: int) -> bool:
        return late.captured_at_ns is not None and 0 < captured_at_ns - late.captured_at_ns <= self._settings.stale_ns

    def _follow_clocks(self) -> list[SyncedSet]:
        """Keep the site's clock while half of the cameras agree with it, else begin an epoch; gives the old epoch's sets."""
        offsets = [camera.offset_ns for camera in self._cameras.values()]
        reference = self._offset_ns
        if reference is not None:
            agreeing = [offset for offset in offsets if abs(offset - reference) <= self._settings.clock_ns]
            if 2 * len(agreeing) >= len(offsets):
                self._offset_ns = statistics.median_low(agreeing)
                return []
        self._offset_ns = statistics.median_low(offsets)
        ready = []
        while members := self._earliest():
            ready.append(self._take(members))
        for camera in self._cameras.values():
            if camera.late is not None:
                camera.late = None
                self._drop(Drop.FRAME_LATE)
        if reference is not None:
            self._last = None
            self._epoch += 1
        return ready

    def _forget_absent(self, now_ns: int) -> None:
        for camera_id, camera in list(self._cameras.items()):
            is_absent = camera.gone or now_ns - camera.seen_ns > self._settings.absent_ns
            if is_absent and not camera.pending:
                self._forget(camera_id)

    def _forget(self, camera_id: str) -> None:
        camera = self._cameras.pop(camera_id)
        for _ in range(len(camera.pending) + (camera.late is not None)):
            self._drop(Drop.FRAME_LEFT)

    def _drop(self, reason: Drop) -> None:
        self.dropped[reason] += 1
        self._on_drop(reason)
