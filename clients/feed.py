"""``quadlift feed``: push recordings or live cameras to a running service."""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from typing import Annotated

import typer
from rich.console import Console
from rich.text import Text

from clients.client import DEFAULT_URL, ServiceError
from clients.ingest import IngestClient
from clients.sources import Source, SourceError, open_source

DEFAULT_RATE_HZ = 10.0
RECONNECT_S = 1.0
"""Between two attempts to open a live source."""
FIRST_RETRY_S = 0.2
LAST_RETRY_S = 5.0

app = typer.Typer(add_completion=False)
console = Console()


@dataclass
class Fed:
    """What became of one camera's frames."""

    sent: int = 0
    refused: int = 0
    lost: int = 0
    """Frames that went by while there was no connection."""
    last_refusal: str = ""
    """What the service, or a live source, said last."""


@dataclass(frozen=True)
class FeedPlan:
    """What to send where."""

    url: str
    site: str
    sources: dict[str, Source]
    """By camera id."""
    rate_hz: float | None = None
    """Frames a second of recordings; None: their own, or ten."""
    loop: bool = False
    """Begin recordings again when they end."""
    token: str | None = None
    """Where the service wants one, with the scope ``ingest``."""


async def feed_all(plan: FeedPlan, fed: dict[str, Fed]) -> None:
    """Feed every camera over its own connection until all have ended. Raises SourceError, ServiceError (refused)."""
    start_ns = time.time_ns()
    async with asyncio.TaskGroup() as group:
        for camera, source in plan.sources.items():
            group.create_task(_Feeder(plan, camera, source, fed[camera], start_ns).run())


class _Feeder:
    """One camera: reads in a thread, sends at the recording's pace, connects again when the service goes away."""

    def __init__(self, plan: FeedPlan, camera: str, source: Source, fed: Fed, start_ns: int) -> None:
        self._plan, self._camera, self._source, self._fed, self._start_ns = plan, camera, source, fed, start_ns
        self._client: IngestClient | None = None
        self._retry_at = 0.0
        self._retry_s = FIRST_RETRY_S

    async def run(self) -> None:
        """Feed until the recording ends; a live source never does."""
        try:
            await (self._run_live() if self._source.is_live else self._run_recording())
        finally:
            await self._disconnect()

    async def _run_live(self) -> None:
        while True:
            frames = self._source.frames()
            try:
                while (data := await asyncio.to_thread(next, frames, None)) is not None:
                    await self._send(data, time.time_ns())
            except SourceError as error:
                self._fed.last_refusal = str(error)
            # A camera that restarts is away for a while; the service says that it is missing.
            await asyncio.sleep(RECONNECT_S)

    async def _run_recording(self) -> None:
        frames = _endless(self._source) if self._plan.loop else self._source.frames()
        rate_hz = self._plan.rate_hz or self._source.rate_hz or DEFAULT_RATE_HZ
        for number in count():
            data = await asyncio.to_thread(next, frames, None)
            if data is None:
                return
            captured_at_ns = self._start_ns + round(number * 1e9 / rate_hz)
            await asyncio.sleep(max(0.0, (captured_at_ns - time.time_ns()) / 1e9))
            await self._send(data, captured_at_ns)

    async def _send(self, data: bytes, captured_at_ns: int) -> None:
        client = await self._connected()
        if client is None:
            self._fed.lost += 1
            return
        try:
            await client.send(self._camera, data, captured_at_ns)
        except ServiceError:
            self._fed.lost += 1
            await self._disconnect()
            return
        self._fed.sent += 1
        self._note_refusals(client)

    async def _connected(self) -> IngestClient | None:
        """The connection; None while the service cannot be reached. Raises ServiceError when it will never take us."""
        if self._client is not None or time.monotonic() < self._retry_at:
            return self._client
        client = IngestClient(self._plan.url, self._plan.site, token=self._plan.token)
        try:
            await client.open()
        except ServiceError as error:
            if error.status is not None and 400 <= error.status < 500:
                raise
            self._retry_at = time.monotonic() + self._retry_s
            self._retry_s = min(LAST_RETRY_S, 2 * self._retry_s)
            return None
        self._client, self._retry_s = client, FIRST_RETRY_S
        return client

    async def _disconnect(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            await client.aclose()
            self._note_refusals(client)
            self._fed.refused += client.refused
            client.refused = 0

    def _note_refusals(self, client: IngestClient) -> None:
        if client.errors:
            newest = client.errors[-1]
            self._fed.last_refusal = f"{newest.field}: {newest.message}" if newest.field else newest.message


def _endless(source: Source) -> Iterator[bytes]:
    while True:
        yield from source.frames()


@app.command()
def feed(
    site: Annotated[str, typer.Argument(help="The site's id.")],
    cameras: Annotated[
        list[str], typer.Argument(help="CAMERA=SOURCE each: a folder of JPEGs, a JPEG, a video file, or an rtsp:// URL.")
    ],
    url: Annotated[str, typer.Option(help="The service's root.")] = DEFAULT_URL,
    rate: Annotated[float | None, typer.Option(min=0.1, max=240, help="Frames a second of recordings.")] = None,
    loop: Annotated[bool, typer.Option(help="Begin recordings again when they end.")] = False,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="Stop after this time.")] = None,
    token: Annotated[str | None, typer.Option(envvar="QUADLIFT_TOKEN", help="Bearer token; better in the environment.")] = None,
) -> None:
    """Push frames of a site's cameras to a running service; Ctrl-C stops."""
    try:
        plan = FeedPlan(url, site, parse_cameras(cameras), rate, loop, token)
        fed = {camera: Fed() for camera in plan.sources}
        asyncio.run(_run(plan, fed, seconds))
    except* (SourceError, ServiceError) as group:
        console.print(Text.assemble(("Error: ", "bold red"), str(_first(group))))
        raise typer.Exit(1) from None
    for camera, result in fed.items():
        console.print(summary(camera, result), highlight=False)
    if not any(result.sent for result in fed.values()):
        raise typer.Exit(1)


def parse_cameras(texts: list[str]) -> dict[str, Source]:
    """Sources by camera id from ``CAMERA=SOURCE``. Raises SourceError."""
    sources: dict[str, Source] = {}
    for text in texts:
        camera, equals, source = text.partition("=")
        if not (camera and equals and source):
            raise SourceError(f"'{text}': write CAMERA=SOURCE, for example north=recordings/north.")
        if camera in sources:
            raise SourceError(f"camera '{camera}' is given twice.")
        sources[camera] = open_source(source)
    return sources


def summary(camera: str, fed: Fed) -> str:
    """What became of a camera's frames, in one line."""
    line = f"{camera}: {fed.sent} frames sent, {fed.refused} refused, {fed.lost} lost while the service was away"
    return f"{line}; last trouble: {fed.last_refusal}" if fed.last_refusal else line


async def _run(plan: FeedPlan, fed: dict[str, Fed], seconds: float | None) -> None:
    running = asyncio.current_task()
    assert running is not None
    loop = asyncio.get_running_loop()
    stopped = False

    def stop() -> None:
        nonlocal stopped
        stopped = True
        running.cancel()

    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop)
    if seconds is not None:
        loop.call_later(seconds, stop)
    try:
        await feed_all(plan, fed)
    except asyncio.CancelledError:
        if not stopped:
            raise


def _first(group: BaseExceptionGroup[Exception]) -> BaseException:
    error: BaseException = group
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return error
