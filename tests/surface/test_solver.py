"""The L1 solver: its optimum against CLARABEL, its certificate, its limits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lib.surface import SplineGrid
from lib.surface.solver import L1Problem, interior_point

DOMAIN = (0.0, 0.0, 640.0, 480.0)


def noisy_points(n: int, seed: int = 0, outliers: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    u = rng.uniform(DOMAIN[:2], DOMAIN[2:], (n, 2))
    x, y = ((u - (320, 240)) / 100).T
    values = np.column_stack([x, 12 - np.sqrt(144 - x**2 - y**2) + 0.1 * np.sin(2 * x) * np.cos(y)])
    values += rng.normal(size=values.shape) * (0.01, 0.08)
    wild = rng.random(n) < outliers
    values[wild] += rng.uniform(-2, 2, (wild.sum(), 2))
    return u, values


@pytest.mark.parametrize("control", [(20, 20), (9, 14)])
@pytest.mark.parametrize("n", [150, 2000])
def test_reaches_the_minimum_of_clarabel(control, n):
    from notebooks.studies.l1_reference import cvxpy_reference  # cvxpy takes a second to import

    u, x = noisy_points(n)
    problem = L1Problem(SplineGrid(DOMAIN, control), u)
    weights = np.random.default_rng(1).uniform(0.2, 2.0, x.shape)
    ours = interior_point(problem, x, 5.0 * n, weights)
    reference, _ = cvxpy_reference(problem, x, 5.0 * n, weights)
    np.testing.assert_allclose(ours.objective, reference.objective, rtol=1e-7)
    assert ours.objective.sum() <= reference.objective.sum() * (1 + 1e-8)


@settings(max_examples=25, deadline=None)
@given(st.integers(100, 400), st.floats(2, 8), st.integers(0, 2**31))
def test_the_certificate_holds_without_the_solver(n, log_mu, seed):
    """Weak duality, recomputed densely: every dual point bounds the minimum from below."""
    u, x = noisy_points(n, seed)
    problem, mu = L1Problem(SplineGrid(DOMAIN, (8, 7)), u), 10.0**log_mu
    found = interior_point(problem, x, mu)
    B, R = problem.design.toarray(), problem.bending.toarray()
    primal = np.abs(B @ found.coefficients - x).sum(axis=0) + mu * np.sum(
        found.coefficients * (R @ found.coefficients), axis=0
    )
    np.testing.assert_allclose(found.objective, primal, rtol=1e-9)
    assert np.abs(found.dual).max() <= 1
    # Stationarity B'y + 2 mu R c = 0 makes the dual value -y.x - mu c.R.c.
    stationarity = B.T @ found.dual + 2 * mu * R @ found.coefficients
    assert np.abs(stationarity).max() < 1e-5
    dual = -(found.dual * x).sum(axis=0) - mu * np.sum(found.coefficients * (R @ found.coefficients), axis=0)
    rounding = 1e-8 * np.abs(x).sum(axis=0)  # few points are met exactly, and then the minimum is all but zero
    assert (primal - dual <= 1e-6 * primal + rounding).all()
    assert (found.duality_gap <= 1e-5 * primal + rounding).all()


def test_no_step_downhill_is_left():
    u, x = noisy_points(500)
    problem, mu = L1Problem(SplineGrid(DOMAIN, (10, 10)), u), 1e4
    found = interior_point(problem, x[:, 1:], mu)
    rng = np.random.default_rng(0)
    for size in (1e-1, 1e-3, 1e-5):
        moved = found.coefficients + size * rng.normal(size=(100, 200))
        value = np.abs(problem.design @ moved - x[:, 1:]).sum(axis=0) + mu * np.sum(
            moved * (problem.bending @ moved), axis=0
        )
        assert value.min() >= found.objective[0] * (1 - 1e-8)


def test_the_banded_normal_matrix_is_the_dense_one():
    u, _ = noisy_points(300)
    u = np.vstack([u, u[:40] * 0.01])  # one crowded cell among sparse ones
    grid = SplineGrid(DOMAIN, (11, 7))
    problem = L1Problem(grid, u)
    weights = np.random.default_rng(0).uniform(size=len(u))
    B = problem.design.toarray()
    dense = (B.T * weights) @ B + 3e3 * grid.bending.toarray()
    band = problem.normal_band(weights, 3e3)
    for diagonal in range(grid.bandwidth + 1):
        np.testing.assert_allclose(band[diagonal, : grid.size - diagonal], np.diag(dense, -diagonal), atol=1e-12)
    assert np.count_nonzero(np.tril(dense, -grid.bandwidth - 1)) == 0


def test_one_point_per_equation_is_met_exactly_and_planes_cost_nothing():
    u, _ = noisy_points(400)
    plane = (u @ [0.002, -0.001] + 3.0)[:, None]
    found = interior_point(L1Problem(SplineGrid(DOMAIN, (12, 12)), u), plane, 1e5)
    assert found.objective[0] < 1e-6
    u_new = np.array([[5.0, 470.0], [300.0, 200.0]])
    fitted = SplineGrid(DOMAIN, (12, 12)).design(u_new) @ found.coefficients
    np.testing.assert_allclose(fitted[:, 0], u_new @ [0.002, -0.001] + 3.0, atol=1e-6)


def test_control_points_without_data_need_smoothness():
    u, x = noisy_points(400)
    u[:, 0] *= 0.3  # the right of the domain is empty
    problem = L1Problem(SplineGrid(DOMAIN, (12, 12)), u)
    with pytest.raises(ValueError, match="smoothness"):
        interior_point(problem, x, 0.0)
    assert np.isfinite(interior_point(problem, x, 1.0).coefficients).all()
