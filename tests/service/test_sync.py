"""Laws of the grouping: no frame twice, none lost uncounted, sets in order, the order of arrival without effect."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.frames import EncodedFrame
from service.sync import SyncedSet, Synchronizer, SyncSettings
from service.telemetry import Drop

MS = 1_000_000
EPOCH_NS = 1_800_000_000 * 10**9
CAMERAS = ("east", "north", "south")


def frame(camera: str, ms: float, data: bytes = b"x") -> EncodedFrame:
    return EncodedFrame(camera, data, EPOCH_NS + round(ms * MS))


def shown(sets: list[SyncedSet]) -> list[tuple[float, dict[str, float]]]:
    """Sets as (time, time by camera), milliseconds."""
    return [
        ((s.captured_at_ns - EPOCH_NS) / MS, {f.camera_id: ((f.captured_at_ns or 0) - EPOCH_NS) / MS for f in s.frames})
        for s in sets
    ]


def present(sync: Synchronizer, *cameras: str) -> None:
    """Let cameras be known: the first set is the first camera's alone, the second is complete."""
    sets = [ready for camera in cameras for ready in sync.push(frame(camera, 0), 0)]
    for i, camera in enumerate(cameras):
        sets += sync.push(frame(camera, 33 + i / 100), 33 * MS)
    sync.poll(200 * MS)
    assert sync.present == set(cameras)
    assert len(sets[-1].frames) == len(cameras)
    assert sync.pending == 0
    sync.dropped.clear()


def test_a_complete_set_goes_out_at_once() -> None:
    sync = Synchronizer(SyncSettings())
    present(sync, "north", "east")
    assert sync.push(frame("north", 200), 200 * MS) == []
    (ready,) = sync.push(frame("east", 203), 204 * MS)
    assert shown([ready]) == [(200, {"north": 200, "east": 203})]
    assert [ready.status(c) for c in ("north", "east", "west")] == ["ok", "ok", "missing"]


def test_an_incomplete_set_goes_out_when_the_wait_ends() -> None:
    sync = Synchronizer(SyncSettings(wait_ns=50 * MS))
    present(sync, "north", "east")
    assert sync.push(frame("north", 200), 200 * MS) == []
    assert sync.deadline_ns == 250 * MS
    assert sync.poll(250 * MS - 1) == []
    (ready,) = sync.poll(250 * MS)
    assert ready.status("east") == "missing"


def test_a_frame_that_missed_its_set_stands_in_as_stale() -> None:
    sync = Synchronizer(SyncSettings())
    present(sync, "north", "east")
    sync.push(frame("north", 200), 200 * MS)
    sync.poll(250 * MS)
    assert sync.push(frame("east", 201), 260 * MS) == []
    sync.push(frame("north", 233), 261 * MS)
    (ready,) = sync.poll(350 * MS)
    assert ready.status("east") == "stale"
    assert shown([ready]) == [(233, {"north": 233, "east": 201})]


def test_a_frame_too_old_to_be_stale_is_counted_late() -> None:
    sync = Synchronizer(SyncSettings(stale_ns=0))
    present(sync, "north", "east")
    sync.push(frame("north", 200), 200 * MS)
    sync.poll(250 * MS)
    sync.push(frame("east", 201), 260 * MS)
    sync.push(frame("north", 233), 261 * MS)
    (ready,) = sync.poll(350 * MS)
    assert ready.status("east") == "missing"
    assert sync.dropped[Drop.FRAME_LATE] == 1


def test_a_camera_that_leaves_is_not_waited_for() -> None:
    sync = Synchronizer(SyncSettings())
    present(sync, "north", "east", "south")
    sync.push(frame("north", 200), 200 * MS)
    sync.push(frame("east", 200), 200 * MS)
    (ready,) = sync.leave("south", 201 * MS)
    assert ready.status("south") == "missing"
    (ready,) = [s for c in ("north", "east") for s in sync.push(frame(c, 233), 233 * MS)]
    assert len(ready.frames) == 2


def test_what_a_camera_sent_before_it_left_still_goes_out() -> None:
    sync = Synchronizer(SyncSettings())
    present(sync, "north", "east")
    sync.push(frame("north", 200), 200 * MS)
    assert sync.leave("north", 201 * MS) == []
    (ready,) = sync.push(frame("east", 201), 202 * MS)
    assert len(ready.frames) == 2
    assert sync.present == {"east"}
    assert sync.dropped == {}


def test_pending_bytes_are_bounded() -> None:
    sync = Synchronizer(SyncSettings(max_bytes=25))
    present(sync, "north", "east")
    for i in range(4):
        sync.push(frame("north", 200 + 33 * i, b"0123456789"), 200 * MS)
    assert sync.pending_bytes == 20
    assert sync.dropped == {Drop.FRAME_BACKLOG: 2}


def test_a_silent_camera_is_not_waited_for() -> None:
    sync = Synchronizer(SyncSettings(absent_ns=1000 * MS))
    present(sync, "north", "east")
    (ready,) = sync.push(frame("north", 1100), 1100 * MS)
    assert sync.present == {"north"}
    assert len(ready.frames) == 1


def test_duplicates_are_counted() -> None:
    sync = Synchronizer(SyncSettings())
    present(sync, "north", "east")
    sync.push(frame("north", 200), 200 * MS)
    sync.push(frame("north", 200), 201 * MS)
    (ready,) = sync.push(frame("east", 200), 202 * MS)
    sync.push(frame("east", 200), 203 * MS)
    assert len(ready.frames) == 2
    assert sync.dropped == {Drop.FRAME_DUPLICATE: 2}


@pytest.mark.parametrize("step_ms", [-3_600_000, -2_000, 2_000, 3_600_000])
def test_one_camera_whose_clock_steps_does_not_stop_the_others(step_ms: int) -> None:
    sync = Synchronizer(SyncSettings())
    present(sync, *CAMERAS)
    sets = []
    for i in range(10):
        now = (200 + 33 * i) * MS
        for camera in CAMERAS:
            sets += sync.push(frame(camera, 200 + 33 * i + step_ms * (camera == "south")), now)
        sets += sync.poll(now + 32 * MS)
    sets += sync.poll(2000 * MS)
    assert [sorted(times) for _, times in shown(sets)] == [["east", "north"]] * 10
    assert sync.dropped[Drop.FRAME_CLOCK] == 10


@pytest.mark.parametrize("step_ms", [-3_600_000, 3_600_000])
def test_a_step_of_all_clocks_begins_an_epoch(step_ms: int) -> None:
    sync = Synchronizer(SyncSettings())
    present(sync, *CAMERAS)
    sets = []
    for i in range(5):
        for camera in CAMERAS:
            sets += sync.push(frame(camera, step_ms + 200 + 33 * i), (200 + 33 * i) * MS)
    sets += sync.poll(2000 * MS)
    assert {s.epoch for s in sets} == {sets[0].epoch}
    assert sets[0].epoch >= 1
    assert [len(s.frames) for s in sets][-4:] == [3] * 4
    assert sync.dropped[Drop.FRAME_CLOCK] <= 2


def test_a_clock_a_little_ahead_does_not_make_the_others_late() -> None:
    sync = Synchronizer(SyncSettings())
    present(sync, *CAMERAS)
    sets = []
    for i in range(20):
        now = (200 + 33 * i) * MS
        for camera in CAMERAS:
            sets += sync.push(frame(camera, 200 + 33 * i + 200 * (camera == "south")), now)
    sets += sync.poll(5000 * MS)
    assert sync.dropped[Drop.FRAME_LATE] == 0
    assert sum("north" in times and "east" in times for _, times in shown(sets)) == 20


def test_pending_frames_of_a_camera_are_bounded() -> None:
    sync = Synchronizer(SyncSettings(max_pending=4))
    present(sync, "north", "east")
    for i in range(20):
        sync.push(frame("north", 200 + i), 200 * MS)
        assert sync.pending <= 4
    assert sync.dropped[Drop.FRAME_BACKLOG] == 16


def test_a_frame_without_a_time_is_refused() -> None:
    with pytest.raises(ValueError, match="capture time"):
        Synchronizer(SyncSettings()).push(EncodedFrame("north", b"x", None), 0)


ARRIVALS = st.lists(
    st.tuples(
        st.sampled_from(CAMERAS),
        st.one_of(st.integers(0, 400), st.integers(-5_000, 5_000)),
        st.integers(0, 60),
        st.sampled_from(["push", "push", "push", "push", "poll", "leave"]),
    ),
    max_size=80,
)


@given(ARRIVALS)
def test_every_frame_ends_in_one_set_or_one_counted_drop(arrivals: list[tuple[str, int, int, str]]) -> None:
    counted: Counter[Drop] = Counter()
    settings = SyncSettings(max_pending=5)
    sync = Synchronizer(settings, lambda reason: counted.update([reason]))
    sets: list[SyncedSet] = []
    now, pushed = 0, []
    for camera, ms, later_ms, action in arrivals:
        now += later_ms * MS
        if action == "push":
            pushed.append(frame(camera, ms))
            sets += sync.push(pushed[-1], now)
        elif action == "poll":
            sets += sync.poll(now)
        else:
            sets += sync.leave(camera, now)
        assert sync.pending <= len(CAMERAS) * (settings.max_pending + 1)
        assert sync.deadline_ns is None or sync.deadline_ns > now
        in_sets = [id(f) for s in sets for f in s.frames]
        assert len(set(in_sets)) == len(in_sets)
        assert set(in_sets) <= {id(f) for f in pushed}
        assert len(in_sets) + counted.total() + sync.pending == len(pushed)
    sync.close()
    assert sync.pending == 0
    assert counted == sync.dropped
    assert sum(len(s.frames) for s in sets) + counted.total() == len(pushed)
    order = [(s.epoch, s.captured_at_ns) for s in sets]
    assert order == sorted(set(order))
    for ready in sets:
        assert len({f.camera_id for f in ready.frames}) == len(ready.frames)
        for f in ready.frames:
            skew = (f.captured_at_ns or 0) - ready.captured_at_ns
            if ready.status(f.camera_id) == "ok":
                assert 0 <= skew <= settings.tolerance_ns
            else:
                assert -settings.stale_ns <= skew < 0


@given(st.data(), st.lists(st.tuples(*[st.integers(0, 9)] * 3), min_size=1, max_size=12))
def test_the_order_of_arrival_within_a_set_has_no_effect(data: st.DataObject, jitters: list[tuple[int, int, int]]) -> None:
    """33 ms between sets, up to 9 ms of jitter, 20 ms of tolerance: the sets are those of the capture times."""
    sync = Synchronizer(SyncSettings())
    present(sync, *CAMERAS)
    sets, expected = [], []
    for i, jitter in enumerate(jitters):
        times = {camera: 300 + 33 * i + j for camera, j in zip(CAMERAS, jitter, strict=True)}
        expected.append((min(times.values()), times))
        for camera in data.draw(st.permutations(CAMERAS)):
            sets += sync.push(frame(camera, times[camera]), (310 + 33 * i) * MS)
    assert shown(sets) == expected
    assert not sync.dropped


@given(st.permutations([(camera, i) for i in range(2) for camera in CAMERAS]))
def test_neighbouring_sets_may_arrive_mixed(order: list[tuple[str, int]]) -> None:
    """As long as a first frame of the earlier set came, later frames wait for it, complete or not."""
    sync = Synchronizer(SyncSettings())
    present(sync, *CAMERAS)
    order = [("east", 0), *[arrival for arrival in order if arrival != ("east", 0)]]
    sets = [ready for camera, i in order for ready in sync.push(frame(camera, 300 + 33 * i), 320 * MS)]
    assert shown(sets) == [(300 + 33 * i, dict.fromkeys(CAMERAS, 300 + 33 * i)) for i in range(2)]
