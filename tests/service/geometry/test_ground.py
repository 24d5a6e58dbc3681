import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import InputError
from service.geometry.ground import GroundGrid, GroundPlane, fit_grid, fit_plane

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


def hilly(xy):
    return 0.02 * xy[..., 0] + 0.5 * np.sin(xy[..., 0] / 15) * np.cos(xy[..., 1] / 20) - 1.0


def grid(cell=2.0):
    axis = np.arange(-60, 61, cell)
    x, y = np.meshgrid(axis, axis)
    return GroundGrid(np.array([-60.0, -60.0]), cell, hilly(np.stack([x, y], -1)))


def test_a_grid_interpolates_and_goes_on_flat_beyond_its_border():
    ground = grid()
    xy = np.random.default_rng(0).uniform(-60, 60, (200, 2))
    np.testing.assert_allclose(ground.height_at(xy), hilly(xy), atol=0.02)
    assert ground.height_at([-60.0, -60.0]) == ground.heights[0, 0]
    assert ground.height_at([100.0, 60.0]) == ground.heights[-1, -1]
    np.testing.assert_allclose(ground.normal_at([500.0, 500.0]), [0, 0, 1])


def test_the_normal_is_that_of_the_surface_and_the_tangent_touches_it():
    ground = grid()
    xy = np.random.default_rng(1).uniform(-59, 59, (300, 2))
    step = 1e-5
    slopes = [(ground.height_at(xy + e) - ground.height_at(xy - e)) / (2 * step) for e in step * np.eye(2)]
    normal = ground.normal_at(xy)
    np.testing.assert_allclose(-normal[:, :2] / normal[:, 2:], np.stack(slopes, -1), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0)
    tangent, offset = ground.tangent_at(xy)
    np.testing.assert_allclose(tangent, normal)
    np.testing.assert_allclose((np.c_[xy, ground.height_at(xy)] * tangent).sum(1), offset)


def test_rays_meet_a_grid_where_they_were_aimed_at():
    ground = grid()
    xy = np.random.default_rng(2).uniform(-40, 40, (300, 2))
    target = np.c_[xy, ground.height_at(xy)]
    origin = np.array([0.0, 0.0, 8.0])
    met = ground.intersect(origin, target - origin)
    # Behind a rise a flat ray meets the road before the place it was aimed at; none may hang above or below the road.
    assert np.isfinite(met).all()
    np.testing.assert_allclose(met[:, 2], ground.height_at(met), atol=0.02)
    assert np.mean(np.linalg.norm(met - target, axis=1) < 0.1) > 0.98
    assert np.isnan(ground.intersect(origin, [[0.0, 0.0, 1.0], [1.0, 0.0, 0.3]])).all()


def test_a_flat_grid_is_a_plane():
    flat, plane = GroundGrid(np.zeros(2), 5.0, np.full((3, 4), 1.5)), GroundPlane(offset=1.5)
    origins = np.array([[0.0, 0.0, 6.0], [3.0, -2.0, 9.0]])
    rays = np.array([[1.0, 0.2, -0.1], [-0.4, 1.0, -2.0]])
    np.testing.assert_allclose(flat.intersect(origins, rays), plane.intersect(origins, rays))


def test_a_plane_is_fitted_from_bottoms_some_of_which_are_wrong():
    rng = np.random.default_rng(3)
    xy = rng.uniform(-50, 50, (400, 2))
    bottoms = np.c_[xy, TILTED.height_at(xy) + 0.05 * rng.normal(size=400)]
    bottoms[:40, 2] += 3.0
    fitted = fit_plane(bottoms)
    np.testing.assert_allclose(fitted.height_at(xy), TILTED.height_at(xy), atol=0.1)
    assert np.linalg.norm(fitted.normal) == pytest.approx(1.0)


def test_a_grid_is_fitted_from_bottoms_and_goes_on_where_there_are_none():
    rng = np.random.default_rng(4)
    xy = rng.uniform(-50, 50, (3000, 2))
    xy = xy[np.abs(xy[:, 0]) > 4]
    fitted = fit_grid(np.c_[xy, hilly(xy) + 0.05 * rng.normal(size=len(xy))])
    inside = rng.uniform(-45, 45, (500, 2))
    assert np.abs(fitted.height_at(inside) - hilly(inside)).max() < 0.1
    flat = fit_grid(np.c_[xy, TILTED.height_at(xy)])
    np.testing.assert_allclose(flat.height_at(inside), TILTED.height_at(inside), atol=1e-3)


@pytest.mark.parametrize("bottoms", [np.zeros((2, 3)), np.full((5, 3), np.nan)])
def test_too_little_to_fit_is_refused(bottoms):
    for fit in (fit_plane, fit_grid):
        with pytest.raises(InputError):
            fit(bottoms)


def test_a_grid_as_large_as_a_country_is_refused():
    with pytest.raises(InputError, match="heights"):
        fit_grid([[0.0, 0.0, 0.0], [1e5, 0.0, 0.0], [0.0, 1e5, 0.0]], cell_m=1.0)
