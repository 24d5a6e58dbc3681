"""The app: settings in, an ASGI application out."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

from fastapi import FastAPI

from service import __version__
from service.api import detect, health, ingest, sites, stream, viewer
from service.api.auth import Access, load_tokens
from service.api.errors import install_error_handlers
from service.api.feeds import Feed, Feeds
from service.api.guard import Guard
from service.api.live import LiveSites, TrackerFactory, default_tracker
from service.api.loop_lag import watch_loop
from service.api.recent import RecentFrames
from service.api.request_ids import RequestIds
from service.api.state import Service, in_daemon_thread
from service.errors import CalibrationError
from service.scheduler import FrameSetRunner, Scheduler, StoppableRunner
from service.settings import Settings
from service.site import load_site
from service.sites_store import SitesStore
from service.telemetry import Telemetry

PipelineFactory = Callable[[Settings], FrameSetRunner]

_DESCRIPTION = """Oriented 3D boxes of vehicles from a few static, calibrated cameras.

`WS /stream/{site}` sends the message of `POST /detect` for every frame set of a site, as JSON text or, with
`?format=msgpack`, as MessagePack; while anybody listens, boxes carry `track_id` and `velocity`. `WS /ingest/{site}` takes the
cameras' frames one by one and groups them by capture time: binary messages of 4 bytes header length (big-endian), the
header `{"camera", "captured_at", "sequence"}` as JSON, and the JPEG; it answers with errors only. Errors of all addresses
have one form: `{"error": {"code", "message", "field", "remedy"}}`."""


def create_app(
    settings: Settings, pipeline_factory: PipelineFactory | None = None, tracker_factory: TrackerFactory | None = None
) -> FastAPI:
    """Build the app. Its lifespan loads the sites and the pack, then warms up while ``/health/live`` answers already.

    The factories are seams for tests and for pipelines that are loaded before. Raises InputError for unusable tokens.
    """
    telemetry = Telemetry()
    tokens = load_tokens(settings)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        store = await asyncio.to_thread(open_store, settings)
        runner = await asyncio.to_thread(pipeline_factory or default_pipeline, settings)
        scheduler = Scheduler(
            runner,
            workers=settings.workers,
            queue_size=settings.queue_size,
            deadline_s=settings.deadline_ms / 1e3,
            max_abandoned=settings.max_abandoned,
            telemetry=telemetry,
        )
        live = LiveSites(
            telemetry, tracker_factory or default_tracker, reset_s=settings.tracker_reset_s, max_readers=settings.max_readers
        )

        def make_feed(site_id: str) -> Feed:
            return Feed(
                lambda: store.get(site_id),
                lambda: live.site(site_id).next_sequence(),
                lambda frame_set: detect.answer(service, frame_set, newest_wins=True),
                telemetry,
                settings.sync,
                2 * settings.workers + 2,
            )

        feeds = Feeds(make_feed, telemetry, max_connections=settings.ingest_max_connections)
        service = Service(settings, telemetry, store, scheduler, live, feeds, RecentFrames(settings.viewer_max_bytes))
        app.state.service = service
        warming = asyncio.create_task(service.warm_up(runner))
        watching = asyncio.create_task(watch_loop(telemetry))
        try:
            yield
        finally:
            await service.drain()
            warming.cancel()
            watching.cancel()
            await asyncio.gather(warming, watching, return_exceptions=True)
            if isinstance(runner, StoppableRunner):
                await in_daemon_thread(runner.close)

    app = FastAPI(title="Quadlift", version=__version__, description=_DESCRIPTION, lifespan=lifespan, redoc_url=None)
    app.add_middleware(Access, tokens=tokens, allowed_origins=settings.allowed_origins)
    # The one added last is the outermost: refusals are counted too, and all have an id.
    app.add_middleware(Guard, telemetry=telemetry, is_stopping=lambda: app.state.service.phase == "stopping")
    app.add_middleware(RequestIds)
    install_error_handlers(app)
    for room in (detect, sites, stream, ingest, health):
        app.include_router(room.router)
    if settings.viewer:
        app.include_router(viewer.router)
    return app


def default_pipeline(settings: Settings) -> FrameSetRunner:
    """The service's own pipeline on the pack that the settings name. Raises PackError or InputError."""
    from service.runners import make_runner

    return make_runner(settings)


def open_store(settings: Settings) -> SitesStore:
    """The store with the kept sites and those of ``settings.sites``. Raises CalibrationError naming the file."""
    store = SitesStore(settings.data_dir, max_sites=settings.max_sites, max_cameras=settings.max_cameras)
    for path in settings.sites:
        try:
            # A disk that became read-only must not keep a restarted service from its work.
            store.put(load_site(path), must_keep=False)
        except CalibrationError as error:
            raise CalibrationError(f"{error.field}: {error.message}", field=str(path), remedy=error.remedy) from error
    return store
