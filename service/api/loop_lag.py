"""How late the event loop is: everything that it serves waits as long."""

from __future__ import annotations

import asyncio

from service.telemetry import Telemetry

PERIOD_S = 0.25
"""Time between two samples."""


async def watch_loop(telemetry: Telemetry, period_s: float = PERIOD_S) -> None:
    """Sample the event loop's lag until cancelled."""
    loop = asyncio.get_running_loop()
    while True:
        due = loop.time() + period_s
        await asyncio.sleep(period_s)
        telemetry.lag(loop.time() - due)
