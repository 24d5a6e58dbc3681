"""The same load from more sites, and sites of more cameras: throughput, fairness, cost a camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from benchmarks.load.fault_load import LoadSite
from benchmarks.load.open_loop import PostJob, PostOutcome, post_load
from benchmarks.load.overload import PEAK_CONNECTIONS
from benchmarks.load.target_service import put_sites, serving
from clients.clip import Clip, open_clip
from service.settings import usable_cores

ROUNDS = 3
"""Numbers of sites, or of cameras, take turns."""
SITES = (1, 2, 8, 32)
LOADS = (0.95, 1.5)
"""Total load, of the peak."""
MIN_THROUGHPUT = 0.90
"""With most sites, of that with one."""
MIN_FAIRNESS = 0.95
CAMERAS = (1, 2, 4, 8, 16)
MAX_COST = 1.10
"""Of a camera among sixteen, against one among four."""
_CONNECTIONS = 64
"""Of all sites together at most."""


def jain(shares: Sequence[float]) -> float:
    """Jain's fairness index: 1 when all are alike, 1 / n when one has all; NaN when nobody has any."""
    squares = sum(share * share for share in shares)
    return sum(shares) ** 2 / (len(shares) * squares) if squares else float("nan")


def repeated_site(clip: Clip, site_id: str, count: int) -> LoadSite:
    """A site of ``count`` cameras: the clip's, again and again under other names."""
    by_id = {camera["id"]: camera for camera in clip.site["cameras"]}
    names = {
        f"{clip.camera_ids[i % len(clip.camera_ids)]}-{i}": clip.camera_ids[i % len(clip.camera_ids)] for i in range(count)
    }
    cameras = [by_id[camera] | {"id": name} for name, camera in names.items()]
    return LoadSite(site_id, names, clip.site | {"id": site_id, "cameras": cameras})


def _job(url: str, site: LoadSite, rate_hz: float, connections: int) -> PostJob:
    return PostJob(url, f"/detect?site={site.id}", dict(site.cameras), rate_hz, connections)


async def measure_sites(seconds: float) -> dict[str, Any]:
    """The same total load from 1 to 32 sites. Raises LocalServiceError, ServiceError, LoadError."""
    clip = open_clip()
    sites = [repeated_site(clip, f"site-{number}", 4) for number in range(max(SITES))]
    turn_s = seconds / (ROUNDS * (1 + len(SITES) * len(LOADS)))
    outcomes: dict[tuple[float, int], list[list[PostOutcome]]] = {(load, n): [] for load in LOADS for n in SITES}
    peaks: list[float] = []
    async with serving(sites[0].document) as target:
        await put_sites(target.url, {site.id: site.document for site in sites})
        closed = [_job(target.url, sites[0], 0.0, PEAK_CONNECTIONS)]
        await post_load(closed, turn_s)
        for _ in range(ROUNDS):
            peaks.append((await post_load(closed, turn_s))[0].goodput_hz)
            for load, count in outcomes:
                rate_hz = load * peaks[-1] / count
                jobs = [_job(target.url, site, rate_hz, max(2, _CONNECTIONS // count)) for site in sites[:count]]
                outcomes[load, count].append(await post_load(jobs, turn_s))
    return _site_figures(peaks, outcomes)


def _site_figures(peaks: list[float], outcomes: dict[tuple[float, int], list[list[PostOutcome]]]) -> dict[str, Any]:
    table: dict[str, Any] = {}
    passed = True
    for load in LOADS:
        rates = {n: sum(one.goodput_hz for turn in outcomes[load, n] for one in turn) / ROUNDS for n in SITES}
        rows = {}
        for n in SITES:
            turns = outcomes[load, n]
            # Over all turns: a share of each site.
            shares = [sum(turn[site].answered for turn in turns) for site in range(n)]
            rows[str(n)] = {
                "goodput_hz": round(rates[n], 2),
                "ratio_to_one_site": round(rates[n] / rates[SITES[0]], 3),
                "fairness": round(jain(shares), 4),
                "offered": sum(one.offered for turn in turns for one in turn),
                "answered": sum(shares),
            }
            passed &= rates[n] >= MIN_THROUGHPUT * rates[SITES[0]] and jain(shares) >= MIN_FAIRNESS
        table[f"{load}x"] = rows
    return {
        "peak_hz": [round(peak, 2) for peak in peaks],
        "load": table,
        "min_ratio": MIN_THROUGHPUT,
        "min_fairness": MIN_FAIRNESS,
        "passed": passed,
    }


async def measure_cameras(seconds: float) -> dict[str, Any]:
    """What a camera costs in a site of 1 to 16. Raises LocalServiceError, ServiceError, LoadError."""
    clip = open_clip()
    sites = {count: repeated_site(clip, f"cameras-{count}", count) for count in CAMERAS}
    turn_s = seconds / (ROUNDS * len(CAMERAS))
    done = {count: PostOutcome() for count in CAMERAS}
    async with serving(sites[4].document) as target:
        await put_sites(target.url, {site.id: site.document for site in sites.values()})
        for number in range(ROUNDS + 1):
            for count, site in sites.items():
                outcome = (await post_load([_job(target.url, site, 0.0, PEAK_CONNECTIONS)], turn_s if number else 1.0))[0]
                # The first time only warms up.
                if number:
                    done[count].add(outcome)
    rates = {count: turns.goodput_hz for count, turns in done.items()}
    cost_ms = {count: 1e3 * usable_cores() / (rate * count) if rate else float("nan") for count, rate in rates.items()}
    growth = cost_ms[16] / cost_ms[4]
    return {
        "sets_per_second": {str(count): round(rate, 2) for count, rate in rates.items()},
        "core_ms_per_camera": {str(count): round(cost, 2) for count, cost in cost_ms.items()},
        "growth_16_to_4": round(growth, 3),
        "max_growth": MAX_COST,
        "statuses": {str(count): turns.statuses for count, turns in done.items()},
        "passed": growth <= MAX_COST,
    }
