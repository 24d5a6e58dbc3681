"""A small client of the service: :class:`Client` for plain code, :class:`AsyncClient` for asyncio.

Both send the same :class:`Call` objects; only the way of sending differs.

    with Client("http://127.0.0.1:8000") as client:
        message = client.detect("demo", {"north": north_jpeg, "east": east_jpeg})
        for message in client.stream("demo"):
            ...
"""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from types import TracebackType
from typing import Any, Generic, Self, TypeVar
from urllib.parse import quote

import httpx
import websockets.asyncio.client
import websockets.sync.client
from pydantic import ValidationError
from websockets.exceptions import InvalidStatus, WebSocketException

from service.schemas import CAPTURED_AT, Detections, ErrorMessage

DEFAULT_URL = "http://127.0.0.1:8000"
DEFAULT_CONNECT_S = 5.0
DEFAULT_ANSWER_S = 10.0
MAX_MESSAGE_BYTES = 16 * 2**20

Frames = Mapping[str, bytes]
"""JPEG (or PNG) files by camera id."""
CaptureTime = datetime | Mapping[str, datetime]
"""One time for all frames, or a time by camera id; with a time zone."""
SiteDocument = dict[str, Any]
"""The form of ``site.json``."""

_T = TypeVar("_T")


@dataclass(frozen=True)
class Timeouts:
    """How long the client waits, in seconds."""

    connect_s: float = DEFAULT_CONNECT_S
    """For a connection, and for a stream to open."""
    answer_s: float = DEFAULT_ANSWER_S
    """For the answer to a request. A stream may be silent for as long as it likes."""


class ServiceError(Exception):
    """The service refused a request, or could not be reached (then ``status`` is None and ``code`` ``unreachable``)."""

    def __init__(
        self,
        code: str,
        message: str,
        *,
        status: int | None = None,
        field: str | None = None,
        remedy: str | None = None,
        retry_after_s: int | None = None,
    ) -> None:
        super().__init__(" ".join(part for part in (f"{field}: {message}" if field else message, remedy) if part))
        self.code = code
        self.message = message
        self.status = status
        self.field = field
        self.remedy = remedy
        self.retry_after_s = retry_after_s
        """When to come back, seconds; set when the service is starting or has too much to do."""


@dataclass(frozen=True, eq=False)
class Call(Generic[_T]):
    """One request and how to read its answer."""

    method: str
    path: str
    parse: Callable[[bytes], _T]
    params: Mapping[str, str] | None = None
    form: Mapping[str, str] | None = None
    files: Mapping[str, tuple[str, bytes]] | None = None
    json: SiteDocument | None = None

    def request(self, client: httpx.Client | httpx.AsyncClient) -> httpx.Request:
        """The request that a client of httpx sends."""
        return client.build_request(
            self.method, self.path, params=self.params, data=self.form, files=self.files, json=self.json
        )

    def read(self, response: httpx.Response) -> _T:
        """The parsed answer. Raises ServiceError when it is not a success."""
        if not response.is_success:
            raise _error(response.status_code, response.content, response.headers.get("Retry-After"))
        return self.parse(response.content)


def detect_call(
    site: str, frames: Frames, captured_at: CaptureTime | None = None, per_camera: bool = False
) -> Call[Detections]:
    """``POST /detect``. Raises ValueError for a capture time without a zone."""
    times = captured_at if isinstance(captured_at, Mapping) else {"": captured_at} if captured_at else {}
    return Call(
        "POST",
        "/detect",
        Detections.model_validate_json,
        params={"site": site} | ({"per_camera": "true"} if per_camera else {}),
        form={f"{CAPTURED_AT}.{camera}".rstrip("."): _rfc3339(time) for camera, time in times.items()},
        files={camera: (camera, data) for camera, data in frames.items()},
    )


def put_site_call(site: SiteDocument) -> Call[SiteDocument]:
    """``PUT /sites/{id}``: add or replace a site."""
    return Call("PUT", _site_path(str(site.get("id", ""))), _document, json=site)


def get_site_call(site: str) -> Call[SiteDocument]:
    """``GET /sites/{id}``."""
    return Call("GET", _site_path(site), _document)


def delete_site_call(site: str) -> Call[None]:
    """``DELETE /sites/{id}``."""
    return Call("DELETE", _site_path(site), lambda _: None)


class Client:
    """Talks to a service from plain code. Not for use by several threads at once."""

    def __init__(
        self,
        url: str = DEFAULT_URL,
        timeouts: Timeouts = Timeouts(),
        transport: httpx.BaseTransport | None = None,
        token: str | None = None,
    ) -> None:
        """url: the service's root. transport: another way to the service, for tests. token: where the service wants one."""
        self._url, self._timeouts, self._headers = url, timeouts, bearer(token)
        self._http = httpx.Client(base_url=url, timeout=_timeout(timeouts), transport=transport, headers=self._headers)

    def send(self, call: Call[_T]) -> _T:
        """Send one request. Raises ServiceError."""
        with reaching(self._url):
            response = self._http.send(call.request(self._http))
        return call.read(response)

    def detect(self, site: str, frames: Frames, captured_at: CaptureTime | None = None, per_camera: bool = False) -> Detections:
        """Boxes of one frame set; with ``per_camera`` also those of each camera before fusion. Raises ServiceError."""
        return self.send(detect_call(site, frames, captured_at, per_camera))

    def put_site(self, site: SiteDocument) -> SiteDocument:
        """Add or replace a site; gives it as the service keeps it. Raises ServiceError."""
        return self.send(put_site_call(site))

    def get_site(self, site: str) -> SiteDocument:
        """A site's cameras, ground and origin. Raises ServiceError."""
        return self.send(get_site_call(site))

    def delete_site(self, site: str) -> None:
        """Drop a site. Raises ServiceError."""
        self.send(delete_site_call(site))

    def stream(self, site: str) -> Iterator[Detections]:
        """Every fused message of a site, until the site is deleted or the caller stops. Raises ServiceError."""
        with (
            reaching(self._url),
            websockets.sync.client.connect(
                socket_url(self._url, "stream", site),
                open_timeout=self._timeouts.connect_s,
                max_size=MAX_MESSAGE_BYTES,
                additional_headers=self._headers,
            ) as socket,
        ):
            for text in socket:
                yield Detections.model_validate_json(text)

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


class AsyncClient:
    """Talks to a service from asyncio code; the methods are those of :class:`Client`."""

    def __init__(
        self,
        url: str = DEFAULT_URL,
        timeouts: Timeouts = Timeouts(),
        transport: httpx.AsyncBaseTransport | None = None,
        token: str | None = None,
    ) -> None:
        """url: the service's root. transport: another way to the service, for tests. token: where the service wants one."""
        self._url, self._timeouts, self._headers = url, timeouts, bearer(token)
        self._http = httpx.AsyncClient(base_url=url, timeout=_timeout(timeouts), transport=transport, headers=self._headers)

    async def send(self, call: Call[_T]) -> _T:
        """Send one request. Raises ServiceError."""
        with reaching(self._url):
            response = await self._http.send(call.request(self._http))
        return call.read(response)

    async def detect(
        self, site: str, frames: Frames, captured_at: CaptureTime | None = None, per_camera: bool = False
    ) -> Detections:
        """As :meth:`Client.detect`."""
        return await self.send(detect_call(site, frames, captured_at, per_camera))

    async def put_site(self, site: SiteDocument) -> SiteDocument:
        """As :meth:`Client.put_site`."""
        return await self.send(put_site_call(site))

    async def get_site(self, site: str) -> SiteDocument:
        """As :meth:`Client.get_site`."""
        return await self.send(get_site_call(site))

    async def delete_site(self, site: str) -> None:
        """As :meth:`Client.delete_site`."""
        await self.send(delete_site_call(site))

    async def stream(self, site: str) -> AsyncIterator[Detections]:
        """As :meth:`Client.stream`."""
        with reaching(self._url):
            async with websockets.asyncio.client.connect(
                socket_url(self._url, "stream", site),
                open_timeout=self._timeouts.connect_s,
                max_size=MAX_MESSAGE_BYTES,
                additional_headers=self._headers,
            ) as socket:
                async for text in socket:
                    yield Detections.model_validate_json(text)

    async def aclose(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.aclose()


@contextmanager
def reaching(url: str) -> Iterator[None]:
    """Turn what the transports raise into ServiceError."""
    try:
        yield
    except InvalidStatus as refused:
        response = refused.response
        raise _error(response.status_code, bytes(response.body or b""), response.headers.get("Retry-After")) from refused
    except (httpx.TransportError, WebSocketException, OSError) as failed:
        reason = str(failed) or type(failed).__name__
        raise ServiceError(
            "unreachable", f"{url} did not answer: {reason}.", remedy="Is the service running there?"
        ) from failed


def _error(status: int, body: bytes, retry_after: str | None) -> ServiceError:
    retry_after_s = int(retry_after) if retry_after and retry_after.isdecimal() else None
    try:
        detail = ErrorMessage.model_validate_json(body).error
    except ValidationError:
        # Something between client and service answered, a proxy for example.
        shown = body[:200].decode("utf-8", "replace") or "an empty body"
        return ServiceError("unknown", f"HTTP {status} with {shown!r}.", status=status, retry_after_s=retry_after_s)
    return ServiceError(
        detail.code, detail.message, status=status, field=detail.field, remedy=detail.remedy, retry_after_s=retry_after_s
    )


def _rfc3339(time: datetime) -> str:
    if time.tzinfo is None:
        raise ValueError(f"the capture time {time} has no time zone; for example use datetime.now(UTC)")
    return time.astimezone(UTC).isoformat()


def _document(body: bytes) -> SiteDocument:
    document: SiteDocument = json.loads(body)
    return document


def _site_path(site: str) -> str:
    return f"/sites/{quote(site, safe='')}"


def socket_url(url: str, room: str, site: str) -> str:
    """Address of a site's WebSocket: ``room`` is ``stream`` or ``ingest``; url is the service's root."""
    root = httpx.URL(url)
    scheme = {"http": "ws", "https": "wss"}[root.scheme]
    return f"{root.copy_with(scheme=scheme)}".rstrip("/") + f"/{room}/{quote(site, safe='')}"


def bearer(token: str | None) -> dict[str, str]:
    """The header that carries a token."""
    return {"Authorization": f"Bearer {token}"} if token else {}


def _timeout(timeouts: Timeouts) -> httpx.Timeout:
    return httpx.Timeout(timeouts.answer_s, connect=timeouts.connect_s)
