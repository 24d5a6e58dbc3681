from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.fusion import CameraParts, FusedBoxes
from service.geometry.boxes import Boxes, box_states
from service.geometry.transforms import rotation_z, wrap_angle
from service.tracking import Tracker, TrackSettings

SIGMA = np.array([0.15, 0.15, 0.05, 0.2, 0.06, 0.06, 0.07])
STEP_NS = 100_000_000
START_NS = 1_790_000_000_000_000_000


def fused(rows, flip=2.0, sigma=SIGMA):
    """Fused boxes of cars at rows of (x, y, yaw)."""
    rows = np.asarray(rows, dtype=np.float64).reshape(-1, 3)
    n = len(rows)
    boxes = Boxes(
        center=np.c_[rows[:, :2], np.full(n, 0.75)],
        dims_lwh=np.tile([4.4, 1.8, 1.5], (n, 1)),
        yaw=wrap_angle(rows[:, 2]),
        score=np.full(n, 0.8),
        cls=np.zeros(n, np.int64),
        covariance=np.tile(np.diag(np.square(sigma)), (n, 1, 1)),
        flip_log_odds=np.broadcast_to(np.asarray(flip, dtype=np.float64), n).copy(),
    )
    return FusedBoxes(boxes, np.ones((n, 4), dtype=bool), np.arange(n))


def feed(tracker, frames, step_ns=STEP_NS, **kwargs):
    return [tracker.update(fused(rows, **kwargs), START_NS + step * step_ns) for step, rows in enumerate(frames)]


def drive(speed, steps, heading=0.0, x=0.0, y=0.0, step_s=0.1):
    travelled = speed * step_s * np.arange(steps)
    return np.stack([x + travelled * np.cos(heading), y + travelled * np.sin(heading), np.full(steps, heading)], 1)


def test_a_box_is_reported_at_once_under_a_new_id():
    tracked = Tracker().update(fused([(0, 0, 0), (20, 0, 1)]), START_NS)
    assert tracked.track_id == ["1", "2"]
    np.testing.assert_array_equal(tracked.velocity, 0.0)
    np.testing.assert_allclose(box_states(tracked.boxes), box_states(fused([(0, 0, 0), (20, 0, 1)]).boxes))


@pytest.mark.parametrize("step_s", [0.05, 0.1, 0.3])
def test_speed_is_found_with_real_time_steps(step_s):
    path = drive(12.0, 15, 0.7, step_s=step_s)
    tracked = feed(Tracker(), path[:, None], step_ns=int(step_s * 1e9))
    assert {t.track_id[0] for t in tracked} == {"1"}
    np.testing.assert_allclose(tracked[-1].velocity[0], [12 * np.cos(0.7), 12 * np.sin(0.7), 0], atol=0.3)
    np.testing.assert_allclose(tracked[-1].boxes.center[0, :2], path[-1, :2], atol=0.1)


def test_uneven_steps_and_missed_frames_do_not_disturb_the_speed():
    tracker = Tracker()
    for time_s in (0.0, 0.1, 0.15, 0.4, 0.5, 1.1, 1.2, 1.3, 1.45):
        tracked = tracker.update(fused([(10 * time_s, 0, 0)]), START_NS + round(time_s * 1e9))
    assert tracked.track_id == ["1"]
    np.testing.assert_allclose(tracked.velocity[0, 0], 10.0, atol=0.2)


def test_filtering_beats_the_measurement():
    rng = np.random.default_rng(0)
    path = drive(10.0, 60)
    noisy = path + rng.normal(size=path.shape) * [0.15, 0.15, 0.07]
    tracked = feed(Tracker(), noisy[:, None])[20:]
    filtered = np.array([box_states(t.boxes)[0, [0, 1, 6]] for t in tracked]) - path[20:]
    assert filtered[:, :2].std() < 0.8 * 0.15
    assert filtered[:, 2].std() < 0.07
    position_sigma = np.sqrt(tracked[-1].boxes.covariance[0, 0, 0])
    assert 0.04 < position_sigma < 0.15


def test_identities_survive_two_cars_that_meet_on_adjacent_lanes():
    east, west = drive(10, 40, 0.0, x=-20.0, y=0.0), drive(10, 40, np.pi, x=20.0, y=3.2)
    tracker = Tracker()
    for step in range(40):
        # The order of the boxes changes from frame to frame.
        rows = [east[step], west[step]][:: 1 if step % 2 else -1]
        tracked = tracker.update(fused(rows), START_NS + step * STEP_NS)
        by_lane = dict(zip(np.round(tracked.boxes.center[:, 1] / 3.2).astype(int), tracked.track_id, strict=True))
        if step == 0:
            first = by_lane
        assert by_lane == first


def test_a_track_coasts_over_a_gap_and_is_lost_when_it_stays_away():
    path = drive(10, 120)
    tracker = Tracker()
    feed(tracker, path[:10, None])
    assert tracker.update(fused([]), START_NS + 12 * STEP_NS).track_id == []
    assert tracker.update(fused(path[17:18]), START_NS + 17 * STEP_NS).track_id == ["1"]
    assert tracker.update(fused(path[47:48]), START_NS + 47 * STEP_NS).track_id == ["1"]
    assert tracker.update(fused(path[99:100]), START_NS + 99 * STEP_NS).track_id == ["2"]


def test_what_was_seen_once_and_vaguely_is_forgotten_sooner():
    for score, again in ((0.35, "2"), (0.9, "1")):
        tracker, seen = Tracker(), fused([(0.0, 0, 0)])
        seen = replace(seen, boxes=replace(seen.boxes, score=np.array([score])))
        first = tracker.update(seen, START_NS)
        assert tracker.update(seen, START_NS + 9 * STEP_NS).track_id == [again]
        second = tracker.update(seen, START_NS + 10 * STEP_NS)
        assert 0.5 < first.existence[0] < second.existence[0] < 1


def test_a_jump_is_another_vehicle():
    tracker = Tracker()
    feed(tracker, drive(0, 5)[:, None])
    assert tracker.update(fused([(6.0, 0, 0)]), START_NS + 5 * STEP_NS).track_id == ["2"]


def test_velocity_settles_the_heading_and_the_past_keeps_it():
    # 12 steps at 8 m/s, braking at 4 m/s^2 to a stand, standing; the network says the opposite all the time.
    speed = np.concatenate([np.full(12, 8.0), np.arange(8.0, 0.0, -0.4), np.zeros(8)])
    path = np.stack([np.cumsum(speed) * 0.1, np.zeros_like(speed), np.full_like(speed, np.pi)], 1)
    tracked = feed(Tracker(), path[:, None], flip=0.2)
    yaw = np.array([t.boxes.yaw[0] for t in tracked])
    np.testing.assert_allclose(abs(yaw[0]), np.pi)
    np.testing.assert_allclose(yaw[5:], 0.0, atol=1e-6)
    np.testing.assert_allclose(tracked[-1].velocity, 0.0, atol=0.3)


def test_a_flicker_of_the_heading_does_not_turn_a_standing_car():
    frames = np.zeros((10, 1, 3))
    frames[[3, 7], 0, 2] = np.pi
    yaws = np.array([t.boxes.yaw[0] for t in feed(Tracker(), frames)])
    np.testing.assert_allclose(yaws, 0.0, atol=1e-9)


def test_a_standing_car_born_backwards_turns_when_the_evidence_says_so():
    frames = np.zeros((12, 1, 3))
    frames[0, 0, 2] = np.pi
    yaws = [t.boxes.yaw[0] for t in feed(Tracker(), frames)]
    np.testing.assert_allclose(abs(yaws[0]), np.pi)
    np.testing.assert_allclose(yaws[-1], 0.0, atol=1e-9)


def test_jitter_of_a_new_track_is_no_motion():
    rng = np.random.default_rng(1)
    for _ in range(20):
        frames = np.zeros((6, 1, 3))
        frames[..., :2] += rng.normal(size=(6, 1, 2)) * 0.15
        yaws = np.array([t.boxes.yaw[0] for t in feed(Tracker(), frames)])
        assert (np.abs(yaws) < np.pi / 2).all()


def test_yaw_is_averaged_across_the_wrap():
    frames = np.zeros((20, 1, 3))
    frames[::2, 0, 2], frames[1::2, 0, 2] = np.pi - 0.05, -np.pi + 0.05
    yaw = feed(Tracker(), frames)[-1].boxes.yaw
    assert -np.pi <= yaw[0] < np.pi
    assert abs(wrap_angle(yaw[0] - np.pi)) < 0.05


def test_empty_sets_and_time_that_goes_backwards_are_harmless():
    tracker = Tracker()
    assert tracker.update(fused([]), START_NS).track_id == []
    feed(tracker, drive(5, 5)[:, None])
    tracked = tracker.update(fused([(2.0, 0, 0)]), START_NS - 10 * STEP_NS)
    assert tracked.track_id == ["1"]
    assert np.isfinite(box_states(tracked.boxes)).all()


def test_the_same_sequence_gives_the_same_tracks():
    rng = np.random.default_rng(3)
    frames = rng.normal(size=(20, 5, 3)) * [0.3, 0.3, 0.1] + np.arange(5)[:, None] * [9.0, 2.0, 0.0]
    one, two = feed(Tracker(), frames), feed(Tracker(), frames)
    for a, b in zip(one, two, strict=True):
        assert a.track_id == b.track_id
        np.testing.assert_array_equal(box_states(a.boxes), box_states(b.boxes))
        np.testing.assert_array_equal(a.velocity, b.velocity)


positions = st.tuples(st.floats(-30, 30), st.floats(-30, 30), st.floats(-4, 4))


@given(st.lists(st.tuples(st.lists(positions, max_size=6), st.integers(-STEP_NS, 20 * STEP_NS)), max_size=8))
@settings(max_examples=50, deadline=None)
def test_whatever_comes_in_rows_stay_in_order_and_states_sound(frames):
    tracker, now = Tracker(TrackSettings()), START_NS
    for rows, elapsed in frames:
        now += elapsed
        tracked = tracker.update(fused(rows), now)
        assert len(tracked.track_id) == len(set(tracked.track_id)) == len(rows) == len(tracked.velocity)
        assert np.isfinite(box_states(tracked.boxes)).all()
        assert (np.linalg.eigvalsh(tracked.boxes.covariance) > 0).all()
        assert ((tracked.boxes.yaw >= -np.pi) & (tracked.boxes.yaw < np.pi)).all()
        apart = np.linalg.norm(tracked.boxes.center[:, :2] - np.reshape(rows, (-1, 3))[:, :2], axis=1)
        assert (apart < TrackSettings().max_distance_m).all()


def by_cameras(row, times_ns, sigma, rng=None, owner=None):
    """One car at a row of (x, y, yaw), measured by cameras with sigmas (C, 7) at times (C,), fused as independent."""
    sigma, owner = np.asarray(sigma), np.arange(len(sigma)) if owner is None else owner
    state = np.tile(box_states(fused([row]).boxes), (len(sigma), 1))
    if rng is not None:
        state = state + sigma * rng.normal(size=sigma.shape)
    return from_parts(state, sigma, np.asarray(times_ns), owner)


def from_parts(state, sigma, times_ns, owner):
    parts = fused(state[:, [0, 1, 6]]).boxes
    parts = replace(parts, center=state[:, :3], dims_lwh=state[:, 3:6], covariance=np.stack([np.diag(s**2) for s in sigma]))
    weight = (1 / sigma**2) / (1 / sigma**2).sum(0)
    mean = (weight * state).sum(0)
    one = fused([mean[[0, 1, 6]]], sigma=(1 / sigma**2).sum(0) ** -0.5).boxes
    one = replace(one, center=mean[None, :3], dims_lwh=mean[None, 3:6])
    row = np.zeros(len(sigma), np.int64)
    return FusedBoxes(one, np.ones((1, 4), dtype=bool), row, CameraParts(parts, row, owner, times_ns))


def test_cameras_in_turn_say_what_they_say_together():
    rng = np.random.default_rng(0)
    sigma = SIGMA * rng.uniform(0.5, 3.0, (3, 7))
    together, in_turn = Tracker(), Tracker(TrackSettings(same_time_s=-1.0))
    for step in range(20):
        now = START_NS + step * STEP_NS
        seen = by_cameras((0.9 * step, 0.1, 0.05), np.full(3, now) - [0, 1, 2], sigma, rng)
        one, other = together.update(seen, now), in_turn.update(seen, now)
    np.testing.assert_allclose(box_states(one.boxes), box_states(other.boxes), atol=1e-6)
    np.testing.assert_allclose(one.boxes.covariance, other.boxes.covariance, atol=1e-9)
    np.testing.assert_allclose(one.velocity, other.velocity, atol=1e-6)


def test_cameras_that_look_at_different_times_do_not_blur_a_fast_car():
    rng, skew = np.random.default_rng(1), np.array([-60_000_000, -30_000_000, 0])
    sigma = np.tile(SIGMA, (3, 1))
    errors = {}
    for name in ("with times", "without"):
        tracker, missed = Tracker(), []
        for step in range(40):
            now, x = START_NS + step * STEP_NS, 2.0 * step
            state = np.tile(box_states(fused([(x, 0.0, 0.0)]).boxes), (3, 1))
            state[:, 0] += 20.0 * skew / 1e9
            seen = from_parts(state + sigma * rng.normal(size=(3, 7)), sigma, now + skew, np.arange(3))
            tracked = tracker.update(seen if name == "with times" else replace(seen, parts=None), now)
            missed.append(tracked.boxes.center[0, 0] - x)
        assert tracked.track_id == ["1"]
        errors[name] = abs(np.mean(missed[10:]))
    assert errors["with times"] < 0.05
    assert errors["without"] > 0.3


def test_a_camera_that_leaves_and_returns_changes_nothing_but_the_covariance():
    rng, sigma, steps = np.random.default_rng(2), np.tile(SIGMA, (3, 1)), 60
    tracker, ids, errors, doubts = Tracker(), set(), [], []
    for step in range(steps):
        now, there = START_NS + step * STEP_NS, slice(0, 1 if 20 <= step < 40 else 3)
        times, x = np.full(3, now)[there], 1.1 * step
        tracked = tracker.update(by_cameras((x, 0, 0), times, sigma[there], rng), now)
        ids |= set(tracked.track_id)
        errors.append(tracked.boxes.center[0, 0] - x)
        doubts.append(np.sqrt(tracked.boxes.covariance[0, 0, 0]))
    assert ids == {"1"}
    assert np.abs(errors[5:]).max() < 0.4
    assert doubts[30] > 1.2 * doubts[19]
    np.testing.assert_allclose(doubts[59], doubts[19], rtol=0.05)


def test_a_late_set_is_put_in_its_place():
    rng = np.random.default_rng(4)
    rows = drive(9.0, 25, 0.4) + rng.normal(size=(25, 3)) * [0.1, 0.1, 0.03]
    in_order, late = Tracker(), Tracker()
    for step in range(25):
        expected = in_order.update(fused(rows[step : step + 1]), START_NS + step * STEP_NS)
    for step in [*range(15), 16, 17, 18, 15, 19, 21, 20, 22, 23, 24]:
        tracked = late.update(fused(rows[step : step + 1]), START_NS + step * STEP_NS)
        assert tracked.track_id == ["1"]
    np.testing.assert_allclose(box_states(tracked.boxes), box_states(expected.boxes), atol=1e-9)
    np.testing.assert_allclose(tracked.boxes.covariance, expected.boxes.covariance, atol=1e-12)


def test_a_late_set_takes_nobodys_identity():
    tracker = Tracker()
    tracker.update(fused([]), START_NS)
    assert tracker.update(fused([(0, 0, 0)]), START_NS + 2 * STEP_NS).track_id == ["1"]
    late = tracker.update(fused([(0, 0, 0), (30, 0, 0)]), START_NS + STEP_NS)
    assert len(set(late.track_id)) == 2
    after = tracker.update(fused([(0, 0, 0), (30, 0, 0)]), START_NS + 3 * STEP_NS)
    assert after.track_id == late.track_id
    assert after.track_id[0] == "1"


def test_the_speed_is_as_uncertain_as_it_says():
    rng, seen = np.random.default_rng(5), []
    for _ in range(80):
        speed = 15.0 + np.cumsum(0.1 * TrackSettings().motion.acceleration_sigma * rng.normal(size=15))
        path = np.c_[np.cumsum(0.1 * speed), np.zeros((15, 2))]
        tracked = feed(Tracker(), (path + rng.normal(size=path.shape) * [0.15, 0.15, 0.07])[:, None])[-1]
        seen.append((tracked.velocity[0, 0] - speed[-1]) / tracked.speed_sigma[0])
    assert 0.6 < np.mean(np.square(seen)) < 1.5


def test_a_turning_car_is_followed():
    time = np.arange(60) * 0.1
    yaw = 0.5 * time
    path = np.stack([14 * np.sin(yaw), 14 * (1 - np.cos(yaw)), yaw], 1)
    noisy = path + np.random.default_rng(6).normal(size=path.shape) * [0.15, 0.15, 0.07]
    tracked = feed(Tracker(), noisy[:, None])[20:]
    error = np.array([box_states(t.boxes)[0, [0, 1, 6]] for t in tracked]) - path[20:]
    assert np.hypot(error[:, 0], error[:, 1]).mean() < 0.15
    assert np.abs(wrap_angle(error[:, 2])).mean() < 0.05


def test_moving_the_world_moves_the_tracks_with_it():
    rng, angle, shift = np.random.default_rng(7), 2.2, np.array([400.0, -90.0])
    rows = drive(8.0, 15, 0.2)[:, None] + np.array([0, 8.0, 0]) * np.arange(3)[:, None] + rng.normal(size=(15, 3, 3)) * 0.05
    moved = rows.copy()
    moved[..., :2] = rows[..., :2] @ rotation_z(angle)[:2, :2].T + shift
    moved[..., 2] += angle
    here, there = feed(Tracker(), rows)[-1], feed(Tracker(), moved)[-1]
    assert here.track_id == there.track_id
    R = rotation_z(angle)
    np.testing.assert_allclose(there.boxes.center[:, :2], here.boxes.center[:, :2] @ R[:2, :2].T + shift, atol=1e-6)
    np.testing.assert_allclose(there.velocity, here.velocity @ R.T, atol=1e-6)
    np.testing.assert_allclose(wrap_angle(there.boxes.yaw - here.boxes.yaw - angle), 0.0, atol=1e-6)


def test_the_order_of_the_boxes_does_not_matter():
    rng = np.random.default_rng(8)
    rows = drive(8.0, 10, 0.2)[:, None] + np.array([0, 8.0, 0]) * np.arange(4)[:, None]
    one, other = Tracker(), Tracker()
    for step in range(10):
        order = rng.permutation(4)
        a = one.update(fused(rows[step]), START_NS + step * STEP_NS)
        b = other.update(fused(rows[step][order]), START_NS + step * STEP_NS)
        np.testing.assert_allclose(box_states(b.boxes), box_states(a.boxes.take(order)), atol=1e-9)
        names = {(x, y) for x, y in zip(np.array(a.track_id)[order], b.track_id, strict=True)}
        if step == 0:
            first = names
        assert names == first
