import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import Polygon

from service.geometry.iou import clip_convex_pairs, iou_2d, iou_3d, iou_bev, rectangle_corners

state = st.tuples(
    *[st.floats(-4, 4)] * 2, st.floats(-2, 2), st.floats(0.3, 8), st.floats(0.3, 4), st.floats(0.3, 4), st.floats(-3.2, 3.2)
)
states = st.lists(state, min_size=1, max_size=4).map(np.array)


def shifted(boxes, x=0.0, y=0.0, z=0.0, yaw=0.0):
    return boxes + np.array([x, y, z, 0.0, 0.0, 0.0, yaw])


def random_states(rng, count):
    low, high = [-3, -3, -1, 0.5, 0.5, 0.5, -np.pi], [3, 3, 1, 6, 3, 3, np.pi]
    return rng.uniform(low, high, (count, 7))


@given(states, states)
@settings(max_examples=60)
def test_iou_is_symmetric_and_a_share(a, b):
    for iou in (iou_bev, iou_3d):
        np.testing.assert_allclose(iou(a, b), iou(b, a).T, atol=1e-9)
        assert np.all((iou(a, b) >= 0) & (iou(a, b) <= 1 + 1e-9))


@given(states)
@settings(max_examples=60)
def test_a_box_has_iou_one_with_itself_and_with_itself_turned_around(a):
    turned = shifted(a, yaw=np.pi)
    for iou in (iou_bev, iou_3d):
        np.testing.assert_allclose(np.diag(iou(a, a)), 1.0, atol=1e-9)
        np.testing.assert_allclose(np.diag(iou(a, turned)), 1.0, atol=1e-9)


def test_bev_iou_agrees_with_shapely():
    rng = np.random.default_rng(0)
    a, b = random_states(rng, 40), random_states(rng, 40)
    polygons = [[Polygon(c) for c in rectangle_corners(s[:, :2], s[:, 3:5], s[:, 6])] for s in (a, b)]
    expected = [[p.intersection(q).area / p.union(q).area for q in polygons[1]] for p in polygons[0]]
    np.testing.assert_allclose(iou_bev(a, b), expected, atol=1e-9)


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, 0.3])
def test_shared_edges_and_nesting_are_exact(yaw):
    outer = np.array([[0.0, 0.0, 0.0, 4.0, 2.0, 2.0, yaw]])
    inner = np.array([[0.0, 0.0, 0.0, 2.0, 1.0, 1.0, yaw]])
    beside = shifted(outer, x=4 * np.cos(yaw), y=4 * np.sin(yaw))
    np.testing.assert_allclose(iou_bev(outer, inner), 0.25)
    np.testing.assert_allclose(iou_3d(outer, inner), 0.125)
    np.testing.assert_allclose(iou_bev(outer, beside), 0.0, atol=1e-12)


def test_two_parallel_cars_tolerate_little_offset_at_iou_07():
    """A 4.5 m car stays above 0.7 up to (1 - 0.7) / (1 + 0.7) of its length along it."""
    car = np.array([[0.0, 0.0, 0.0, 4.5, 1.8, 1.5, 0.0]])
    limit = 4.5 * 0.3 / 1.7
    assert iou_3d(car, shifted(car, x=limit - 0.01))[0, 0] > 0.7
    assert iou_3d(car, shifted(car, x=limit + 0.01))[0, 0] < 0.7


@given(states, states, st.floats(-3, 3), st.floats(-50, 50), st.floats(-50, 50))
@settings(max_examples=60)
def test_iou_does_not_care_where_the_world_begins(a, b, angle, dx, dy):
    c, s = np.cos(angle), np.sin(angle)

    def moved(boxes):
        out = boxes.copy()
        out[:, :2] = boxes[:, :2] @ np.array([[c, s], [-s, c]]) + [dx, dy]
        out[:, 6] += angle
        return out

    np.testing.assert_allclose(iou_3d(moved(a), moved(b)), iou_3d(a, b), atol=1e-7)


def test_boxes_above_each_other_share_the_plan_but_no_volume():
    low = np.array([[0.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.2]])
    high = shifted(low, z=2.0)
    np.testing.assert_allclose(iou_bev(low, high), 1.0)
    assert iou_3d(low, high)[0, 0] == 0


def test_degenerate_boxes_have_iou_zero():
    point = np.zeros((1, 7))
    assert iou_bev(point, point)[0, 0] == 0
    assert iou_3d(point, point)[0, 0] == 0


def test_octagon_of_two_crossed_squares():
    square = rectangle_corners(np.zeros((1, 2)), [[2.0, 2.0]], [0.0])
    turned = rectangle_corners(np.zeros((1, 2)), [[2.0, 2.0]], [np.pi / 4])
    np.testing.assert_allclose(clip_convex_pairs(square, turned), 8 * (np.sqrt(2) - 1))


def test_iou_2d_known_answers():
    a = [[0.0, 0.0, 2.0, 2.0], [5.0, 5.0, 6.0, 6.0]]
    np.testing.assert_allclose(iou_2d(a, [[1.0, 1.0, 3.0, 3.0]]), [[1 / 7], [0.0]])


def test_empty():
    none, one = np.zeros((0, 7)), np.ones((1, 7))
    for iou in (iou_bev, iou_3d):
        assert iou(none, one).shape == (0, 1)
        assert iou(one, none).shape == (1, 0)
    assert iou_2d(np.zeros((0, 4)), np.zeros((3, 4))).shape == (0, 3)
