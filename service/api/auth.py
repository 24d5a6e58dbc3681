"""Who may do what: bearer tokens with scopes, and the origins that browsers may open WebSockets from.

Without tokens in the settings everything is open, as on a laptop. A token travels in the Authorization header and nowhere
else: addresses end up in logs.
"""

from __future__ import annotations

import hashlib
import hmac
import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from urllib.parse import urlsplit

from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket

from service.api.errors import error_response
from service.errors import ForbiddenError, InputError, QuadliftError, UnauthorizedError
from service.settings import Settings

MIN_TOKEN_LENGTH = 24
"""Shorter ones can be guessed; `openssl rand -hex 24` gives 48 characters."""
MAX_TOKENS = 1024
_TOKEN = re.compile(rf"[A-Za-z0-9._~+/=-]{{{MIN_TOKEN_LENGTH},512}}")
_LINE_REMEDY = "Write one token a line: scopes, a blank, the token; for example 'ingest,read ' and `openssl rand -hex 24`."


class TokenScope(StrEnum):
    """What a token allows."""

    INGEST = "ingest"
    """Send frames: ``POST /detect``, ``WS /ingest``."""
    READ = "read"
    """Everything that changes nothing: streams, sites, frames, metrics, pages."""
    ADMIN = "admin"
    """Everything."""


@dataclass(frozen=True)
class Token:
    """A token's digest and what it allows."""

    digest: bytes
    """SHA-256; the token itself is not kept."""
    scopes: frozenset[TokenScope]


def load_tokens(settings: Settings) -> tuple[Token, ...]:
    """The tokens of the settings, from the environment and the file. Raises InputError; no message shows a token."""
    tokens: list[Token] = []
    if settings.tokens is not None:
        lines = settings.tokens.get_secret_value().replace(";", "\n").splitlines()
        tokens += _parse_tokens(lines, "QUADLIFT_TOKENS")
    if settings.tokens_file is not None:
        try:
            lines = settings.tokens_file.read_text("utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(
                f"{settings.tokens_file}: {error}.", field="tokens_file", remedy="Give a file that the service can read."
            ) from None
        tokens += _parse_tokens(lines, str(settings.tokens_file))
    if (settings.tokens is not None or settings.tokens_file is not None) and not tokens:
        # An empty file must not open the service to everybody.
        raise InputError("no token in the settings.", field="tokens", remedy=_LINE_REMEDY)
    if len(tokens) > MAX_TOKENS:
        raise InputError(f"{len(tokens)} tokens; {MAX_TOKENS} are allowed.", field="tokens", remedy="Drop old ones.")
    return tuple(tokens)


def needed_scope(kind: str, method: str, path: str) -> TokenScope | None:
    """What a request needs: ``kind`` is ``http`` or ``websocket``. None: open to all. What is unknown needs the most."""
    if path.startswith("/health/"):
        return None
    if kind == "websocket":
        return {"ingest": TokenScope.INGEST, "stream": TokenScope.READ}.get(
            path.lstrip("/").partition("/")[0], TokenScope.ADMIN
        )
    if method == "POST" and path == "/detect":
        return TokenScope.INGEST
    return TokenScope.READ if method in ("GET", "HEAD") else TokenScope.ADMIN


class Access:
    """ASGI middleware that lets through what its sender may do."""

    def __init__(self, app: ASGIApp, tokens: Sequence[Token], allowed_origins: Sequence[str]) -> None:
        """allowed_origins: beside the service's own; ``*`` for any."""
        self._app = app
        self._tokens = tokens
        self._origins = frozenset(origin.rstrip("/").lower() for origin in allowed_origins)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        try:
            self._check(HTTPConnection(scope))
        except QuadliftError as error:
            response = error_response(error)
            if scope["type"] == "websocket":
                await WebSocket(scope, receive, send).send_denial_response(response)
            else:
                await response(scope, receive, send)
            return
        await self._app(scope, receive, send)

    def _check(self, connection: HTTPConnection) -> None:
        kind = connection.scope["type"]
        if kind == "websocket":
            self._check_origin(connection)
        needed = needed_scope(kind, connection.scope.get("method", "GET"), connection.scope["path"])
        if not self._tokens or needed is None:
            return
        scheme, _, given = connection.headers.get("authorization", "").partition(" ")
        found = self._find(given.strip()) if scheme.lower() == "bearer" else None
        if found is None:
            raise UnauthorizedError(
                "no token, or one that is not known.",
                field="Authorization",
                remedy="Send the header: Authorization: Bearer TOKEN.",
            )
        if needed not in found.scopes and TokenScope.ADMIN not in found.scopes:
            raise ForbiddenError(
                f"this token does not allow '{needed}'.",
                field="Authorization",
                remedy=f"Use a token with the scope '{needed}'.",
            )

    def _find(self, given: str) -> Token | None:
        """The token that was given. Every one is compared, in constant time, so that time tells nothing."""
        digest = hashlib.sha256(given.encode("utf-8", "surrogateescape")).digest()
        found: Token | None = None
        for token in self._tokens:
            if hmac.compare_digest(token.digest, digest):
                found = token
        return found

    def _check_origin(self, connection: HTTPConnection) -> None:
        """Browsers name the page that opens a WebSocket, and let any page try; other clients send no origin."""
        origin = connection.headers.get("origin")
        if origin is None or "*" in self._origins or origin.rstrip("/").lower() in self._origins:
            return
        if _host_of(origin) == connection.headers.get("host", "").lower():
            return
        raise ForbiddenError(
            f"pages of {origin[:80]!r} may not connect.", field="Origin", remedy="Name it in QUADLIFT_ALLOWED_ORIGINS."
        )


def _host_of(origin: str) -> str | None:
    try:
        return urlsplit(origin).netloc.lower() or None
    except ValueError:
        return None


def _parse_tokens(lines: Sequence[str], place: str) -> list[Token]:
    tokens = []
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        field = f"{place}, line {number}"
        if len(words) != 2:
            raise InputError(f"{len(words)} words where 2 are expected.", field=field, remedy=_LINE_REMEDY)
        names = words[0].split(",")
        if not set(names) <= set(TokenScope):
            raise InputError("not a list of scopes.", field=field, remedy=f"Scopes are {', '.join(TokenScope)}.")
        if not _TOKEN.fullmatch(words[1]):
            raise InputError(
                f"a token of {len(words[1])} characters; {MIN_TOKEN_LENGTH} to 512 of A-Z a-z 0-9 . _ ~ + / = - are needed.",
                field=field,
                remedy="Make one with: openssl rand -hex 24.",
            )
        tokens.append(Token(hashlib.sha256(words[1].encode()).digest(), frozenset(TokenScope(name) for name in names)))
    return tokens
