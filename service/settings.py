"""Every knob of the service, in one place: named, typed, and read from the environment as ``QUADLIFT_<NAME>``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, SecretStr
from pydantic_settings import BaseSettings, SettingsConfigDict

from service.frames import FrameLimits
from service.nets.providers import Provider
from service.sync import SyncSettings

_CGROUP_CPU_MAX = Path("/sys/fs/cgroup/cpu.max")


def usable_cores(cpu_max: Path = _CGROUP_CPU_MAX) -> int:
    """Cores that this process may really use: its CPU affinity, and a container's quota if that is smaller; at least 1."""
    affinity = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = cpu_max.read_text("ascii").split()
    except (OSError, ValueError):
        # No cgroup v2 here, so nothing limits the process but its affinity.
        return affinity
    if quota == "max":
        return affinity
    return max(1, min(affinity, int(quota) // int(period)))


class Settings(BaseSettings):
    """Settings of one service process."""

    model_config = SettingsConfigDict(env_prefix="QUADLIFT_", frozen=True, use_attribute_docstrings=True)

    host: str = "127.0.0.1"
    """Address to listen on; ``0.0.0.0`` for all. Give tokens, or put a proxy before a public one."""
    port: Annotated[int, Field(ge=0, le=65535)] = 8000
    """TCP port to listen on; 0 takes a free one."""
    pack: str = "edge"
    """Networks to run: the name of a shipped pack, or the path of a pack's folder."""
    provider: Provider = "auto"
    """What the networks compute on: ``cpu``, ``cuda``, ``tensorrt``, ``openvino``; ``auto`` takes CUDA, then OpenVINO, then the
    CPU, whichever is installed. One given by name must be there and must start."""
    data_dir: Path | None = None
    """Folder that keeps the sites across restarts. Unset: sites live in memory only."""
    sites: tuple[Path, ...] = ()
    """Site files to load at start; each replaces a kept site of the same id."""

    workers: Annotated[int, Field(ge=1, le=256)] = Field(default_factory=usable_cores)
    """Workers that run frame sets side by side. Default: the usable cores. ``quadlift tune`` measures what is best."""
    worker_kind: Literal["auto", "process", "thread"] = "auto"
    """Whether workers are processes or threads of the service. Threads share one copy of the networks, which spares a GPU's
    memory, and the interpreter lock, which costs a CPU a fifth of its frame sets (docs/operations.md); one that hangs
    cannot be killed. ``auto``: threads where the networks run on CUDA or TensorRT, else processes."""
    intra_op_threads: Annotated[int, Field(ge=1, le=256)] = 1
    """Threads inside the networks for each worker."""
    queue_size: Annotated[int, Field(ge=1)] = 16
    """Posted frame sets that may wait for a worker; one more is answered 503. Of every site one may wait in any case, and of
    its camera streams one more, the newest."""
    deadline_ms: Annotated[float, Field(gt=0)] = 1000.0
    """A frame set that has waited this long for a worker is answered 503 instead of being run. Milliseconds."""
    run_limit_ms: Annotated[float, Field(gt=0)] | None = None
    """A set of up to four frames that runs for longer is answered 504, and its worker replaced as hung; larger sets may run
    longer in proportion. Unset: 1500, twice what the warm-up took, or eight times what sets take lately, whichever
    is most. Milliseconds."""
    max_abandoned: Annotated[int, Field(ge=0, le=256)] = 4
    """Threads that may hang while others take their place. One more, and the service is not ready until one comes back."""
    score_threshold: Annotated[float, Field(ge=0, le=1)] | None = None
    """Detections in a camera's picture of a lower score are left out. Unset: the pipeline's own threshold."""
    min_fused_score: Annotated[float, Field(ge=0, le=1)] | None = None
    """Fused boxes of a lower score, which says how surely a box fits its vehicle, are left out. Unset: the pipeline's
    own threshold. Lower shows more of the far vehicles, whose place is vague (docs: fusion)."""
    detector_width: Annotated[int, Field(ge=64, le=4096)] | None = None
    """All pictures are brought to this width for the detector and the depth net, px. Unset: only those that are wider than the
    pack says, to that. More finds smaller vehicles, also where it enlarges, in time that grows with its square."""
    hard_mode: Literal["auto", "always", "never"] = "auto"
    """Where the pack's depth-guided detector adds boxes: in cameras whose view is dark, of little contrast or crowded, in
    all, or in none. ``always`` needs a pack that has the network; with one that has not, ``auto`` is ``never``."""

    max_body_bytes: Annotated[int, Field(ge=1024)] = 32 * 2**20
    """Bytes of one request's body."""
    max_bodies_bytes: Annotated[int, Field(ge=1024)] = 32 * 2**20
    """Bytes of all bodies that are being received together; when they want more, the longest is answered 503."""
    body_receive_s: Annotated[float, Field(gt=0)] = 10.0
    """A request's body that has not come after this time is answered 408. Seconds."""
    max_frame_bytes: Annotated[int, Field(ge=1024)] = FrameLimits.max_frame_bytes
    """Bytes of one frame's file."""
    max_pixels: Annotated[int, Field(ge=256)] = FrameLimits.max_pixels
    """Width times height of one frame; checked on its header, before it is decoded."""
    max_cameras: Annotated[int, Field(ge=1, le=64)] = 16
    """Cameras of one site."""
    max_sites: Annotated[int, Field(ge=1)] = 256
    """Sites of one service."""
    max_readers: Annotated[int, Field(ge=1)] = 64
    """Stream subscribers of one site."""

    tokens: SecretStr | None = None
    """Bearer tokens, one a line or separated by ``;``: scopes (ingest, read, admin; by comma), a blank, the token. With any,
    requests need one. Unset, here and in ``tokens_file``: all is open."""
    tokens_file: Path | None = None
    """File with more tokens, in the same form; ``#`` begins a comment."""
    allowed_origins: tuple[str, ...] = ()
    """Origins whose pages may open WebSockets, beside the service's own, as a JSON list; ``*`` for any."""
    tls_cert: Path | None = None
    """Certificate chain (PEM) to serve HTTPS with; needs ``tls_key``."""
    tls_key: Path | None = None
    """Private key (PEM) of the certificate."""

    ingest_max_connections: Annotated[int, Field(ge=1)] = 32
    """Camera stream connections of one site."""
    ingest_max_header_bytes: Annotated[int, Field(ge=128)] = 1024
    """Bytes of the JSON header before a frame on a camera stream."""
    ingest_receive_s: Annotated[float, Field(gt=0)] = 10.0
    """A camera stream that brings no whole message for this long is closed. Seconds."""
    ingest_max_errors: Annotated[int, Field(ge=1)] = 32
    """A camera stream is closed when this many of its messages in a row are refused."""
    sync_tolerance_ms: Annotated[float, Field(ge=0)] = 20.0
    """Capture times within one frame set differ by at most this; below the time between two frames of a camera."""
    sync_wait_ms: Annotated[float, Field(ge=0)] = 50.0
    """How long a frame set waits for cameras that have not delivered. Milliseconds."""
    sync_stale_ms: Annotated[float, Field(ge=0)] = 50.0
    """A frame that missed its set may stand in for its camera in a set captured at most this much later; 0: never."""
    sync_clock_ms: Annotated[float, Field(gt=0)] = 250.0
    """Frames of a camera whose clock and delay differ from the others' by more than this are dropped. Milliseconds."""
    sync_absent_ms: Annotated[float, Field(gt=0)] = 2000.0
    """A camera that is silent for this long is not waited for. Milliseconds."""
    sync_max_pending: Annotated[int, Field(ge=1)] = 8
    """Frames of one camera that may wait for their set."""
    sync_max_bytes: Annotated[int, Field(ge=1024)] = 64 * 2**20
    """Bytes of one site's frames that may wait for their set."""

    viewer: bool = True
    """Serve the viewer page at ``/`` and the newest frames that it shows."""
    viewer_max_bytes: Annotated[int, Field(ge=0)] = 64 * 2**20
    """Bytes that the kept frames of all sites may take together; the oldest go first."""
    tracker_reset_s: Annotated[float, Field(gt=0)] = 5.0
    """Capture times that fall back by more than this begin a new track list (a clock was set, a recording began again);
    a frame set that is late by less is answered without tracking. Seconds."""

    timeout_keep_alive_s: Annotated[int, Field(ge=1)] = 15
    """An idle connection is closed after this time. Seconds."""
    drain_s: Annotated[float, Field(gt=0)] = 10.0
    """Time to finish what was accepted when the service is asked to stop. Seconds."""
    reader_stall_s: Annotated[float, Field(gt=0)] = 3.0
    """A stream reader whose connection has taken nothing for this long is cut. Seconds."""
    ping_s: Annotated[float, Field(gt=0)] = 20.0
    """A WebSocket's peer is asked for a sign of life this often, and cut when it gives none for as long again. Seconds."""
    log_format: Literal["text", "json"] = "text"
    """Lines for people, or one JSON object a line."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """The least important lines that are written."""
    limit_concurrency: Annotated[int, Field(ge=1)] = 512
    """Connections and requests at once; one more is answered 503."""
    ws_max_size: Annotated[int, Field(ge=1024)] = 16 * 2**20
    """Bytes of one WebSocket message to the service."""

    @property
    def frame_limits(self) -> FrameLimits:
        """The limits that apply to a single frame."""
        return FrameLimits(self.max_frame_bytes, self.max_pixels)

    @property
    def sync(self) -> SyncSettings:
        """How camera streams are grouped into frame sets."""
        return SyncSettings(
            tolerance_ns=round(self.sync_tolerance_ms * 1e6),
            wait_ns=round(self.sync_wait_ms * 1e6),
            stale_ns=round(self.sync_stale_ms * 1e6),
            clock_ns=round(self.sync_clock_ms * 1e6),
            absent_ns=round(self.sync_absent_ms * 1e6),
            max_pending=self.sync_max_pending,
            max_bytes=self.sync_max_bytes,
        )
