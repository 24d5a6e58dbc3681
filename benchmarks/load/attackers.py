"""Those who attack a service from a process of their own; each prints its figures as JSON.

``python -c "from benchmarks.load.attackers import main; main()" NAME URL SITE SECONDS SEED``
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from collections.abc import Awaitable, Callable
from typing import Any

import websockets.asyncio.client
from websockets.exceptions import WebSocketException

from benchmarks.load.mutation import ByteMutator
from benchmarks.load.parsers import parser_targets
from benchmarks.load.raw_http import endless_bodies, fuzz_raw
from clients.client import socket_url

PROGRAM = "from benchmarks.load.attackers import main; main()"
CONTROL = "bystander"
"""The attacker that is there to be compared with."""


async def raw_http(url: str, site: str, seconds: float, seed: int) -> dict[str, Any]:
    """Broken HTTP on plain sockets."""
    return (await fuzz_raw(url, seconds, seed)).document()


async def endless(url: str, site: str, seconds: float, seed: int) -> dict[str, Any]:
    """Chunked bodies without an end."""
    return (await endless_bodies(url, seconds)).document()


async def camera_streams(url: str, site: str, seconds: float, seed: int) -> dict[str, Any]:
    """Broken messages over camera streams, four at once, each opened again when it is cut."""
    until = time.monotonic() + seconds
    sent = cut = 0

    async def one(number: int) -> None:
        nonlocal sent, cut
        parser = parser_targets()["ingest_header"]
        maker = ByteMutator(parser.corpus, parser.words, seed + number)
        while time.monotonic() < until:
            try:
                address = socket_url(url, "ingest", site)
                async with websockets.asyncio.client.connect(address, open_timeout=10, close_timeout=1, compression=None) as ws:
                    while time.monotonic() < until:
                        await ws.send(maker.make())
                        sent += 1
                        # Sending does not wait while there is room, and being cut must be noticed.
                        await asyncio.sleep(0)
            except (OSError, WebSocketException):
                cut += 1
                await asyncio.sleep(0.01)

    await asyncio.gather(*(one(number) for number in range(4)))
    return {"messages": sent, "connections_cut": cut}


async def bystander(url: str, site: str, seconds: float, seed: int) -> dict[str, Any]:
    """No attack: works as hard as one core can and sends nothing. What it costs the honest client, the machine costs."""
    until, rounds = time.monotonic() + seconds, 0
    while time.monotonic() < until:
        sum(range(10_000))
        rounds += 1
    return {"rounds": rounds}


ATTACKERS: dict[str, Callable[[str, str, float, int], Awaitable[dict[str, Any]]]] = {
    CONTROL: bystander,
    "raw_http": raw_http,
    "endless_bodies": endless,
    "camera_streams": camera_streams,
}


def main() -> None:
    """Entry point of the process."""
    name, url, site, seconds, seed = sys.argv[1:]

    async def attack() -> dict[str, Any]:
        return await ATTACKERS[name](url, site, float(seconds), int(seed))

    print(json.dumps(asyncio.run(attack())))
