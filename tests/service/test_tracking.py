import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.fusion import FusedBoxes
from service.geometry.boxes import Boxes, box_states
from service.geometry.transforms import wrap_angle
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


def test_a_track_coasts_over_a_gap_and_is_lost_after_a_second():
    path = drive(10, 50)
    tracker = Tracker()
    feed(tracker, path[:10, None])
    assert tracker.update(fused([]), START_NS + 12 * STEP_NS).track_id == []
    assert tracker.update(fused(path[17:18]), START_NS + 17 * STEP_NS).track_id == ["1"]
    assert tracker.update(fused(path[29:30]), START_NS + 29 * STEP_NS).track_id == ["2"]


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
