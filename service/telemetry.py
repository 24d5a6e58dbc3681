"""Counters and histograms of one service, in a registry of its own: two services in one process do not mix."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from enum import StrEnum

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

_SECONDS = (0.001, 0.002, 0.005, 0.01, 0.015, 0.02, 0.033, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)


class Drop(StrEnum):
    """Why something that was accepted, or could have been, was not delivered."""

    QUEUE_FULL = "queue_full"
    """A frame set found no place in the queue."""
    BODIES_FULL = "bodies_full"
    """A request's body found no room beside those under way."""
    DEADLINE = "deadline"
    """A frame set waited too long for a worker."""
    STOPPING = "stopping"
    """A frame set came while the service was stopping."""
    UNFINISHED = "unfinished"
    """A frame set was accepted, and not done when the service's time to stop was over."""
    HUNG = "hung"
    """The networks hung on a frame set."""
    CANCELLED = "cancelled"
    """A frame set's sender went away before it was run."""
    FAILED = "failed"
    """The networks failed on a frame set."""
    LATE = "late"
    """A frame set was answered, but a later one had been tracked and published already."""
    SLOW_READER = "slow_reader"
    """A stream message was replaced by a newer one before its reader took it."""
    STALLED_READER = "stalled_reader"
    """A stream reader that took nothing for too long was cut."""
    NOT_FINITE = "not_finite"
    """A box held a number that is not finite."""
    SUPERSEDED = "superseded"
    """A frame set of a camera stream was replaced by a newer one of its site before there was room to run it."""
    UNDECODABLE = "undecodable"
    """No frame of a camera stream's frame set could be decoded."""
    FRAME_REFUSED = "frame_refused"
    """A camera stream's message was no frame of a camera of the site."""
    FRAME_DUPLICATE = "frame_duplicate"
    """A frame of this camera and capture time came before."""
    FRAME_LATE = "frame_late"
    """A frame's set had gone out, and no later set could use it as a stale one."""
    FRAME_CLOCK = "frame_clock"
    """The clock of a frame's camera disagrees with those of the site's other cameras."""
    FRAME_BACKLOG = "frame_backlog"
    """More frames of one camera, or more bytes of one site, were waiting for their set than may."""
    FRAME_LEFT = "frame_camera_left"
    """A frame's camera or site went before its set did."""


class Restart(StrEnum):
    """Why a worker was replaced."""

    HUNG = "hung"
    """A frame set had run for too long; the thread is abandoned."""
    DIED = "died"
    """Its thread ended."""


class Telemetry:
    """What a service counts. Safe to use from any thread."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self._requests = Counter(
            "quadlift_http_requests", "HTTP requests by route and status.", ["route", "status"], registry=self.registry
        )
        self._sets = Counter("quadlift_frame_sets", "Frame sets run to the end, by site.", ["site"], registry=self.registry)
        self._frames = Counter("quadlift_frames", "Frames by what became of them.", ["status"], registry=self.registry)
        self._boxes = Counter("quadlift_boxes", "Fused boxes given out, by site.", ["site"], registry=self.registry)
        self._dropped = Counter("quadlift_dropped", "Things dropped, by reason.", ["reason"], registry=self.registry)
        self._stages = Histogram(
            "quadlift_stage_seconds",
            "Time of each step for one frame set.",
            ["stage"],
            buckets=_SECONDS,
            registry=self.registry,
        )
        self._waits = Histogram(
            "quadlift_queue_seconds", "Time that a frame set waited for a worker.", buckets=_SECONDS, registry=self.registry
        )
        self._queued = Gauge("quadlift_queued_frame_sets", "Frame sets that wait for a worker.", registry=self.registry)
        self._readers = Gauge("quadlift_stream_readers", "Stream subscribers, by site.", ["site"], registry=self.registry)
        self._ingests = Gauge(
            "quadlift_ingest_connections", "Camera stream connections, by site.", ["site"], registry=self.registry
        )
        self._skews = Histogram(
            "quadlift_skew_seconds",
            "How far a camera's frame lies from its set's capture time.",
            buckets=_SECONDS,
            registry=self.registry,
        )
        self._workers = Gauge("quadlift_workers", "Workers that do not hang.", registry=self.registry)
        self._abandoned = Gauge("quadlift_abandoned_workers", "Threads that hang in the networks.", registry=self.registry)
        self._restarts = Counter("quadlift_worker_restarts", "Workers replaced, by reason.", ["reason"], registry=self.registry)
        self._lag = Histogram(
            "quadlift_event_loop_lag_seconds",
            "How much later than it should the event loop ran a timer, sampled.",
            buckets=_SECONDS,
            registry=self.registry,
        )
        self._ready = Gauge("quadlift_ready", "1 when the service answers frame sets.", registry=self.registry)
        for reason in Drop:
            # A counter that is there from the start can be alerted on.
            self._dropped.labels(reason.value)
        for cause in Restart:
            self._restarts.labels(cause.value)

    def request(self, route: str, status: int) -> None:
        """Count an answered HTTP request; ``route`` is the template, so that ids do not multiply the series."""
        self._requests.labels(route, str(status)).inc()

    def frame_set(self, site: str, statuses: Iterable[str], boxes: int, timing_ms: Mapping[str, float]) -> None:
        """Count a frame set that was answered: its cameras' statuses, its boxes, and each step's milliseconds."""
        self._sets.labels(site).inc()
        self._boxes.labels(site).inc(boxes)
        for status in statuses:
            self._frames.labels(status).inc()
        for stage, milliseconds in timing_ms.items():
            self._stages.labels(stage).observe(milliseconds / 1e3)

    def dropped(self, reason: Drop, count: int = 1) -> None:
        """Count something dropped."""
        self._dropped.labels(reason.value).inc(count)

    def drops(self) -> dict[str, int]:
        """How much was dropped so far, by reason."""
        samples = (sample for family in self._dropped.collect() for sample in family.samples)
        return {s.labels["reason"]: int(s.value) for s in samples if s.name.endswith("_total")}

    def queue(self, length: int) -> None:
        """Note how many frame sets wait."""
        self._queued.set(length)

    def waited(self, seconds: float) -> None:
        """Note how long a frame set waited before a worker took it."""
        self._waits.observe(seconds)

    def readers(self, site: str, count: int) -> None:
        """Note how many subscribers a site's stream has."""
        self._readers.labels(site).set(count)

    def ingests(self, site: str, count: int) -> None:
        """Note how many connections feed a site."""
        self._ingests.labels(site).set(count)

    def skew(self, milliseconds: float) -> None:
        """Note how far a frame lies from its set's capture time."""
        self._skews.observe(abs(milliseconds) / 1e3)

    def workers(self, working: int, abandoned: int) -> None:
        """Note how many workers there are that do not hang, and how many threads do."""
        self._workers.set(working)
        self._abandoned.set(abandoned)

    def restarted(self, reason: Restart) -> None:
        """Count a worker that was replaced."""
        self._restarts.labels(reason.value).inc()

    def lag(self, seconds: float) -> None:
        """Note how late the event loop ran a timer."""
        self._lag.observe(max(0.0, seconds))

    def ready(self, is_ready: Callable[[], bool]) -> None:
        """Ask ``is_ready`` whether frame sets are answered, whenever the metrics are read."""
        self._ready.set_function(lambda: float(is_ready()))

    def forget_site(self, site: str) -> None:
        """Drop a site's series, so that sites which come and go do not grow the page for ever."""
        for metric in (self._sets, self._boxes, self._readers, self._ingests):
            if (site,) in {tuple(s.labels.values()) for family in metric.collect() for s in family.samples}:
                metric.remove(site)

    def exposition(self) -> bytes:
        """All metrics in Prometheus' text format."""
        return generate_latest(self.registry)
