"""``/sites``: the registry of sites and cameras, changeable at run time, and the newest frames."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

import orjson
from fastapi import APIRouter, Query, Request
from starlette.responses import Response

from service.api.body import parse_json
from service.api.state import ServiceDep
from service.errors import CalibrationError, InputError, NotFoundError
from service.frames import read_header
from service.geometry.camera import Camera
from service.schemas import ErrorMessage
from service.site import CameraModel, Site, SiteModel, parse_site, site_document

router = APIRouter(prefix="/sites", tags=["sites"], responses={code: {"model": ErrorMessage} for code in (404, 408, 413, 422)})
_NOT_KEPT: dict[int | str, dict[str, Any]] = {507: {"model": ErrorMessage, "description": "The data folder cannot be written"}}


def _json(content: Any, status: int = 200) -> Response:
    return Response(orjson.dumps(content), status, media_type="application/json")


def _body_of(model: type[SiteModel] | type[CameraModel]) -> dict[str, Any]:
    return {"requestBody": {"required": True, "content": {"application/json": {"schema": model.model_json_schema()}}}}


@router.get("", responses={200: {"model": list[SiteModel]}})
async def list_sites(service: ServiceDep) -> Response:
    """All sites, by id."""
    return _json([site_document(site) for site in service.store.sites()])


@router.get("/{site}", responses={200: {"model": SiteModel}})
async def get_site(site: str, service: ServiceDep) -> Response:
    """One site in the form of `site.json`."""
    return _json(site_document(service.store.get(site)))


@router.put(
    "/{site}", openapi_extra=_body_of(SiteModel), responses={200: {"model": SiteModel}, 201: {"model": SiteModel}, **_NOT_KEPT}
)
async def put_site(site: str, request: Request, service: ServiceDep) -> Response:
    """Add a site (201) or replace it (200); answers with the site as kept. The stream, if it runs, goes on."""
    body = await service.read_body(request)
    new = await asyncio.to_thread(_parse_site, body, site)
    created = await asyncio.to_thread(service.store.put, new)
    return _json(site_document(new), 201 if created else 200)


@router.delete("/{site}", status_code=204, responses=_NOT_KEPT)
async def delete_site(site: str, service: ServiceDep) -> Response:
    """Drop a site and end its streams."""
    await asyncio.to_thread(service.store.delete, site)
    service.feeds.forget_site(site)
    service.live.forget_site(site)
    service.recent.forget_site(site)
    service.telemetry.forget_site(site)
    return Response(status_code=204)


@router.get("/{site}/cameras/{camera}", responses={200: {"model": CameraModel}})
async def get_camera(site: str, camera: str, service: ServiceDep) -> Response:
    """One camera of a site."""
    return _json(_camera_document(service.store.get(site).camera(camera)))


@router.put(
    "/{site}/cameras/{camera}",
    openapi_extra=_body_of(CameraModel),
    responses={200: {"model": CameraModel}, 201: {"model": CameraModel}, **_NOT_KEPT},
)
async def put_camera(site: str, camera: str, request: Request, service: ServiceDep) -> Response:
    """Let a camera join a site (201), or replace its calibration (200), while the site runs."""
    service.store.get(site)
    body = await service.read_body(request)
    new = await asyncio.to_thread(_parse_camera, body, camera)
    created = await asyncio.to_thread(service.store.put_camera, site, new)
    return _json(_camera_document(new), 201 if created else 200)


@router.delete("/{site}/cameras/{camera}", status_code=204, responses=_NOT_KEPT)
async def delete_camera(site: str, camera: str, service: ServiceDep) -> Response:
    """Let a camera leave a site while the site runs."""
    await asyncio.to_thread(service.store.delete_camera, site, camera)
    return Response(status_code=204)


@router.get("/{site}/frames/{camera}", responses={200: {"content": {"image/jpeg": {}, "image/png": {}}}})
async def get_frame(
    site: str,
    camera: str,
    service: ServiceDep,
    sequence: Annotated[int | None, Query(description="Sequence of the frame set; without it, the newest.")] = None,
) -> Response:
    """A camera's newest frame as it came, or that of one of the last 8 frame sets."""
    service.store.get(site).camera(camera)
    if not service.settings.viewer:
        raise NotFoundError("frames are not kept.", field="frames", remedy="Start the service with QUADLIFT_VIEWER=true.")
    kept, frame = service.recent.get(site, camera, sequence)
    headers = {"X-Sequence": str(kept), "Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}
    return Response(frame.data, headers=headers, media_type=f"image/{read_header(frame.data).kind}")


def _parse_site(body: bytes, site_id: str) -> Site:
    document = parse_json(body)
    _check_id(document, site_id)
    return parse_site(document)


def _parse_camera(body: bytes, camera_id: str) -> Camera:
    document = parse_json(body)
    _check_id(document, camera_id)
    try:
        return parse_site({"id": "site", "cameras": [document]}).cameras[0]
    except CalibrationError as error:
        # The body is the camera alone, so its fields are named from there.
        field = (error.field or "").removeprefix("cameras.0").lstrip(".") or "body"
        raise CalibrationError(error.message, field=field, remedy=error.remedy) from None


def _check_id(document: Any, expected: str) -> None:
    """The path names the thing; a body without an id, or with another, is a mistake worth stopping at."""
    if isinstance(document, dict) and "id" in document and document["id"] != expected:
        raise InputError(
            f"the body's id is {str(document['id'])[:80]!r}, the path's is {expected[:80]!r}.",
            field="id",
            remedy="Make them the same.",
        )


def _camera_document(camera: Camera) -> dict[str, Any]:
    document: dict[str, Any] = site_document(Site("site", (camera,)))["cameras"][0]
    return document
