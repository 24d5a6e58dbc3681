"""The account of faults: what nobody answered and nobody counted is lost, and an answer of another site shows."""

from __future__ import annotations

import asyncio
import os
import signal
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from benchmarks.load import attackers, attacks
from benchmarks.load.fault_load import Account, load_site
from benchmarks.load.faults import FaultResult, counted
from benchmarks.load.faulty_service import FaultyRunner, NetworkFault, fault_file
from benchmarks.load.honest import Watched, compare
from benchmarks.load.target_service import Counters, Target
from clients.clip import open_clip
from service.frames import EncodedFrame, FrameSet
from service.pipeline import SetResult
from service.schemas import Box, CameraStatus, Detections, Timing
from service.site import Site, parse_site


def dropped(**reasons: int) -> Counters:
    return Counters({("quadlift_dropped_total", (("reason", reason),)): count for reason, count in reasons.items()})


def message(site: str, cameras: list[str], seen: list[str]) -> Detections:
    box = Box(class_="car", score=0.9, center=[0, 0, 0], size=[4, 2, 1], yaw=0, covariance=[[0.0] * 7] * 7, cameras=seen)
    timing = Timing(decode=1, detect=1, orient=1, depth=1, lift=1, fuse=1, track=0, total=6)
    statuses = {camera: CameraStatus(status="ok") for camera in cameras}
    return Detections(
        site=site,
        sequence=1,
        captured_at="2026-11-22T01:02:03Z",
        boxes=[box],
        cameras=statuses,
        degraded=False,
        timing_ms=timing,
    )


def test_what_is_neither_answered_nor_counted_is_lost() -> None:
    account = Account(sent=10, statuses=Counter({200: 7}), unanswered=3, moments=5, seen=4)
    assert FaultResult("any", 1, account=account, counted=0).lost_uncounted == 4
    assert FaultResult("any", 1, account=account, counted=3).lost_uncounted == 1
    assert FaultResult("any", 1, account=account, counted=9).lost_uncounted == 0


def test_a_drop_that_was_answered_explains_no_other_loss() -> None:
    account = Account(sent=3, statuses=Counter({500: 2, 200: 1}))
    assert counted(dropped(failed=1), dropped(failed=4), account, cameras=4) == 1
    assert counted(dropped(), dropped(failed=2), account, cameras=4) == 0


def test_dropped_frames_explain_a_set_only_when_they_make_one() -> None:
    assert counted(dropped(), dropped(frame_late=7, frame_refused=100), Account(), cameras=4) == 1


def test_accounts_add_up() -> None:
    whole = Account(sent=1, statuses=Counter({200: 1}))
    whole.add(Account(sent=2, statuses=Counter({200: 1, 503: 1}), unanswered=1, wrong_owner=1, moments=3, seen=2))
    assert whole == Account(3, Counter({200: 2, 503: 1}), 1, 1, 3, 2)


@pytest.mark.parametrize(
    ("changes", "passes"),
    [({}, True), ({"survived": 1}, False), ({"noticed": 1}, False), ({"injected": 1}, False),
     ({"account": Account(wrong_owner=1)}, False)],
)  # fmt: skip
def test_a_kind_passes_only_whole(changes: dict[str, object], passes: bool) -> None:
    whole = {"injected": 2, "noticed": 2, "survived": 2}
    assert FaultResult("any", 2, **(whole | changes)).passed is passes


def test_an_answer_of_another_site_or_camera_shows() -> None:
    site = load_site(open_clip(), "alpha", 2)
    own = list(site.cameras)
    assert site.owns(message("alpha", own, own[:1]))
    assert not site.owns(message("beta", own, own))
    assert not site.owns(message("alpha", own[:1], []))
    assert not site.owns(message("alpha", own, ["beta-north"]))


def test_sites_of_the_load_are_sites() -> None:
    site = load_site(open_clip(), "alpha", 3)
    assert [camera.id for camera in parse_site(site.document).cameras] == list(site.cameras)
    assert site.frames(open_clip(), 10**6).keys() == site.cameras.keys()


class Recorder:
    def __init__(self) -> None:
        self.runs = 0

    def run(self, frame_set: FrameSet) -> SetResult:
        self.runs += 1
        raise NotImplementedError("the networks are not wanted here")

    def warm_up(self) -> None:
        self.runs += 1


@pytest.mark.parametrize(("fault", "error"), [(NetworkFault.RAISE, RuntimeError), (NetworkFault.KILL, SystemExit)])
def test_a_fault_strikes_its_own_site_once(
    tmp_path: Path, fault: NetworkFault, error: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    def end(pid: int, number: int) -> None:
        assert (pid, number) == (os.getpid(), signal.SIGKILL)
        raise SystemExit

    monkeypatch.setattr("benchmarks.load.faulty_service.os.kill", end)
    networks = Recorder()
    runner = FaultyRunner(networks, tmp_path)
    fault_file(tmp_path, "struck", fault).touch()
    frame_sets = {name: FrameSet(Site(name), (EncodedFrame("a", b"", None),), 0, 1) for name in ("struck", "other")}
    with pytest.raises(NotImplementedError):
        runner.run(frame_sets["other"])
    with pytest.raises(error):
        runner.run(frame_sets["struck"])
    with pytest.raises(NotImplementedError):
        runner.run(frame_sets["struck"])
    assert networks.runs == 2


def test_limits_of_an_attack() -> None:
    calm = Watched(latencies_ms=[10.0] * 9, rss_bytes=[100 * 2**20])
    assert compare(calm, Watched(latencies_ms=[14.0] * 9, rss_bytes=[160 * 2**20]))["kept_limits"]
    assert not compare(calm, Watched(latencies_ms=[16.0] * 9, rss_bytes=[160 * 2**20]))["kept_limits"]
    assert not compare(calm, Watched(latencies_ms=[14.0] * 9, rss_bytes=[165 * 2**20]))["kept_limits"]
    assert not compare(calm, Watched(rss_bytes=[100 * 2**20]))["kept_limits"]
    assert not compare(calm, Watched(latencies_ms=[9.0], failures=Counter({"503": 1}), rss_bytes=[1]))["kept_limits"]


def test_a_bystander_is_measured_and_not_judged(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    async def run_one(attack: attacks.Attack, seconds: float, seed: int) -> dict[str, Any]:
        nobody = Target("http://127.0.0.1:9", None, tmp_path)  # type: ignore[arg-type]
        own = await attack(nobody, open_clip(), seconds, seed)
        return own | {"honest_growth": 9.0, "alive": True, "passed": False}

    monkeypatch.setattr(attacks, "_run_one", run_one)
    figures = asyncio.run(attacks.run_attacks([attackers.CONTROL, "raw_http"], 0.1, 1))
    assert figures[attackers.CONTROL]["passed"]
    assert figures[attackers.CONTROL]["rounds"] > 0
    assert not figures["raw_http"]["passed"]
