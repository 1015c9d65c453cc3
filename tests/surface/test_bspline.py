"""The spline itself: basis, bending energy, evaluation, geometry of the surface."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lib.cameras import AffineCamera
from lib.surface import BSplineSurface, SplineGrid
from lib.surface.grid import cubic_basis

DOMAIN = (10.0, -5.0, 410.0, 295.0)


def bending_energy(surface: BSplineSurface) -> float:
    """Integral of |d^2 Psi / du^2|^2 over the domain in mm^2 / px^2, the regulariser of paper Eq. (6)."""
    coefficients = surface.grid.flatten(surface.control_points_mm)
    return float(np.sum(coefficients * (surface.grid.bending @ coefficients)))


def random_surface(control: tuple[int, int], seed: int = 0) -> BSplineSurface:
    control_points = np.random.default_rng(seed).normal(size=(control[1], control[0], 3))
    return BSplineSurface(SplineGrid(DOMAIN, control), control_points)


def graph_surface(function, control: tuple[int, int] = (24, 24)) -> BSplineSurface:
    """A spline close to (x, y, f(x, y)), x and y in mm at 0.01 mm a pixel, seen along +z."""
    grid = SplineGrid((-100.0, -100.0, 100.0, 100.0), control)
    u = np.stack(np.meshgrid(np.linspace(-100, 100, 60), np.linspace(-100, 100, 60)), axis=-1).reshape(-1, 2)
    x, y = (u / 100).T
    values = np.column_stack([x, y, function(x, y)])
    B = grid.design(u).toarray()
    coefficients = np.linalg.solve(B.T @ B + 1e-12 * np.eye(grid.size), B.T @ values)
    return BSplineSurface(grid, grid.unflatten(coefficients))


@given(st.floats(0, 1))
def test_basis_is_a_partition_of_unity_with_right_derivatives(t):
    t = np.array([t])
    assert cubic_basis(t).sum() == pytest.approx(1)
    assert cubic_basis(t, 1).sum() == pytest.approx(0, abs=1e-12)
    assert (cubic_basis(t) >= 0).all()
    step = 1e-5
    np.testing.assert_allclose(
        (cubic_basis(t + step) - cubic_basis(t - step)) / (2 * step), cubic_basis(t, 1), atol=1e-8
    )
    np.testing.assert_allclose(
        (cubic_basis(t + step, 1) - cubic_basis(t - step, 1)) / (2 * step), cubic_basis(t, 2), atol=1e-8
    )


@settings(max_examples=15, deadline=None)
@given(st.integers(4, 12), st.integers(4, 12), st.integers(0, 2**31))
def test_bending_energy_is_the_integral_by_quadrature(n_x, n_y, seed):
    surface = random_surface((n_x, n_y), seed)
    nodes, weights = np.polynomial.legendre.leggauss(4)  # exact for the degree of the integrand
    (x0, y0, _, _), cell = DOMAIN, surface.grid.cell_px
    x, y = (
        (low + (np.arange(n - 3)[:, None] + (nodes + 1) / 2) * width).ravel()
        for low, n, width in ((x0, n_x, cell[0]), (y0, n_y, cell[1]))
    )
    weight = np.outer(np.tile(weights / 2 * cell[1], n_y - 3), np.tile(weights / 2 * cell[0], n_x - 3)).ravel()
    u = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    second = {order: surface.derivative(u, order) for order in ((2, 0), (1, 1), (0, 2))}
    integrand = (second[2, 0] ** 2 + 2 * second[1, 1] ** 2 + second[0, 2] ** 2).sum(axis=1)
    assert bending_energy(surface) == pytest.approx(weight @ integrand, rel=1e-10)


@pytest.mark.parametrize("control", [(4, 4), (7, 12), (12, 7)])
def test_null_space_of_the_bending_is_the_planes(control):
    grid = SplineGrid(DOMAIN, control)
    eigenvalues = np.linalg.eigvalsh(grid.bending.toarray())
    assert (eigenvalues < 1e-10 * eigenvalues[-1]).sum() == 3


@pytest.mark.parametrize("control", [(6, 11), (11, 6)])
def test_linear_functions_are_reproduced(control):
    grid = SplineGrid(DOMAIN, control)
    linear = np.array([[0.3, -0.2, 1.0], [0.1, 0.5, -2.0]])
    surface = BSplineSurface(grid, grid.sites @ linear + [1.0, 2.0, 3.0])
    u = np.random.default_rng(0).uniform(DOMAIN[:2], DOMAIN[2:], (50, 2))
    np.testing.assert_allclose(surface(u), u @ linear + [1.0, 2.0, 3.0], atol=1e-10)
    assert abs(bending_energy(surface)) < 1e-15 * np.sum(surface.control_points_mm**2)
    np.testing.assert_array_equal(grid.unflatten(grid.flatten(surface.control_points_mm)), surface.control_points_mm)


def test_lattice_evaluation_agrees_with_points_and_outside_is_nan():
    surface = random_surface((9, 7))
    x, y = np.linspace(0, 420, 30), np.linspace(-20, 310, 25)
    u = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(surface.on_grid(x, y).reshape(-1, 3), surface(u), atol=1e-12)
    assert np.isnan(surface([[0.0, 0.0], [np.nan, 50.0]])).all()
    assert np.isfinite(surface([DOMAIN[:2], DOMAIN[2:]])).all()


def test_the_normal_of_a_sphere_points_to_its_centre():
    radius = 8.0
    bowl = graph_surface(lambda x, y: np.sqrt(radius**2 - x**2 - y**2))  # hollow towards a camera that looks along +z
    u = np.random.default_rng(1).uniform(-80, 80, (40, 2))
    np.testing.assert_allclose(bowl.normal(u), -bowl(u) / radius, atol=1e-5)


def test_distance_of_a_tool_along_view_and_normal():
    radius, camera = 8.0, AffineCamera([[100.0, 0, 0, 0], [0, 100.0, 0, 0]])
    bowl = graph_surface(lambda x, y: np.sqrt(radius**2 - x**2 - y**2))
    rng = np.random.default_rng(2)
    on_surface = bowl(rng.uniform(-50, 50, (30, 2)))
    height = rng.uniform(-1, 2, 30)
    tip = on_surface * (1 - height / radius)[:, None]  # towards the centre by `height`
    distance = bowl.distance(tip, camera)
    np.testing.assert_allclose(distance.along_normal_mm, height, atol=1e-4)
    np.testing.assert_allclose(distance.nearest_mm, on_surface, atol=1e-4)
    expected = np.sqrt(radius**2 - tip[:, 0] ** 2 - tip[:, 1] ** 2) - tip[:, 2]
    np.testing.assert_allclose(distance.along_view_mm, expected, atol=1e-4)
    lost = bowl.distance([[5.0, 0, 0], [np.nan, 0, 0]], camera)  # outside the image, and missing
    assert np.isnan(lost.along_view_mm).all() and np.isnan(lost.along_normal_mm).all()


def test_the_nearest_point_lies_in_the_right_valley_or_beyond_the_border():
    wavy = graph_surface(lambda x, y: 0.15 * np.sin(9 * x) + 0.4 * y)
    x = np.random.default_rng(3).uniform([-0.9, -0.9, -1.0], [0.9, 0.9, 0.5], (60, 3))
    found = wavy.distance(x, AffineCamera([[100.0, 0, 0, 0], [0, 100.0, 0, 0]]))
    lattice = np.linspace(-100, 100, 401)
    points = wavy.on_grid(lattice, lattice).reshape(-1, 3)
    nearest = np.array([np.linalg.norm(points - tip, axis=1).min() for tip in x])
    named = np.isfinite(found.along_normal_mm)
    assert 0.5 < named.mean() < 1.0  # where the tool is beyond the tilted surface's border there is none to name
    np.testing.assert_allclose(np.abs(found.along_normal_mm[named]), nearest[named], atol=2e-3)
    assert np.isfinite(found.along_view_mm).all()


def test_a_lattice_reaches_the_domains_own_corners():
    for x0, y0, x1, y1 in np.random.default_rng(0).uniform([0, 0, 600, 600], [500, 500, 1900, 1900], (100, 4)):
        surface = BSplineSurface(SplineGrid((x0, y0, x1, y1), (16, 12)), np.ones((12, 16, 3)))
        assert np.isfinite(surface.on_grid([x0, x1], [y0, y1])).all()
        assert np.isnan(surface.on_grid([x0 - 0.1], [y0])).all()


@pytest.mark.parametrize(
    ("domain", "control", "named"),
    [
        ((0, 0, 0, 10), (8, 8), "domain"),
        ((0, 0, np.nan, 10), (8, 8), "domain"),
        ((0, 0, 10), (8, 8), "domain"),
        ((0, 0, 10, 10), (3, 8), "control"),
        ((0, 0, 10, 10), (8.5, 8), "control"),
    ],
)
def test_bad_grids_are_named(domain, control, named):
    with pytest.raises(ValueError, match=f"^{named}:"):
        SplineGrid(domain, control)


def test_control_points_are_checked():
    grid = SplineGrid(DOMAIN, (8, 6))
    with pytest.raises(ValueError, match="control_points_mm"):
        BSplineSurface(grid, np.zeros((8, 6, 3)))
    with pytest.raises(ValueError, match="not fitted"):
        BSplineSurface(grid, np.zeros((6, 8, 3))).covariance([[20.0, 20.0]])
