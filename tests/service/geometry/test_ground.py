import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.ground import GroundPlane

TILTED = GroundPlane(np.array([0.06, -0.08, np.sqrt(1 - 0.01)]), 1.5)


@given(st.floats(-100, 100), st.floats(-100, 100))
def test_points_at_the_ground_height_lie_on_the_plane(x, y):
    z = TILTED.height_at([x, y])
    np.testing.assert_allclose(np.dot(TILTED.normal, [x, y, z]), TILTED.offset, atol=1e-9)


@given(st.floats(-100, 100), st.floats(-100, 100))
def test_a_ray_towards_a_ground_point_meets_the_ground_there(x, y):
    target = np.array([x, y, TILTED.height_at([x, y])])
    origin = np.array([0.0, 0.0, 30.0])
    np.testing.assert_allclose(TILTED.intersect(origin, 0.3 * (target - origin)), target, atol=1e-7)


def test_rays_along_or_away_from_the_ground_meet_nothing():
    points = GroundPlane().intersect([0.0, 0.0, 5.0], [[1.0, 0.0, 0.0], [1.0, 0.0, 0.1], [1.0, 0.0, -0.5]])
    assert np.isnan(points[:2]).all()
    np.testing.assert_allclose(points[2], [10.0, 0.0, 0.0])


def test_empty():
    assert GroundPlane().intersect([0.0, 0.0, 5.0], np.zeros((0, 3))).shape == (0, 3)
    assert GroundPlane().height_at(np.zeros((0, 2))).shape == (0,)
