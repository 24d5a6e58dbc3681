import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.boxes import CORNER_SIGNS, Boxes, box_corners, box_states, clip_extents, project_extents
from service.geometry.camera import Camera
from service.geometry.transforms import pole_camera_pose

CAMERA = Camera(
    "c",
    1284,
    384,
    np.array([[642.0, 0.0, 641.5], [0.0, 642.0, 191.5], [0.0, 0.0, 1.0]]),
    pole_camera_pose([0.0, 0.0, 5.0], 0.0, np.deg2rad(10)),
)


def some_boxes(count):
    rng = np.random.default_rng(3)
    return Boxes(
        center=rng.normal(size=(count, 3)),
        dims_lwh=rng.uniform(1, 5, (count, 3)),
        yaw=rng.uniform(-np.pi, np.pi, count),
        score=rng.uniform(size=count),
        cls=np.arange(count, dtype=np.int64),
        covariance=np.tile(np.eye(7), (count, 1, 1)),
        flip_log_odds=rng.normal(size=count),
    )


@given(st.tuples(*[st.floats(-50, 50)] * 3), st.tuples(*[st.floats(0.1, 20)] * 3), st.floats(-4, 4))
def test_corners_keep_centre_and_size(center, dims, yaw):
    corners = box_corners(center, dims, yaw)
    np.testing.assert_allclose(corners.mean(0), center, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(corners[0] - corners[1]), dims[0], rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(corners[1] - corners[2]), dims[1], rtol=1e-9)
    np.testing.assert_allclose(corners[4:, 2] - corners[:4, 2], dims[2], rtol=1e-9)


def test_length_runs_along_the_heading():
    corners = box_corners([0.0, 0.0, 0.0], [4.0, 2.0, 1.0], np.pi / 2)
    front = corners[CORNER_SIGNS[:, 0] > 0]
    np.testing.assert_allclose(front[:, 1], 2.0)
    np.testing.assert_allclose(sorted(front[:, 0]), [-1, -1, 1, 1])


def test_bottom_corners_go_counter_clockwise():
    x, y = box_corners([0.0, 0.0, 0.0], [4.0, 2.0, 1.0], 0.4)[:4, :2].T
    assert np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2 > 0


def test_take_and_concatenate_undo_each_other():
    boxes = some_boxes(5)
    again = Boxes.concatenate([boxes.take(np.arange(2)), boxes.take(np.arange(2, 5)), Boxes.empty()])
    np.testing.assert_array_equal(box_states(again), box_states(boxes))
    np.testing.assert_array_equal(again.cls, boxes.cls)
    assert len(boxes.take(boxes.score > 2)) == 0


def test_empty():
    assert len(Boxes.concatenate([])) == 0
    assert box_states(Boxes.empty()).shape == (0, 7)
    assert box_corners(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)).shape == (0, 8, 3)
    extents, in_front = project_extents(CAMERA, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    assert extents.shape == (0, 4)
    assert in_front.shape == (0,)


def test_extents_hold_the_centre_and_know_what_is_behind():
    centers = np.array([[20.0, 1.0, 0.8], [-20.0, 0.0, 0.8], [1.0, 0.0, 4.0]])
    extents, in_front = project_extents(CAMERA, centers, np.tile([4.0, 2.0, 1.6], (3, 1)), np.zeros(3))
    assert in_front.tolist() == [True, False, False]
    u, v = CAMERA.project(centers[0])[0]
    assert extents[0, 0] < u < extents[0, 2]
    assert extents[0, 1] < v < extents[0, 3]


def test_clipping_to_the_image():
    np.testing.assert_array_equal(clip_extents(CAMERA, [[-5.0, 3.0, 2000.0, 500.0]]), [[0.0, 3.0, 1283.0, 383.0]])
