"""``POST /detect``: one frame set in, its boxes out."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Coroutine
from functools import partial
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
from pydantic import BaseModel, Field, ValidationError
from starlette.responses import Response

from service.api.body import Part, parse_multipart
from service.api.messages import Encoded, detections_message, encode, encode_json, finite_only, per_camera_boxes
from service.api.state import Service, current_service
from service.errors import InputError
from service.frames import EncodedFrame, FrameLimits, FrameSet, check_frame
from service.schemas import CAPTURED_AT, Detections, ErrorMessage, ns_from_rfc3339
from service.site import Site
from service.telemetry import Drop

T = TypeVar("T")
_LIGHT_BODY_BYTES = 256 * 1024
"""A form of this length is parsed within half a millisecond."""
_LIGHT_BOXES = 32
"""The message of so many boxes is composed within a millisecond."""

_REQUEST_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "description": "One file part a camera, named by the camera's id; JPEG or PNG.",
                    "properties": {CAPTURED_AT: {"type": "string", "format": "date-time"}},
                    "additionalProperties": {"type": "string", "format": "binary"},
                }
            }
        },
    }
}


class DetectQuery(BaseModel):
    """The query of ``POST /detect``."""

    site: Annotated[str, Field(description="Id of the site whose cameras took the frames.")]
    per_camera: Annotated[bool, Field(description="Also give each camera's own boxes.")] = False


class _Direct(APIRoute):
    """Calls its endpoint with the request alone; the signature is for the OpenAPI document.

    Solving dependencies anew for each request took a quarter of the event loop's time (cProfile: 0.29 of 1.15 s).
    """

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """What answers a request."""

        async def handle(request: Request) -> Response:
            try:
                query = DetectQuery.model_validate(dict(request.query_params))
            except ValidationError as error:
                found = error.errors(include_url=False)
                raise RequestValidationError([{**one, "loc": ("query", *one["loc"])} for one in found]) from None
            answered: Response = await self.endpoint(request, query)
            return answered

        return handle


router = APIRouter(tags=["frames"], route_class=_Direct)


@router.post(
    "/detect",
    openapi_extra=_REQUEST_BODY,
    responses={200: {"model": Detections}, **{code: {"model": ErrorMessage} for code in (404, 408, 413, 422, 503, 504)}},
)
async def detect(request: Request, query: Annotated[DetectQuery, Query()]) -> Response:
    """Boxes of one frame set: one to N of the site's cameras, each as a file part named by the camera's id.

    Optional text fields: `captured_at` (RFC 3339) for the set, `captured_at.<camera>` for one camera. Without them the
    earliest camera's time, or the time of arrival, is the set's.
    """
    arrived_at_ns = time.time_ns()
    service = current_service(request)
    known_site = service.store.get(query.site)
    service.require_ready()
    # Refusing before the frames are read leaves the processor to the sets that were accepted.
    service.scheduler.require_room(query.site)
    body = await service.read_body(request)
    content_type, limits = request.headers.get("content-type"), service.settings.frame_limits
    parse = partial(frames_from_form, body, content_type, known_site, limits, arrived_at_ns)
    frames, captured_at_ns = await off_the_loop(parse, unless=len(body) <= _LIGHT_BODY_BYTES)
    sequence = service.live.site(query.site).next_sequence()
    content = await answer(service, FrameSet(known_site, frames, captured_at_ns, sequence), per_camera=query.per_camera)
    return Response(content, media_type="application/json")


async def answer(service: Service, frame_set: FrameSet, *, per_camera: bool = False, newest_wins: bool = False) -> bytes:
    """Run a frame set, publish its message if the site's stream runs, and give the message as JSON.

    newest_wins: while it waits for a worker, a newer set of its site may take its place (OverloadError).
    """
    live = service.live.site(frame_set.site.id)
    with live.passage(frame_set.captured_at_ns) as passage:
        result, not_finite = finite_only(await service.scheduler.submit(frame_set, newest_wins=newest_wins))
        if not_finite:
            service.telemetry.dropped(Drop.NOT_FINITE, not_finite)
        tracked, track_ms = await live.track(passage, result)
        compose = partial(detections_message, frame_set, result, tracked, track_ms)
        is_light = len(result.boxes) <= _LIGHT_BOXES
        message, encoded = await off_the_loop(partial(_compose, compose, "msgpack" in live.formats()), unless=is_light)
        statuses = [camera.status for camera in message.cameras.values()]
        for camera in message.cameras.values():
            if camera.skew_ms is not None:
                service.telemetry.skew(camera.skew_ms)
        timing_ms = message.timing_ms.model_dump(exclude_unset=True)
        service.telemetry.frame_set(frame_set.site.id, statuses, len(message.boxes), timing_ms)
        if service.settings.viewer:
            service.recent.add(frame_set)
        if tracked is not None:
            live.publish(encoded)
    if not per_camera:
        return encoded.json
    return await asyncio.to_thread(lambda: encode_json(message.model_copy(update={"per_camera": per_camera_boxes(result)})))


async def off_the_loop(work: Callable[[], T], *, unless: bool) -> T:
    """The result of something that blocks, in a thread: unless it takes less time than the way there and back."""
    return work() if unless else await asyncio.to_thread(work)


def _compose(compose: Callable[[], Detections], with_msgpack: bool) -> tuple[Detections, Encoded]:
    message = compose()
    return message, encode(message, with_msgpack=with_msgpack)


def frames_from_form(
    body: bytes, content_type: str | None, site: Site, limits: FrameLimits, arrived_at_ns: int
) -> tuple[tuple[EncodedFrame, ...], int]:
    """The checked frames of a form and the set's capture time in ns; blocks for as long as parsing takes.

    Raises InputError and its kinds: no frame, a part that is no camera of the site, two parts of one camera, a frame that
    its header condemns, a time that is none.
    """
    pictures, times = _sort_parts(parse_multipart(body, content_type, 2 * len(site.cameras) + 2), site)
    if not pictures:
        known = ", ".join(camera.id for camera in site.cameras) or "the site has none yet"
        raise InputError(
            "the request holds no frame.", field="body", remedy=f"Send one file part a camera, named by its id ({known})."
        )
    for camera_id in times:
        if camera_id and camera_id not in pictures:
            raise InputError("a time without a frame.", field=f"{CAPTURED_AT}.{camera_id}", remedy="Send the frame with it.")
    for camera_id, data in pictures.items():
        check_frame(data, site.camera(camera_id), limits)
    frames = tuple(EncodedFrame(camera_id, data, times.get(camera_id)) for camera_id, data in pictures.items())
    given = [time_ns for camera_id, time_ns in times.items() if camera_id]
    return frames, times.get("", min(given, default=arrived_at_ns))


def _sort_parts(parts: list[Part], site: Site) -> tuple[dict[str, bytes], dict[str, int]]:
    """Pictures by camera and times (ns) by camera; the set's own time has the key ``""``."""
    pictures: dict[str, bytes] = {}
    times: dict[str, int] = {}
    for part in parts:
        stem, _, camera_id = part.name.partition(".")
        is_time = stem == CAPTURED_AT and not part.is_file
        # Raises NotFoundError for a part that belongs to no camera of this site.
        known_id = "" if is_time and not camera_id else site.camera(camera_id if is_time else part.name).id
        if known_id in (times if is_time else pictures):
            raise InputError("two parts of this name.", field=part.name[:80], remedy="Send one part a camera.")
        if is_time:
            times[known_id] = _parse_time(part)
        else:
            pictures[known_id] = part.data
    return pictures, times


def _parse_time(part: Part) -> int:
    text = part.data[:64].decode("utf-8", "replace")
    try:
        return ns_from_rfc3339(text)
    except ValueError as error:
        raise InputError(
            f"'{text}': {error}.",
            field=part.name[:80],
            remedy="Give RFC 3339 with a zone, for example 2026-11-22T01:02:03.040Z.",
        ) from None
