"""``quadlift demo``: the service, fed in real time with the recorded clip, and its live page in the browser."""

from __future__ import annotations

import os
import signal
import statistics
import sys
import time
import webbrowser
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer
from rich.console import Console
from rich.live import Live
from rich.text import Text

from clients.client import Client, ServiceError
from clients.clip import SHIPPED, Clip, ClipError, open_clip
from clients.local_service import HOST, LocalServiceError, free_port, running_service

FAILURES_IN_A_ROW = 50
"""After so many refused frame sets the demo gives up."""
_STATUS_HZ = 4.0
_RECENT = 50

app = typer.Typer(add_completion=False)
console = Console()


class DemoError(Exception):
    """The demo cannot go on; the message is for the user."""


@dataclass
class Progress:
    """What the demo has sent and got back so far."""

    answered: int = 0
    failed: int = 0
    skipped: int = 0
    """Steps left out because the answer before them came too late."""
    failed_in_a_row: int = 0
    last_failure: str = ""
    boxes: int = 0
    latencies_ms: deque[float] = field(default_factory=lambda: deque(maxlen=_RECENT))
    answer_times: deque[float] = field(default_factory=lambda: deque(maxlen=_RECENT))

    def succeeded(self, boxes: int, latency_ms: float) -> None:
        """Count an answer."""
        self.answered += 1
        self.failed_in_a_row = 0
        self.boxes = boxes
        self.latencies_ms.append(latency_ms)
        self.answer_times.append(time.monotonic())

    def refused(self, error: ServiceError) -> None:
        """Count a refusal. Raises DemoError when there were too many in a row."""
        self.failed += 1
        self.failed_in_a_row += 1
        self.last_failure = str(error)
        if self.failed_in_a_row >= FAILURES_IN_A_ROW:
            raise DemoError(f"the service refused {self.failed_in_a_row} frame sets in a row: {error}")

    @property
    def rate_hz(self) -> float:
        """Answers a second, lately."""
        if len(self.answer_times) < 2:
            return 0.0
        return (len(self.answer_times) - 1) / (self.answer_times[-1] - self.answer_times[0])

    @property
    def latency_ms(self) -> float:
        """Median time from sending to the answer, lately."""
        return statistics.median(self.latencies_ms) if self.latencies_ms else 0.0


@app.command()
def demo(
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port of the page; 0 takes a free one.")] = 8000,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page.")] = True,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="Stop after this time; else at Ctrl-C.")] = None,
    rate: Annotated[float, typer.Option(min=0.1, max=60, help="Frame sets a second.")] = 10.0,
    clip: Annotated[Path, typer.Option(help="Folder of the clip to play.", show_default="the shipped one")] = SHIPPED,
) -> None:
    """Show a live four-camera intersection in the browser; Ctrl-C stops."""
    progress = Progress()
    try:
        with _terminable():
            _run(open_clip(clip), port, browser, seconds, rate, progress)
    except KeyboardInterrupt:
        # Ctrl-C is how the demo is meant to end.
        pass
    except (ClipError, DemoError, LocalServiceError) as error:
        console.print(Text.assemble(("Error: ", "bold red"), str(error)))
        raise typer.Exit(1) from None
    console.print(summary(progress), highlight=False)
    if not progress.answered:
        raise typer.Exit(1)


def summary(progress: Progress) -> str:
    """What happened, in one line."""
    text = (
        f"{progress.answered} frame sets answered, {progress.failed} refused, {progress.skipped} skipped; "
        f"{progress.rate_hz:.1f} sets/s, median latency {progress.latency_ms:.0f} ms."
    )
    return f"{text} Last refusal: {progress.last_failure}" if progress.last_failure else text


def has_display() -> bool:
    """Whether a browser window can be shown."""
    if sys.platform.startswith("linux"):
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return True


def _run(clip: Clip, port: int, browser: bool, seconds: float | None, rate_hz: float, progress: Progress) -> None:
    chosen = free_port(port)
    if port not in (0, chosen):
        console.print(f"Port {port} is taken; using {chosen}.", highlight=False)
    url = f"http://{HOST}:{chosen}"
    console.print("Starting the service…")
    with running_service(clip.path / "site.json", chosen), Client(url) as client:
        announce(url, browser)
        replay(client, clip, rate_hz, seconds, progress, url)


def announce(url: str, browser: bool) -> None:
    """Open the page, or say where it is."""
    opened = browser and has_display() and webbrowser.open(url)
    console.print(Text.assemble("Live page: ", (url, "bold cyan"), "" if opened else "  (open it in a browser)"))


def replay(client: Client, clip: Clip, rate_hz: float, seconds: float | None, progress: Progress, url: str) -> None:
    """Send the clip again and again at ``rate_hz``, for ``seconds`` or without end; late steps are skipped, never queued."""
    site = str(clip.site["id"])
    began = time.monotonic()
    start_ns = time.time_ns()
    number = 0
    line = status_line(progress, url)
    # Where nobody watches (a log), the summary at the end says it all.
    transient = not console.is_terminal
    with Live(line, console=console, refresh_per_second=_STATUS_HZ, transient=transient) as live:
        while seconds is None or number < seconds * rate_hz:
            time.sleep(max(0.0, began + number / rate_hz - time.monotonic()))
            moment = clip.moment(number, start_ns, rate_hz)
            frames = clip.frames(moment.step)
            sent = time.monotonic()
            try:
                message = client.detect(site, frames, utc_from_ns(moment.captured_at_ns))
                progress.succeeded(len(message.boxes), (time.monotonic() - sent) * 1e3)
            except ServiceError as error:
                progress.refused(error)
            live.update(status_line(progress, url))
            elapsed_s = time.monotonic() - began
            # What would come after the end is not skipped.
            due = int((elapsed_s if seconds is None else min(elapsed_s, seconds)) * rate_hz)
            progress.skipped += max(0, due - number - 1)
            number = max(number + 1, due)


def status_line(progress: Progress, url: str) -> Text:
    """The line that is shown while the clip plays."""
    tone = "green" if progress.failed_in_a_row == 0 else "red"
    line = Text.assemble(
        ("● ", tone),
        (f"{progress.rate_hz:4.1f}", "bold"),
        " sets/s  ",
        (f"{progress.latency_ms:3.0f}", "bold"),
        " ms  ",
        (f"{progress.boxes:2d}", "bold"),
        " boxes  ",
        (url, "cyan"),
        ("  Ctrl-C stops", "dim"),
    )
    if progress.failed_in_a_row:
        line.append(f"\n{progress.last_failure}", "red")
    return line


def utc_from_ns(time_ns: int) -> datetime:
    """The time of nanoseconds since 1970, to the microsecond."""
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=time_ns // 1000)


@contextmanager
def _terminable() -> Iterator[None]:
    """Let SIGTERM end the demo as Ctrl-C does, so that the child never outlives it."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
