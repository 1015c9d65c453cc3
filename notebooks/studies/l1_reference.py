"""Other solvers with which notebook 04 and the tests compare ours: Eq. (6) as printed, by cvxpy; and least squares."""

from __future__ import annotations

import cvxpy as cp
import numpy as np
from scipy.linalg.lapack import dpbtrs

from lib.surface.solver import UNHELD, L1Problem, L1Solution, cholesky


def cvxpy_reference(
    problem: L1Problem,
    x: np.ndarray,
    mu: float | np.ndarray,
    weights: np.ndarray | None = None,
    *,
    tolerance: float = 1e-9,
    solver: str = "CLARABEL",
) -> tuple[L1Solution, float]:
    """Minimum of sum_i w_i |b_i.c - x_i| + mu c.R.c for each output, and the solver's seconds without model set-up.

    Arguments as for `lib.surface.solver.interior_point`; `solver` is "CLARABEL" or "OSQP".  `duality_gap` is NaN, because
    the solver has its own stopping rule.
    """
    n, k = x.shape
    w = np.ones((n, k)) if weights is None else weights
    mu = np.broadcast_to(mu, k)
    centre = np.average(x, axis=0, weights=w[:, 0])
    unit = np.maximum(np.abs(x - centre).max(axis=0), np.finfo(float).tiny)
    coefficients, dual = np.empty((problem.grid.size, k)), np.empty((n, k))
    seconds = 0.0
    settings = {
        "CLARABEL": {"tol_gap_rel": tolerance, "tol_gap_abs": tolerance, "tol_feas": min(1e-8, tolerance)},
        "OSQP": {"eps_abs": tolerance, "eps_rel": tolerance, "max_iter": 100_000},
    }[solver]
    for j in range(k):
        c, residual = cp.Variable(problem.grid.size), cp.Variable(n)
        split = residual == problem.design @ c - (x[:, j] - centre[j]) / unit[j]
        energy = cp.quad_form(c, mu[j] * unit[j] * problem.bending, assume_PSD=True)
        model = cp.Problem(cp.Minimize(w[:, j] @ cp.abs(residual) + energy), [split])
        model.solve(solver=solver, **settings)
        if c.value is None:
            raise ValueError(f"smoothness: {solver} found no solution ({model.status}); increase it.")
        coefficients[:, j], dual[:, j] = c.value * unit[j] + centre[j], split.dual_value
        seconds += model.solver_stats.solve_time or 0.0
    fitted = problem.design @ coefficients - x
    objective = (w * np.abs(fitted)).sum(axis=0) + mu * (coefficients * (problem.bending @ coefficients)).sum(axis=0)
    return L1Solution(coefficients, objective, np.full(k, np.nan), dual), seconds


def least_squares(problem: L1Problem, x: np.ndarray, mu: float | np.ndarray, w: np.ndarray) -> L1Solution:
    """The baseline for the L1 norm: the minimum of sum_i (w_i (b_i.c - x_i))^2 + mu c.R.c, in closed form.

    `dual` is the gradient of the data term.
    """
    k = x.shape[1]
    coefficients = np.empty((problem.grid.size, k))
    for j, mu_j in enumerate(np.broadcast_to(mu, k)):
        factor = cholesky(problem.normal_band(w[:, j] ** 2, mu_j))
        if factor is None:
            raise ValueError(UNHELD)
        coefficients[:, j] = dpbtrs(factor, problem.design.T @ (w[:, j] ** 2 * x[:, j]), lower=1)[0]
    residual = problem.design @ coefficients - x
    energy = (coefficients * (problem.bending @ coefficients)).sum(axis=0)
    objective = ((w * residual) ** 2).sum(axis=0) + mu * energy
    return L1Solution(coefficients, objective, np.zeros(k), 2 * w**2 * residual)
