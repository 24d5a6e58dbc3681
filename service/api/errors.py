"""Every answer that is not a success, in one form: ``{"error": {"code", "message", "field", "remedy"}}``."""

from __future__ import annotations

from collections.abc import Mapping
from http import HTTPStatus

import orjson
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.responses import Response

from service.errors import InputError, OverloadError, QuadliftError, UnauthorizedError
from service.schemas import ErrorDetail, ErrorMessage

INTERNAL = QuadliftError("something went wrong inside the service.", remedy="The service's log says what.")
"""What a caller learns of an unknown error."""

_CODES = {404: "not_found", 405: "method_not_allowed"}
_REMEDIES = {
    404: "GET /docs lists every address.",
    405: "The Allow header names the methods; GET /docs explains them.",
}


def error_response(error: QuadliftError) -> Response:
    """The answer for an error of the service's own tree."""
    headers = {}
    if isinstance(error, OverloadError):
        headers["Retry-After"] = str(error.retry_after_s)
    if isinstance(error, UnauthorizedError):
        headers["WWW-Authenticate"] = "Bearer"
    return _response(error.status, _detail(error), headers)


def error_text(error: QuadliftError) -> str:
    """The same for a WebSocket: the error's JSON."""
    return _body(_detail(error)).decode()


def install_error_handlers(app: FastAPI) -> None:
    """Let every known kind of exception answer in the one form."""
    app.add_exception_handler(QuadliftError, _own)
    app.add_exception_handler(RequestValidationError, _validation)
    app.add_exception_handler(HTTPException, _http)


def _own(request: Request, error: Exception) -> Response:
    if not isinstance(error, QuadliftError):
        raise error
    return error_response(error)


def _validation(request: Request, error: Exception) -> Response:
    if not isinstance(error, RequestValidationError):
        raise error
    first = error.errors()[0]
    shown = repr(first.get("input"))[:80]
    return error_response(
        InputError(
            f"{first['msg']} (got {shown}).",
            # The first part says where the value was sought (query, path, body), which the caller knows.
            field=".".join(str(part) for part in first["loc"][1:]) or None,
            remedy="GET /docs says what each address takes.",
        )
    )


def _http(request: Request, error: Exception) -> Response:
    if not isinstance(error, HTTPException):
        raise error
    status = error.status_code
    detail = ErrorDetail(
        code=_CODES.get(status, HTTPStatus(status).name.lower()),
        message=f"{request.method} {request.url.path[:200]}: {HTTPStatus(status).phrase}.",
        remedy=_REMEDIES.get(status),
    )
    return _response(status, detail, error.headers or {})


def _response(status: int, detail: ErrorDetail, headers: Mapping[str, str]) -> Response:
    return Response(_body(detail), status, headers, "application/json")


def _detail(error: QuadliftError) -> ErrorDetail:
    return ErrorDetail(code=error.code, message=error.message, field=error.field, remedy=error.remedy)


def _body(detail: ErrorDetail) -> bytes:
    return orjson.dumps(ErrorMessage(error=detail).model_dump())
