"""Tokens and origins: nothing without the right scope, everything as before without tokens."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import SecretStr
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from service.api.app import create_app
from service.api.auth import TokenScope, load_tokens, needed_scope
from service.errors import InputError
from service.settings import Settings

TOKENS = {scope: f"{scope}-0123456789abcdef0123456789" for scope in ("ingest", "read", "admin")}


def bearer(scope: str | None) -> dict[str, str]:
    return {"Authorization": f"Bearer {TOKENS[scope]}"} if scope else {}


@pytest.fixture
def guarded(start: Callable[..., Any], tmp_path: Path) -> Any:
    """A service with three tokens, whose client sends none of its own."""
    path = tmp_path / "tokens"
    path.write_text("# who may do what\n\n" + "".join(f"{scope} {token}\n" for scope, token in TOKENS.items()))
    return start(headers=bearer("admin"), tokens_file=path)


def ask(client: Any, method: str, path: str, scope: str | None) -> httpx.Response:
    response: httpx.Response = httpx.request(method, f"http://{client.address}{path}", headers=bearer(scope), timeout=10)
    return response


@pytest.mark.parametrize(
    ("method", "path", "allowed"),
    [
        ("GET", "/health/live", {None, "ingest", "read", "admin"}),
        ("GET", "/metrics", {"read", "admin"}),
        ("GET", "/sites", {"read", "admin"}),
        ("GET", "/docs", {"read", "admin"}),
        ("GET", "/", {"read", "admin"}),
        ("POST", "/detect?site=demo", {"ingest", "admin"}),
        ("DELETE", "/sites/none", {"admin"}),
        ("PUT", "/sites/demo", {"admin"}),
        ("GET", "/no/such/address", {"read", "admin"}),
    ],
)
def test_each_address_wants_its_scope(guarded: Any, method: str, path: str, allowed: set[str | None]) -> None:
    for scope in (None, *TOKENS):
        status = ask(guarded, method, path, scope).status_code
        expected = None if scope in allowed else 401 if scope is None else 403
        assert status == expected or (expected is None and status not in (401, 403)), (scope, status)


def test_refusals_have_the_error_form(guarded: Any, tools: Any) -> None:
    response = ask(guarded, "GET", "/sites", None)
    assert tools.error(response, 401)["code"] == "unauthorized"
    assert response.headers["www-authenticate"] == "Bearer"
    assert tools.error(ask(guarded, "GET", "/sites", "ingest"), 403)["code"] == "forbidden"


@pytest.mark.parametrize(
    "headers",
    [
        {"Authorization": TOKENS["read"]},
        {"Authorization": f"Basic {TOKENS['read']}"},
        {"Authorization": f"Bearer {TOKENS['read'][:-1]}"},
        {"Authorization": f"Bearer {TOKENS['read']}x"},
        {"Authorization": "Bearer"},
        {"Authorization": b"Bearer \xff\xfe"},
    ],
)
def test_what_is_not_the_token_does_not_do(guarded: Any, headers: Any) -> None:
    assert httpx.get(f"http://{guarded.address}/sites", headers=headers).status_code == 401


def test_tokens_in_addresses_do_not_count(guarded: Any) -> None:
    for name in ("token", "access_token"):
        assert ask(guarded, "GET", f"/sites?{name}={TOKENS['admin']}", None).status_code == 401


@pytest.mark.parametrize(("room", "scope"), [("stream", "read"), ("ingest", "ingest")])
def test_web_sockets_want_their_scope(guarded: Any, room: str, scope: str) -> None:
    address = f"ws://{guarded.address}/{room}/demo"
    with connect(address, additional_headers=bearer(scope)):
        pass
    for wrong, status in (({}, 401), (bearer("ingest" if scope == "read" else "read"), 403)):
        with pytest.raises(InvalidStatus) as caught:
            connect(address, additional_headers=wrong)
        assert caught.value.response.status_code == status
        assert json.loads(caught.value.response.body)["error"]["field"] == "Authorization"


def opens(client: Any, origin: str | None, room: str = "stream") -> bool:
    try:
        with connect(f"ws://{client.address}/{room}/demo", origin=origin):  # type: ignore[arg-type]
            return True
    except InvalidStatus as refused:
        return refused.response.status_code != 403


def test_pages_of_foreign_origins_may_not_connect(start: Callable[..., Any]) -> None:
    client = start(allowed_origins=("https://Map.example",))
    assert opens(client, None)
    assert opens(client, f"http://{client.address}")
    assert opens(client, "https://map.example")
    assert not opens(client, "https://evil.example")
    assert not opens(client, "null")
    assert not opens(client, f"http://{client.address}.evil.example", "ingest")


def test_any_origin_may_be_allowed(start: Callable[..., Any]) -> None:
    assert opens(start(allowed_origins=("*",)), "https://anything.example")


def test_without_tokens_all_is_open(client: Any) -> None:
    assert client.get("/sites").status_code == 200


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no token"),
        ("read", "1 words"),
        ("read a b", "3 words"),
        (f"write {TOKENS['read']}", "scopes"),
        ("read short", "5 characters"),
        ("read " + "é" * 30, "30 characters"),
    ],
)
def test_tokens_that_cannot_be_used_stop_the_start(text: str, says: str, pipeline: Any) -> None:
    with pytest.raises(InputError, match=says) as caught:
        create_app(Settings(tokens=SecretStr(text)), lambda _: pipeline)
    assert TOKENS["read"] not in str(caught.value)


def test_a_file_that_cannot_be_read_stops_the_start(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="tokens_file"):
        load_tokens(Settings(tokens_file=tmp_path / "none"))


def test_settings_never_show_tokens() -> None:
    settings = Settings(tokens=SecretStr(f"read {TOKENS['read']}"))
    assert TOKENS["read"] not in repr(settings)
    (token,) = load_tokens(settings)
    assert token.scopes == {TokenScope.READ}
    assert TOKENS["read"] not in repr(token)


@given(st.sampled_from(["http", "websocket"]), st.text(max_size=8), st.text(max_size=30))
def test_only_health_is_open(kind: str, method: str, path: str) -> None:
    address = "/" + path
    assert (needed_scope(kind, method, address) is None) == address.startswith("/health/")
