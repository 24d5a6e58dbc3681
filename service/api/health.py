"""Health checks and metrics."""

from __future__ import annotations

import orjson
from fastapi import APIRouter
from prometheus_client import CONTENT_TYPE_LATEST
from starlette.responses import Response

from service import __version__
from service.api.state import ServiceDep
from service.errors import OverloadError
from service.schemas import ErrorMessage, Health

router = APIRouter(tags=["health"])


@router.get("/health/live", responses={200: {"model": Health}})
async def live() -> Response:
    """The process answers."""
    return _health(Health(status="live", version=__version__))


@router.get("/health/ready", responses={200: {"model": Health}, 503: {"model": ErrorMessage}})
async def ready(service: ServiceDep) -> Response:
    """The networks are warm and all workers do their work; 503 before that, while stopping, and while too many threads hang."""
    trouble = service.trouble()
    if trouble is not None:
        raise OverloadError(trouble, retry_after_s=2, remedy="Wait; if it stays, see the service's log and start it anew.")
    return _health(Health(status="ready", version=__version__))


@router.get("/metrics", responses={200: {"content": {"text/plain": {}}}})
async def metrics(service: ServiceDep) -> Response:
    """Counters and histograms in Prometheus' text format."""
    return Response(service.telemetry.exposition(), headers={"Content-Type": CONTENT_TYPE_LATEST})


def _health(health: Health) -> Response:
    return Response(orjson.dumps(health.model_dump()), media_type="application/json")
