"""The event loop's lag: what blocks it shows."""

from __future__ import annotations

import asyncio
import time

from service.api.loop_lag import watch_loop
from service.telemetry import Telemetry


def test_what_blocks_the_loop_is_seen() -> None:
    telemetry = Telemetry()

    async def scenario() -> None:
        watching = asyncio.create_task(watch_loop(telemetry, 0.01))
        await asyncio.sleep(0)
        time.sleep(0.06)
        await asyncio.sleep(0.02)
        watching.cancel()
        await asyncio.gather(watching, return_exceptions=True)

    asyncio.run(scenario())
    lag = telemetry.registry.get_sample_value("quadlift_event_loop_lag_seconds_sum")
    assert lag is not None
    assert lag >= 0.05
