"""Load on several sites at once, with a check that every answer belongs to whom it was given, and an account of all of them."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any

from clients.client import AsyncClient, ServiceError, Timeouts
from clients.clip import Clip
from clients.ingest import IngestClient
from service.schemas import Detections, ns_from_rfc3339, rfc3339_from_ns

ANSWER_S = 12.0
"""A request without an answer for this long has none."""
PAUSE_S = 0.2
"""Between an answer and the next request of a poster."""
STREAM_HZ = 2.5
"""With the posters about a third of what two idle cores can do: what fails then fails for its fault."""
_RETRY_S = 0.2
_moments = itertools.count()


@dataclass(frozen=True, eq=False)
class LoadSite:
    """A site with some of the clip's cameras under names of its own, so that a stranger's answer shows."""

    id: str
    cameras: Mapping[str, str]
    """The clip's camera by the site's."""
    document: Mapping[str, Any]

    def frames(self, clip: Clip, step: int) -> dict[str, bytes]:
        """The JPEGs of one step, by the site's cameras."""
        return {own: clip.frame(camera, step % clip.steps) for own, camera in self.cameras.items()}

    def owns(self, message: Detections) -> bool:
        """Whether a message speaks of this site and its cameras, and of no other."""
        seen = {camera for box in message.boxes for camera in box.cameras}
        return message.site == self.id and message.cameras.keys() == self.cameras.keys() and seen <= self.cameras.keys()


def load_site(clip: Clip, site_id: str, count: int) -> LoadSite:
    """A site of the clip's first ``count`` cameras."""
    chosen = [camera for camera in clip.site["cameras"] if camera["id"] in clip.camera_ids[:count]]
    names = {f"{site_id}-{camera['id']}": camera["id"] for camera in chosen}
    cameras = [camera | {"id": f"{site_id}-{camera['id']}"} for camera in chosen]
    return LoadSite(site_id, names, clip.site | {"id": site_id, "cameras": cameras})


@dataclass
class Account:
    """What became of what was sent."""

    sent: int = 0
    statuses: Counter[int] = field(default_factory=Counter)
    """Of answers; a refusal is an answer."""
    unanswered: int = 0
    wrong_owner: int = 0
    moments: int = 0
    """Sets sent over a camera stream."""
    seen: int = 0
    """Of these, the ones whose message came."""

    def add(self, other: Account) -> None:
        """Take another's numbers in."""
        for name in ("sent", "unanswered", "wrong_owner", "moments", "seen"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.statuses += other.statuses


class Poster:
    """A client that posts sets of one site and checks each answer: the site, its cameras, its own capture time."""

    def __init__(self, url: str, site: LoadSite, clip: Clip) -> None:
        self.site = site
        self.account = Account()
        self.flights: list[tuple[float, int | None]] = []
        """When each request was sent (time.monotonic) and its status; None without an answer."""
        self._clip = clip
        self._client = AsyncClient(url, Timeouts(answer_s=ANSWER_S))
        self._steps = itertools.count()
        self._flying: asyncio.Task[tuple[int | None, Detections | None]] | None = None

    async def post(self, frames: Mapping[str, bytes] | None = None) -> tuple[int | None, Detections | None]:
        """One request: its status, None without an answer, and its message where there is one."""
        # Every request has a capture time that no other has.
        captured_at = datetime.now(UTC).replace(microsecond=0) + timedelta(microseconds=next(_moments) % 1_000_000)
        sent_at, status, message = time.monotonic(), None, None
        self.account.sent += 1
        try:
            given = self.site.frames(self._clip, next(self._steps)) if frames is None else frames
            message = await self._client.detect(self.site.id, given, captured_at)
        except ServiceError as error:
            status = error.status
        else:
            status = 200
            own_time = ns_from_rfc3339(message.captured_at) == ns_from_rfc3339(captured_at.isoformat())
            if not (self.site.owns(message) and own_time):
                self.account.wrong_owner += 1
        if status is None:
            self.account.unanswered += 1
        else:
            self.account.statuses[status] += 1
        self.flights.append((sent_at, status))
        return status, message

    async def run(self) -> None:
        """Post until cancelled; a request under way is finished."""
        while True:
            self._flying = asyncio.create_task(self.post())
            await asyncio.shield(self._flying)
            await asyncio.sleep(PAUSE_S)

    async def aclose(self) -> None:
        """Close the connection, when the last answer has come."""
        if self._flying is not None:
            await self._flying
        await self._client.aclose()


class Streamer:
    """All cameras of a site over one camera stream, and a reader that checks the messages."""

    def __init__(self, url: str, site: LoadSite, clip: Clip) -> None:
        self.site = site
        self.account = Account()
        self.muted: set[str] = set()
        """Cameras that send nothing for now."""
        self.shift_ns: dict[str, int] = {}
        """What clocks are wrong by, by camera."""
        self.replaced: dict[str, bytes] = {}
        """What cameras send instead of their frame."""
        self.statuses: Counter[str] = Counter()
        """Of cameras in messages."""
        self.whole_at = 0.0
        """When the last message came in which all cameras were ok (time.monotonic)."""
        self.answers: Counter[str] = Counter()
        """Refusals of frames, by code."""
        self._url, self._clip = url, clip
        self._waiting: set[str] = set()
        self._known: set[str] = set()

    async def send(self) -> None:
        """Send moments until cancelled; connects again when the connection breaks."""
        while True:
            client = IngestClient(self._url, self.site.id)
            try:
                await client.open()
                await self._send_over(client)
            except ServiceError:
                # The service is away or has cut us off: cameras try again.
                await asyncio.sleep(_RETRY_S)
            finally:
                await client.aclose()
                self.answers.update(error.code for error in client.errors)

    async def _send_over(self, client: IngestClient) -> None:
        for step in itertools.count():
            began = time.monotonic()
            frames = self.site.frames(self._clip, step) | self.replaced
            now_ns = time.time_ns()
            stamps = {camera: now_ns + self.shift_ns.get(camera, 0) for camera in frames if camera not in self.muted}
            good = {rfc3339_from_ns(stamp) for camera, stamp in stamps.items() if camera not in self.replaced}
            self._known |= good
            if good:
                common = Counter(stamps.values()).most_common(1)[0][0]
                self.account.moments += 1
                self._waiting.add(rfc3339_from_ns(common))
            for camera, stamp in stamps.items():
                await client.send(camera, frames[camera], stamp)
            await asyncio.sleep(max(0.0, 1 / STREAM_HZ - (time.monotonic() - began)))

    async def read(self) -> None:
        """Read messages until cancelled."""
        while True:
            try:
                async with AsyncClient(self._url) as client:
                    async for message in client.stream(self.site.id):
                        self._take(message)
            except ServiceError:
                # As the sender does.
                await asyncio.sleep(_RETRY_S)

    def _take(self, message: Detections) -> None:
        self.statuses.update(camera.status for camera in message.cameras.values())
        if not self.site.owns(message) or message.captured_at not in self._known:
            self.account.wrong_owner += 1
        if message.captured_at in self._waiting:
            self._waiting.discard(message.captured_at)
            self.account.seen += 1
        if not message.degraded:
            self.whole_at = time.monotonic()


class Load:
    """Posters and a streamer that run together, and a target that only faults use."""

    def __init__(self, url: str, clip: Clip, steady: Sequence[LoadSite], target: LoadSite, streamed: LoadSite) -> None:
        self.clip = clip
        self.posters = [Poster(url, site, clip) for site in steady]
        self.target = Poster(url, target, clip)
        self.streamer = Streamer(url, streamed, clip)
        self.background: list[asyncio.Task[Any]] = []
        """Requests that somebody began and nobody waits for; their outcome is in the account."""
        self._tasks: list[asyncio.Task[None]] = []
        self._sender: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Load:
        """Start."""
        self._tasks = [asyncio.create_task(poster.run()) for poster in self.posters]
        self._tasks.append(asyncio.create_task(self.streamer.read()))
        self._sender = asyncio.create_task(self.streamer.send())
        return self

    async def __aexit__(self, *ended: object) -> None:
        """Stop sending, wait for what is under way, stop reading."""
        senders = [*self._tasks[:-1], *([self._sender] if self._sender else [])]
        for task in senders:
            task.cancel()
        await asyncio.gather(*senders, return_exceptions=True)
        await asyncio.gather(*self.background, return_exceptions=True)
        for poster in (*self.posters, self.target):
            await poster.aclose()
        # The last set waits for cameras, then for a worker: a second is plenty for both, and for its message.
        await asyncio.sleep(1.0)
        self._tasks[-1].cancel()
        await asyncio.gather(self._tasks[-1], return_exceptions=True)

    def account(self) -> Account:
        """Everybody's account together."""
        whole = Account()
        for part in (*(poster.account for poster in self.posters), self.target.account, self.streamer.account):
            whole.add(part)
        return whole

    async def recovers(self, within_s: float) -> float | None:
        """Seconds until every site has answered a good set in full once more; None when it takes too long."""
        began = time.monotonic()
        missing = [*self.posters, self.target]
        while time.monotonic() - began < within_s:
            tried = [(poster, await self._is_whole(poster)) for poster in missing]
            missing = [poster for poster, is_whole in tried if not is_whole]
            if not missing and self.streamer.whole_at > began:
                return time.monotonic() - began
            await asyncio.sleep(PAUSE_S)
        return None

    async def _is_whole(self, poster: Poster) -> bool:
        status, message = await poster.post()
        return status == 200 and message is not None and not message.degraded
