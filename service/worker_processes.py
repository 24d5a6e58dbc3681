"""Worker processes: a pipeline in each, so that lifting and fusion in one do not wait for the interpreter lock of another.

A process can be killed, as a thread cannot: one that hangs is, and one that died for any other reason is replaced as well.
Processes come from a server that has the libraries loaded, so that a new one is there within a fraction of a second.
"""

from __future__ import annotations

import atexit
import io
import logging
import multiprocessing
import pickle
import signal
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext, SpawnContext
from multiprocessing.process import BaseProcess
from typing import TYPE_CHECKING, Any

from service.errors import QuadliftError
from service.frames import FrameSet
from service.logs import on_behalf_of, request_id
from service.site import Site

if TYPE_CHECKING:
    from service.pipeline import SetResult
    from service.scheduler import FrameSetRunner

logger = logging.getLogger(__name__)

_PRELOADED = ["service.pipeline", "service.nets.pack", "service.runners"]
_MAX_KNOWN_SITES = 256
"""Sites that a process keeps by heart; beyond that it begins anew. A site is sent once, not with every frame set."""
_END_S = 2.0
_RETRY_S = 1.0
"""Before another try where a process could not be started."""
_SITE = "site"


def _make_context() -> ForkServerContext | SpawnContext:
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    return context


_CONTEXT = _make_context()
_ENDS = threading.Lock()
"""Held by who asks whether a process has ended, as starting another one does of all: its exit code can be read but once."""


class WorkerDiedError(Exception):
    """A worker process ended while it ran a frame set."""


class ProcessRunner:
    """As many copies of a pipeline as there are workers, each in a process of its own. Thread-safe: a caller a process."""

    def __init__(self, load: Callable[[], FrameSetRunner], size: int) -> None:
        """Start the processes and wait until each has its pipeline; raises what ``load`` raises.

        load: makes the pipeline, in the process; it must be picklable, so a function of a module or a ``partial`` of one.
        """
        self._load = load
        self._changed = threading.Condition()
        self._idle: list[_Process] = []
        self._running: dict[FrameSet, _Process | None] = {}
        """None: it waits for a process."""
        self._given_up: set[FrameSet] = set()
        self._closed = False
        started = [_Process(load) for _ in range(size)]
        try:
            for process in started:
                process.await_loaded()
        except BaseException:
            for process in started:
                process.kill()
            raise
        self._idle = started
        # Also where nobody closes it: the interpreter would wait for the processes at its end.
        atexit.register(self.close)

    def warm_up(self) -> None:
        """Run every network once, in every process."""
        with self._changed:
            processes = list(self._idle)
        for process in processes:
            process.send(_WarmUp())
        for process in processes:
            process.await_answer()

    def run(self, frame_set: FrameSet) -> SetResult:
        """The result of a frame set; raises what the pipeline raises, and WorkerDiedError when its process ends."""
        process = self._take(frame_set)
        try:
            result: SetResult = process.run(frame_set)
        except (EOFError, OSError):
            self._replace(process)
            raise WorkerDiedError(f"process {process.pid} ended with code {process.exit_code()}") from None
        except BaseException:
            self._put_back(process)
            raise
        else:
            self._put_back(process)
            return result
        finally:
            with self._changed:
                self._running.pop(frame_set, None)
                self._given_up.discard(frame_set)

    def give_up(self, frame_set: FrameSet) -> None:
        """Break a running frame set off: its process is killed, and its caller gets WorkerDiedError."""
        with self._changed:
            if frame_set not in self._running:
                return
            process = self._running[frame_set]
            if process is None:
                self._given_up.add(frame_set)
                self._changed.notify_all()
        if process is not None:
            process.kill()

    def close(self) -> None:
        """End all processes; those that run something are killed."""
        atexit.unregister(self.close)
        with self._changed:
            self._closed = True
            idle, self._idle = self._idle, []
            busy = [process for process in self._running.values() if process is not None]
            self._changed.notify_all()
        for process in idle:
            process.end()
        for process in busy:
            process.kill()
        until = time.monotonic() + _END_S
        for process in idle:
            process.join(until - time.monotonic())

    def _take(self, frame_set: FrameSet) -> _Process:
        with self._changed:
            self._running[frame_set] = None
            while not self._idle:
                if self._closed or frame_set in self._given_up:
                    self._running.pop(frame_set)
                    self._given_up.discard(frame_set)
                    raise WorkerDiedError("no worker process was there in time")
                self._changed.wait()
            process = self._running[frame_set] = self._idle.pop()
            return process

    def _put_back(self, process: _Process) -> None:
        with self._changed:
            if not self._closed:
                self._idle.append(process)
                self._changed.notify()
                return
        process.end()

    def _replace(self, process: _Process) -> None:
        process.kill()
        if not self._closed:
            threading.Thread(target=self._start_another, name="quadlift-process-start", daemon=True).start()

    def _start_another(self) -> None:
        while not self._closed:
            process = None
            try:
                process = _Process(self._load)
                process.await_loaded()
                process.send(_WarmUp())
                process.await_answer()
            except Exception:
                # Whatever it is, memory most likely: the others go on, and better times may come.
                logger.exception("A worker process could not be started; the next try follows")
                if process is not None:
                    process.kill()
                time.sleep(_RETRY_S)
            else:
                self._put_back(process)
                return


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
class _Answer:
    value: Any = None
    error: Exception | None = None
    where: str = ""
    """The traceback of an error, as text: it does not survive the way."""


class _SitePickler(pickle.Pickler):
    """Writes a site's id in its place."""

    def persistent_id(self, obj: Any) -> tuple[str, str] | None:
        return (_SITE, obj.id) if isinstance(obj, Site) else None


class _SiteUnpickler(pickle.Unpickler):
    """Puts the known site there again."""

    def __init__(self, data: bytes, sites: dict[str, Site]) -> None:
        super().__init__(io.BytesIO(data))
        self._sites = sites

    def persistent_load(self, pid: tuple[str, str]) -> Site:
        return self._sites[pid[1]]


def _packed(message: object) -> bytes:
    buffer = io.BytesIO()
    _SitePickler(buffer, pickle.HIGHEST_PROTOCOL).dump(message)
    return buffer.getvalue()


@dataclass(eq=False)
class _Process:
    """One process, seen from here. Only one thread at a time talks to it; any may kill it."""

    load: Callable[[], FrameSetRunner]
    _process: BaseProcess = field(init=False)
    _connection: Connection = field(init=False)
    _sites: dict[str, Site] = field(default_factory=dict, init=False)
    """What it knows."""

    def __post_init__(self) -> None:
        self._connection, theirs = _CONTEXT.Pipe()
        self._process = _CONTEXT.Process(target=_work, args=(theirs, self.load), name="quadlift-worker")
        with _ENDS:
            self._process.start()
        theirs.close()

    @property
    def pid(self) -> int | None:
        return self._process.pid

    def run(self, frame_set: FrameSet) -> SetResult:
        site = frame_set.site
        if self._sites.get(site.id) is not site:
            learn = _Learn(site, forgets_others=len(self._sites) >= _MAX_KNOWN_SITES)
            learn.into(self._sites)
            self._connection.send(learn)
        self.send(_Run(frame_set, request_id.get()))
        result: SetResult = self.await_answer()
        return result

    def send(self, message: _WarmUp | _Run) -> None:
        self._connection.send_bytes(_packed(message))

    def await_loaded(self) -> None:
        """Until it has its pipeline; raises what loading raised, and QuadliftError when the process ended."""
        try:
            self.await_answer()
        except (EOFError, OSError):
            raise QuadliftError(
                f"a worker process ended at its start, with code {self.exit_code()}.",
                remedy="See its output above; memory may have run out.",
            ) from None

    def await_answer(self) -> Any:
        """What it has to say; raises its error, EOFError or OSError when it has ended."""
        answer: _Answer = pickle.loads(self._connection.recv_bytes())
        if answer.error is not None:
            answer.error.add_note(f"In the worker process:\n{answer.where}")
            raise answer.error
        return answer.value

    def end(self) -> None:
        """Let it end by itself."""
        self._connection.close()

    def kill(self) -> None:
        with _ENDS:
            self._process.kill()

    def join(self, timeout_s: float) -> None:
        if not wait([self._process.sentinel], max(0.0, timeout_s)):
            self.kill()

    def exit_code(self) -> int | None:
        wait([self._process.sentinel], _END_S)
        with _ENDS:
            return self._process.exitcode


def _work(connection: Connection, load: Callable[[], FrameSetRunner]) -> None:
    """A worker process's life: make the pipeline, then answer until nobody is there any more."""
    # Who stops the service by a signal to all its processes wants it to finish its work first.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    sites: dict[str, Site] = {}
    try:
        runner, answer = None, _Answer()
        try:
            runner = load()
        except Exception as error:
            answer = _failed(error)
        _send(connection, answer)
        while runner is not None:
            message = _SiteUnpickler(connection.recv_bytes(), sites).load()
            if isinstance(message, _Learn):
                message.into(sites)
            else:
                _send(connection, _answer(runner, message))
    except (EOFError, OSError):
        # The service has ended, or has given this process up.
        return


def _answer(runner: FrameSetRunner, message: _WarmUp | _Run) -> _Answer:
    try:
        if isinstance(message, _WarmUp):
            runner.warm_up()
            return _Answer()
        with on_behalf_of(message.request_id):
            return _Answer(runner.run(message.frame_set))
    except Exception as error:
        # Raised again where the caller is.
        return _failed(error)


def _failed(error: Exception) -> _Answer:
    where = "".join(traceback.format_exception(error))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        # Its class is not known over there, or cannot be made from its arguments alone; its words are in the traceback.
        return _Answer(error=RuntimeError(f"{type(error).__name__}: {error}"), where=where)
    return _Answer(error=error, where=where)


def _send(connection: Connection, answer: _Answer) -> None:
    connection.send_bytes(pickle.dumps(answer, pickle.HIGHEST_PROTOCOL))
