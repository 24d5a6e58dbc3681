"""Attacks on a running service: requests from its own description, broken HTTP, endless bodies, broken camera streams."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import websockets.asyncio.client
from websockets.exceptions import WebSocketException

from benchmarks.load.honest import HonestClient, compare
from benchmarks.load.mutation import ByteMutator
from benchmarks.load.parsers import parser_targets
from benchmarks.load.raw_http import endless_bodies, fuzz_raw
from benchmarks.load.target_service import Target, put_sites, read_counters, serving
from clients.client import ServiceError, socket_url
from clients.clip import Clip, open_clip
from clients.local_service import LocalServiceError

SCHEMATHESIS = "from schemathesis.cli import schemathesis; schemathesis()"
_SLACK_S = 45.0
"""For an attack to end beside its time: schemathesis reads the description first and reports last."""
_WARM_UP_S = 2.0
_SHOWN = 1500

Attack = Callable[[Target, Clip, float, int], Awaitable[dict[str, Any]]]
"""Attacks for some seconds, with a seed; gives its own figures, with ``5xx`` among them."""


async def described(target: Target, clip: Clip, seconds: float, seed: int) -> dict[str, Any]:
    """Schemathesis over the OpenAPI document: half of the time with ids of its own, half with those of a site that exists."""
    site = clip.site | {"id": "probe"}
    await put_sites(target.url, {"probe": site})
    known = f'[parameters]\nsite = "probe"\ncamera = "{site["cameras"][0]["id"]}"\n'
    runs = [await _schemathesis(target, configuration, seconds / 2, seed) for configuration in ("", known)]
    return {"exit_codes": [code for code, _ in runs], "said": [said for _, said in runs]}


async def _schemathesis(target: Target, configuration: str, seconds: float, seed: int) -> tuple[int | None, str]:
    """One run: its exit code, None when it had to be ended, and its last words."""
    command = [
        sys.executable, "-P", "-c", SCHEMATHESIS, "run", f"{target.url}/openapi.json", "--checks", "not_a_server_error",
        "--continue-on-failure", "--max-time", str(max(1, round(seconds))), "--max-examples", "1000", "--seed", str(seed),
        "--request-timeout", "20", "--suppress-health-check", "all", "--no-color", "--warnings", "off",
    ]  # fmt: skip
    with tempfile.TemporaryDirectory(prefix="quadlift-attack-") as folder:
        (Path(folder) / "schemathesis.toml").write_text(configuration, "utf-8")
        child = await asyncio.create_subprocess_exec(
            *command, cwd=folder, start_new_session=True, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT
        )
        try:
            async with asyncio.timeout(seconds + _SLACK_S):
                said, _ = await child.communicate()
            code = child.returncode
        except TimeoutError:
            said, code = b"not done in time", None
        finally:
            if child.returncode is None:
                os.killpg(child.pid, signal.SIGKILL)
                await child.wait()
    text = said.decode("utf-8", "replace").strip()
    return code, text[-_SHOWN:] if code != 0 else text.splitlines()[-1].strip("= ")


async def raw(target: Target, clip: Clip, seconds: float, seed: int) -> dict[str, Any]:
    """Broken HTTP on plain sockets."""
    return (await fuzz_raw(target.url, seconds, seed)).document()


async def endless(target: Target, clip: Clip, seconds: float, seed: int) -> dict[str, Any]:
    """Chunked bodies without an end."""
    return (await endless_bodies(target.url, seconds)).document()


async def camera_streams(target: Target, clip: Clip, seconds: float, seed: int) -> dict[str, Any]:
    """Broken messages over camera streams, four at once, each opened again when it is cut."""
    until = time.monotonic() + seconds
    sent = cut = 0

    async def one(number: int) -> None:
        nonlocal sent, cut
        parser = parser_targets()["ingest_header"]
        maker = ByteMutator(parser.corpus, parser.words, seed + number)
        while time.monotonic() < until:
            try:
                address = socket_url(target.url, "ingest", clip.site["id"])
                async with websockets.asyncio.client.connect(address, open_timeout=10, close_timeout=1, compression=None) as ws:
                    while time.monotonic() < until:
                        await ws.send(maker.make())
                        sent += 1
            except (OSError, WebSocketException):
                cut += 1
                await asyncio.sleep(0.01)

    async with asyncio.timeout(seconds + _SLACK_S):
        await asyncio.gather(*(one(number) for number in range(4)))
    return {"messages": sent, "connections_cut": cut}


ATTACKS: dict[str, Attack] = {
    "schemathesis": described,
    "raw_http": raw,
    "endless_bodies": endless,
    "camera_streams": camera_streams,
}


async def run_attacks(names: list[str], seconds: float, seed: int) -> dict[str, dict[str, Any]]:
    """Each attack on a service of its own, with an honest client beside it; one that fails altogether says so."""
    figures: dict[str, dict[str, Any]] = {}
    for name in names:
        try:
            async with asyncio.timeout(2 * seconds + 3 * _SLACK_S):
                figures[name] = await _run_one(ATTACKS[name], seconds, seed)
        except (TimeoutError, LocalServiceError, ServiceError, httpx.HTTPError, OSError) as error:
            figures[name] = {"passed": False, "failed": f"{type(error).__name__}: {str(error)[:_SHOWN]}"}
    return figures


async def _run_one(attack: Attack, seconds: float, seed: int) -> dict[str, Any]:
    clip = open_clip()
    async with serving(clip.site) as target:
        honest = HonestClient(target, clip)
        await honest.during(partial(asyncio.sleep, _WARM_UP_S))
        _, before = await honest.during(partial(asyncio.sleep, seconds))
        then = await asyncio.to_thread(read_counters, target.url)
        began = time.monotonic()
        own, during = await honest.during(lambda: attack(target, clip, seconds, seed))
        took_s = time.monotonic() - began
        now = await asyncio.to_thread(read_counters, target.url)
        alive = target.process.poll() is None
    answered = {status: n - then.by_label("http_requests", "status").get(status, 0)
                for status, n in now.by_label("http_requests", "status").items()}  # fmt: skip
    failed = {status: count for status, count in answered.items() if status.startswith("5") and count}
    failed_attack = sum(failed.values()) - sum(n for status, n in during.failures.items() if status.startswith("5"))
    figures = own | compare(before, during) | {
        "seconds": round(took_s, 1),
        "http_answers": sum(answered.values()) - during.requests,
        "answers_by_status": {status: count for status, count in sorted(answered.items()) if count},
        "5xx": max(failed_attack, own.get("5xx", 0)),
        "alive": alive,
    }  # fmt: skip
    return figures | {"passed": figures["kept_limits"] and alive and not figures["5xx"]}
