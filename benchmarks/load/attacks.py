"""Attacks on a running service: requests from its own description, broken HTTP, endless bodies, broken camera streams."""

from __future__ import annotations

import asyncio
import json
import os
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Any

import httpx

from benchmarks.load import attackers
from benchmarks.load.honest import HonestClient, compare
from benchmarks.load.target_service import Target, put_sites, read_counters, serving
from clients.client import ServiceError
from clients.clip import Clip, open_clip
from clients.local_service import LocalServiceError, child_environment

SCHEMATHESIS = "from schemathesis.cli import schemathesis; schemathesis()"
_SLACK_S = 45.0
"""For an attack to end beside its time: schemathesis reads the description first and reports last."""
ATTACKER_NICE = 19
"""Of an attacker's processes. It stands for another machine: here it may use what the service and its honest client leave, and
is not to take their processor, which no service can guard. What it used is printed beside its pace."""
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
        code, said = await _run(command, Path(folder), seconds)
    return code, said[-_SHOWN:] if code != 0 else said.splitlines()[-1].strip("= ")


def attacker(name: str) -> Attack:
    """One of the attackers in a process of its own: it must not slow the honest client by sharing its event loop."""

    async def attack(target: Target, clip: Clip, seconds: float, seed: int) -> dict[str, Any]:
        command = [sys.executable, "-P", "-c", attackers.PROGRAM, name, target.url, clip.site["id"], str(seconds), str(seed)]
        code, said = await _run(command, Path.cwd(), seconds)
        try:
            figures: dict[str, Any] = json.loads(said)
        except ValueError:
            raise OSError(f"the attacker ended with {code}: {said[-_SHOWN:]}") from None
        return figures

    return attack


async def _run(command: list[str], folder: Path, seconds: float) -> tuple[int | None, str]:
    """What a process said, and its exit code; None when it had to be ended."""
    child = await asyncio.create_subprocess_exec(
        *command,
        cwd=folder,
        env=child_environment(),
        start_new_session=True,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    try:
        os.setpriority(os.PRIO_PROCESS, child.pid, ATTACKER_NICE)
        async with asyncio.timeout(seconds + _SLACK_S):
            said, _ = await child.communicate()
        return child.returncode, said.decode("utf-8", "replace").strip()
    except TimeoutError:
        return None, "not done in time"
    finally:
        if child.returncode is None:
            os.killpg(child.pid, signal.SIGKILL)
            await child.wait()


def _ended_children_cpu_s() -> float:
    """Processor time of child processes that have ended: between two calls, the attackers'; the service goes on running."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


ATTACKS: dict[str, Attack] = {
    "schemathesis": described,
    **{name: attacker(name) for name in attackers.ATTACKERS},
}


async def run_attacks(names: list[str], seconds: float, seed: int) -> dict[str, dict[str, Any]]:
    """Each attack on a service of its own, with an honest client beside it; one that fails altogether says so."""
    figures: dict[str, dict[str, Any]] = {}
    for name in names:
        try:
            async with asyncio.timeout(2 * seconds + 3 * _SLACK_S):
                figures[name] = await _run_one(ATTACKS[name], seconds, seed)
            if name == attackers.CONTROL:
                figures[name]["passed"] = figures[name]["alive"]
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
        began, began_cpu_s = time.monotonic(), _ended_children_cpu_s()
        own, during = await honest.during(lambda: attack(target, clip, seconds, seed))
        took_s, cpu_s = time.monotonic() - began, _ended_children_cpu_s() - began_cpu_s
        now = await asyncio.to_thread(read_counters, target.url)
        alive = target.process.poll() is None
    answered = {status: n - then.by_label("http_requests", "status").get(status, 0)
                for status, n in now.by_label("http_requests", "status").items()}  # fmt: skip
    # 503 is how too much is turned away; that of the honest client counts all the same, as its failure.
    failed = {status: count for status, count in answered.items() if status.startswith("5") and status != "503" and count}
    failed_attack = sum(failed.values()) - sum(n for status, n in during.failures.items() if status in failed)
    figures = own | compare(before, during) | {
        "seconds": round(took_s, 1),
        "attacker_cores": round(cpu_s / took_s, 3),
        "http_answers": sum(answered.values()) - during.requests,
        "answers_by_status": {status: count for status, count in sorted(answered.items()) if count},
        "5xx": max(failed_attack, own.get("5xx", 0)),
        "alive": alive,
    }  # fmt: skip
    return figures | {"passed": figures["kept_limits"] and alive and not figures["5xx"]}
