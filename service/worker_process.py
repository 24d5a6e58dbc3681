"""A process with a pipeline of its own, and what passes between it and the service.

Processes come from a server that has the libraries loaded, so that a new one is there within a fraction of a second. Each
answers one message at a time, in order. A site is sent once, not with every frame set.
"""

from __future__ import annotations

import gc
import io
import multiprocessing
import pickle
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext, SpawnContext
from multiprocessing.process import BaseProcess
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from service.errors import QuadliftError
from service.frames import FrameSet
from service.geometry.ground import Ground
from service.logs import on_behalf_of, request_id
from service.sightings import Sightings
from service.site import Site

if TYPE_CHECKING:
    from service.pipeline import SetResult
    from service.scheduler import FrameSetRunner

_PRELOADED = ["service.pipeline", "service.nets.pack", "service.runners"]
_MAX_KNOWN_SITES = 256
"""Sites that a process keeps by heart; beyond that it begins anew."""
END_S = 2.0
"""For a process to end, of itself or killed."""
_SITE, _GROUND = "site", "ground"


def _make_context() -> ForkServerContext | SpawnContext:
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    return context


_CONTEXT = _make_context()
_ENDS = threading.Lock()
"""Held by who asks whether a process has ended, as starting another one does of all: its exit code can be read but once."""


@runtime_checkable
class DivisibleRunner(Protocol):
    """A runner that can divide a frame set by camera."""

    def see(self, frame_set: FrameSet) -> Sightings:
        """What each camera of a set, or of a part of one, saw by itself."""
        ...

    def fuse(self, site: Site, seen: Sequence[Sightings]) -> SetResult:
        """The result of a set from what its parts saw. Raises FrameError when no frame could be decoded."""
        ...


class EndedError(Exception):
    """A process has ended instead of answering."""


@dataclass(frozen=True)
class _Learn:
    """Tells a process of a site, which later messages name by its id."""

    site: Site
    forgets_others: bool

    def into(self, sites: dict[str, Site]) -> None:
        """The same on both sides."""
        if self.forgets_others:
            sites.clear()
        sites[self.site.id] = self.site


@dataclass(frozen=True)
class _WarmUp:
    """Asks a process to warm its networks up."""


@dataclass(frozen=True)
class _Run:
    """Asks a process to run a frame set."""

    frame_set: FrameSet
    request_id: str | None


@dataclass(frozen=True)
class _See:
    """Asks a process what a part of a set shows. It answers with that, packed, and keeps it for :class:`_Fuse`."""

    part: FrameSet
    request_id: str | None


@dataclass(frozen=True)
class _Fuse:
    """Asks the process that saw a part of a set last for the result of the whole set."""

    site: Site
    before: list[bytes]
    """What others saw of the parts before its own, packed."""
    after: list[bytes]
    """And of those after it."""
    rest: FrameSet | None
    """A part of the set that nobody else took."""
    request_id: str | None


@dataclass(frozen=True)
class _Answer:
    value: Any = None
    error: Exception | None = None
    where: str = ""
    """The traceback of an error, as text: it does not survive the way."""
    took_s: float = 0.0


class _SitePickler(pickle.Pickler):
    """Writes a site's id in its place, and in that of its ground."""

    def __init__(self, file: io.BytesIO, site: Site | None) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._site = site

    def persistent_id(self, obj: Any) -> tuple[str, str] | None:
        if self._site is None:
            return None
        if obj is self._site:
            return _SITE, obj.id
        return (_GROUND, self._site.id) if obj is self._site.ground else None


class _SiteUnpickler(pickle.Unpickler):
    """Puts the known site there again."""

    def __init__(self, data: bytes, sites: dict[str, Site]) -> None:
        super().__init__(io.BytesIO(data))
        self._sites = sites

    def persistent_load(self, pid: tuple[str, str]) -> Site | Ground:
        site = self._sites[pid[1]]
        return site.ground if pid[0] == _GROUND else site


def _packed(message: object, site: Site | None) -> bytes:
    """A message about a site, if about any, that the reader knows."""
    buffer = io.BytesIO()
    _SitePickler(buffer, site).dump(message)
    return buffer.getvalue()


@dataclass(eq=False)
class WorkerProcess:
    """One process, seen from here. Only one thread at a time talks to it; any may kill it."""

    load: Callable[[], FrameSetRunner]
    is_divisible: bool = field(default=False, init=False)
    """Whether it can work at a part of a set; known once it has loaded."""
    took_s: float = field(default=0.0, init=False)
    """What its last answer took it."""
    _process: BaseProcess = field(init=False)
    connection: Connection = field(init=False)
    """To it."""
    _sites: dict[str, Site] = field(default_factory=dict, init=False)
    """What it knows."""

    def __post_init__(self) -> None:
        self.connection, theirs = _CONTEXT.Pipe()
        self._process = _CONTEXT.Process(target=_work, args=(theirs, self.load), name="quadlift-worker")
        with _ENDS:
            self._process.start()
        theirs.close()

    @property
    def pid(self) -> int | None:
        """The system's number for it."""
        return self._process.pid

    def await_loaded(self) -> None:
        """Until it has its pipeline; raises what loading raised, and QuadliftError when the process ended."""
        try:
            self.is_divisible = self.await_answer()
        except EndedError:
            raise QuadliftError(
                f"a worker process ended at its start, with code {self.exit_code()}.",
                remedy="See its output above; memory may have run out.",
            ) from None

    def run(self, frame_set: FrameSet) -> SetResult:
        """The result of a whole set; raises as :meth:`await_answer`."""
        self._teach(frame_set.site)
        self._send(_Run(frame_set, request_id.get()), frame_set.site)
        result: SetResult = self.await_answer()
        return result

    def begin(self, part: FrameSet) -> None:
        """Let it look at a part of a set; its answer is what it saw, packed."""
        self._teach(part.site)
        self._send(_See(part, request_id.get()), part.site)

    def fuse(self, site: Site, before: list[bytes], after: list[bytes], rest: FrameSet | None = None) -> SetResult:
        """The result of the set of which it has just seen a part.

        before, after: what others saw of the parts before and after its own. rest: the part after its own, if nobody saw it.
        """
        self._send(_Fuse(site, before, after, rest, request_id.get()), site)
        result: SetResult = self.await_answer()
        return result

    def warm_up(self) -> None:
        """Let it warm up; its answer says when it has."""
        self._send(_WarmUp(), None)

    def await_answer(self) -> Any:
        """What it has to say; raises its error, and EndedError when it has ended."""
        try:
            said = self.connection.recv_bytes()
        except (EOFError, OSError):
            raise EndedError from None
        answer: _Answer = pickle.loads(said)
        self.took_s = answer.took_s
        if answer.error is not None:
            answer.error.add_note(f"In the worker process:\n{answer.where}")
            raise answer.error
        return answer.value

    def end(self) -> None:
        """Let it end by itself."""
        self.connection.close()

    def kill(self) -> None:
        """End it, whatever it does."""
        with _ENDS:
            self._process.kill()

    def join(self, timeout_s: float) -> None:
        """Until it has ended; it is killed when the time is over."""
        if not wait([self._process.sentinel], max(0.0, timeout_s)):
            self.kill()

    def exit_code(self) -> int | None:
        """Of a process that ends just now; None where it does not."""
        wait([self._process.sentinel], END_S)
        with _ENDS:
            return self._process.exitcode

    def _teach(self, site: Site) -> None:
        """Tell it of a site that it does not know."""
        if self._sites.get(site.id) is not site:
            learn = _Learn(site, forgets_others=len(self._sites) >= _MAX_KNOWN_SITES)
            learn.into(self._sites)
            self._send(learn, None)

    def _send(self, message: _Learn | _WarmUp | _Run | _See | _Fuse, site: Site | None) -> None:
        # That it has ended shows when its answer is awaited.
        with suppress(OSError):
            self.connection.send_bytes(_packed(message, site))


def as_answered(processes: Sequence[WorkerProcess]) -> Iterator[WorkerProcess]:
    """Processes that were asked something, each as soon as its answer is there or it has ended."""
    waiting = {process.connection: process for process in processes}
    while waiting:
        for connection in wait(list(waiting)):
            yield waiting.pop(connection)  # type: ignore[call-overload]


def _work(connection: Connection, load: Callable[[], FrameSetRunner]) -> None:
    """A worker process's life: make the pipeline, then answer until nobody is there any more."""
    # Who stops the service by a signal to all its processes wants it to finish its work first.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    sites: dict[str, Site] = {}
    try:
        desk = None
        try:
            runner = load()
        except Exception as error:
            answer = _failed(error)
        else:
            desk, answer = _Desk(runner, sites), _Answer(isinstance(runner, DivisibleRunner))
            # What is loaded by now stays: the collector need not look through it again and again.
            gc.freeze()
        connection.send_bytes(pickle.dumps(answer, pickle.HIGHEST_PROTOCOL))
        while desk is not None:
            message = _SiteUnpickler(connection.recv_bytes(), sites).load()
            if isinstance(message, _Learn):
                message.into(sites)
            else:
                connection.send_bytes(pickle.dumps(desk.answer(message), pickle.HIGHEST_PROTOCOL))
    except (EOFError, OSError):
        # The service has ended, or has given this process up.
        return


@dataclass(eq=False)
class _Desk:
    """Where a process answers what it is asked."""

    runner: Any
    """A FrameSetRunner; of parts of sets only a DivisibleRunner is asked."""
    sites: dict[str, Site]
    kept: Sightings | None = None
    """Of the part of a set that was seen last."""

    def answer(self, message: _WarmUp | _Run | _See | _Fuse) -> _Answer:
        try:
            if isinstance(message, _WarmUp):
                self.runner.warm_up()
                return _Answer()
            began = time.perf_counter()
            with on_behalf_of(message.request_id):
                return _Answer(self._done(message), took_s=time.perf_counter() - began)
        except Exception as error:
            # Raised again where the caller is.
            return _failed(error)

    def _done(self, message: _Run | _See | _Fuse) -> SetResult | bytes | None:
        if isinstance(message, _Run):
            result: SetResult = self.runner.run(message.frame_set)
            return result
        if isinstance(message, _Fuse):
            own, self.kept = self.kept, None
            assert own is not None, "a part is seen before its set is fused"
            if message.rest is not None:
                own = Sightings.together([own, self.runner.see(message.rest)], side_by_side=False)
            before, after = ([self._unpacked(seen) for seen in parts] for parts in (message.before, message.after))
            whole: SetResult = self.runner.fuse(message.site, [*before, own, *after])
            return whole
        self.kept = None
        self.kept = seen = self.runner.see(message.part)
        return _packed(seen, message.part.site)

    def _unpacked(self, seen: bytes) -> Sightings:
        sightings: Sightings = _SiteUnpickler(seen, self.sites).load()
        return sightings


def _failed(error: Exception) -> _Answer:
    where = "".join(traceback.format_exception(error))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        # Its class is not known over there, or cannot be made from its arguments alone; its words are in the traceback.
        return _Answer(error=RuntimeError(f"{type(error).__name__}: {error}"), where=where)
    return _Answer(error=error, where=where)
