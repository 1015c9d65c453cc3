"""L1 splines: min_c sum_i w_i |b_i.c - x_i| + mu c.R.c, the problem of paper Eq. (6), one output at a time.

Eq. (6) decouples over x, y and z, and each output is a quadratic programme whose Newton matrix B'DB + 2 mu R has the
narrow band of the spline's own grid.  `interior_point` walks to its exact minimum in a dozen banded factorisations
and returns the duality gap as proof; `cvxpy_reference` solves the same with CLARABEL, to compare.
"""

from __future__ import annotations

import itertools
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy import sparse
from scipy.linalg import cho_solve_banded, cholesky_banded
from threadpoolctl import ThreadpoolController

from lib.surface.bspline import SplineGrid, cubic_basis

__all__ = ["L1Problem", "L1Solution", "cvxpy_reference", "interior_point", "least_squares"]

_UNHELD = (
    "smoothness: too small to hold the control points that have no data near them; increase it, or use fewer control "
    "points."
)
_PAIRS = [(i, j) for i in range(4) for j in range(i, 4)]


class L1Problem:
    """Points on a spline grid, with everything of the Newton matrix that does not change between iterations.

    Parameters
    ----------
    grid:
        Where the coefficients lie.
    u:
        (n, 2) px, all inside the domain.
    """

    def __init__(self, grid: SplineGrid, u: np.ndarray) -> None:
        self.grid, self.u = grid, u

    @cached_property
    def design(self) -> sparse.csr_matrix:
        """B (n, size)."""
        return self.grid.design(self.u)

    @cached_property
    def design_T(self) -> sparse.csr_matrix:
        """B', stored by rows too: products with it then run through the points in order."""
        return self.design.T.tocsr()

    @property
    def bending(self) -> sparse.csr_matrix:
        """R (size, size)."""
        return self.grid.bending

    @cached_property
    def bending_band(self) -> np.ndarray:
        """R as a lower band (bandwidth + 1, size)."""
        entries = sparse.tril(self.bending).tocoo()
        band = np.zeros((self.grid.bandwidth + 1, self.grid.size))
        band[entries.row - entries.col, entries.col] = entries.data
        return band

    @cached_property
    def by_cells(self) -> tuple[np.ndarray, L1Problem]:
        """Order (n,) of the points by cells, and the problem in that order: neighbours in space are so in memory."""
        order = np.argsort(self.grid.locate(self.u)[0] @ self.grid.stride, kind="stable")
        return order, L1Problem(self.grid, self.u[order])

    def gram_band(self, weights: np.ndarray) -> np.ndarray:
        """B' diag(weights) B for weights (n,), as a lower band (bandwidth + 1, size).

        A cell's 16 x 16 block is a sum over its points of products of basis functions that separate in x and y, so it
        is one small matrix product of the 10 distinct products along x with the 10 along y.
        """
        slot, (along_x, along_y), layers, scatter = self._blocks
        n_blocks, _, size = along_x.shape
        packed = np.zeros(n_blocks * size)
        packed[slot] = weights
        blocks = np.matmul(along_y * packed.reshape(n_blocks, 1, size), along_x.transpose(0, 2, 1))
        cells = blocks[: layers[0][1]]
        for first, last in layers[1:]:
            cells[: last - first] += blocks[first:last]
        return (scatter @ cells.ravel()).reshape(self.grid.bandwidth + 1, self.grid.size)

    @cached_property
    def _blocks(self) -> tuple[np.ndarray, list[np.ndarray], list[tuple[int, int]], sparse.csr_matrix]:
        """The points in their cells, in blocks of equal size so that the cells' sums are batched products.

        The fullest cells come first, and the blocks in layers (every cell's first block, then the second ones, ...), so
        that a layer adds to the first cells only.
        """
        grid, u = self.grid, self.u
        cell, t = grid.locate(u)
        cell_id, inverse, counts = np.unique(cell @ (1, grid.cells[0]), return_inverse=True, return_counts=True)
        order = np.argsort(-counts, kind="stable")
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        cell_id, inverse, counts = cell_id[order], place[inverse], counts[order]
        size = int(np.clip(-(-len(u) // len(counts)), 4, 64))
        cells_in_layer = [int((counts > layer * size).sum()) for layer in range(-(-int(counts[0]) // size))]
        starts = np.concatenate([[0], np.cumsum(cells_in_layer)])
        layers = list(itertools.pairwise(starts.tolist()))
        rank = np.empty(len(u), dtype=np.intp)
        rank[np.argsort(inverse, kind="stable")] = np.arange(len(u)) - np.repeat(np.cumsum(counts) - counts, counts)
        block = starts[rank // size] + inverse
        slot = block * size + rank % size
        along = []
        for axis in (0, 1):
            basis = cubic_basis(t[:, axis])
            products = np.zeros((starts[-1], 10, size))
            products[block, :, rank % size] = np.stack([basis[:, i] * basis[:, j] for i, j in _PAIRS], axis=1)
            along.append(products)

        # Where each of the 10 x 10 products of a cell goes in the band.
        step_x, step_y = grid.stride
        i_x, i_y = (axis.ravel() for axis in np.meshgrid(np.arange(4), np.arange(4)))
        local = i_x * step_x + i_y * step_y
        lower_a, lower_b = np.nonzero(local[:, None] >= local[None, :])
        pair = np.zeros((4, 4), dtype=np.intp)
        for number, (i, j) in enumerate(_PAIRS):
            pair[i, j] = pair[j, i] = number
        source = pair[i_y[lower_a], i_y[lower_b]] * 10 + pair[i_x[lower_a], i_x[lower_b]]
        first = (cell_id % grid.cells[0]) * step_x + (cell_id // grid.cells[0]) * step_y
        column = first[:, None] + local[lower_b]
        row = (local[lower_a] - local[lower_b]) * grid.size + column
        origin = np.arange(len(cell_id))[:, None] * 100 + source
        scatter = sparse.csr_matrix(
            (np.ones(row.size), (row.ravel(), origin.ravel())),
            shape=((grid.bandwidth + 1) * grid.size, 100 * len(cell_id)),
        )
        return slot, along, layers, scatter


@dataclass(frozen=True)
class L1Solution:
    """Minimum of sum_i w_i |b_i.c - x_i| + mu c.R.c for each of k outputs, and its proof.

    Attributes
    ----------
    coefficients:
        c (size, k).
    objective:
        (k,) the sum above at c.
    duality_gap:
        (k,) bound on how far the objective lies above the minimum, from a dual feasible point.
    dual:
        y (n, k), |y_i| <= w_i: the pull of each point on the surface.
    iterations:
        Newton steps taken.
    """

    coefficients: np.ndarray
    objective: np.ndarray
    duality_gap: np.ndarray
    dual: np.ndarray
    iterations: int


def interior_point(
    problem: L1Problem,
    x: np.ndarray,
    mu: float | np.ndarray,
    weights: np.ndarray | None = None,
    *,
    tolerance: float = 1e-9,
    max_iterations: int = 60,
) -> L1Solution:
    """Primal-dual interior point method with Mehrotra's predictor and corrector (Nocedal and Wright, Sec. 16.6).

    The residual is split, b.c - x = p - q with p, q >= 0; the dual variable y of the split lies in [-w, w], with slacks
    w - y for p and w + y for q.

    Parameters
    ----------
    x:
        (n, k) data of k outputs.
    mu:
        Weight of the bending energy, at least 0; a number, or (k,) one an output.
    weights:
        w (n, k) > 0; None is 1.
    tolerance:
        Stop when the duality gap is below this fraction of the objective.

    Raises
    ------
    ValueError
        If the data do not determine the coefficients (a control point without data, at mu = 0).
    """
    weights = np.ones_like(x) if weights is None else weights
    order, sorted_problem = problem.by_cells
    columns = zip(x[order].T, np.broadcast_to(mu, x.shape[1]), weights[order].T, strict=True)
    with _one_blas_thread():
        outputs = [
            _interior_point(
                sorted_problem, np.ascontiguousarray(x_k), mu_k, np.ascontiguousarray(w_k), tolerance, max_iterations
            )
            for x_k, mu_k, w_k in columns
        ]
    coefficients, objective, gap, dual, iterations = zip(*outputs, strict=True)
    unsorted_dual = np.empty_like(x)
    unsorted_dual[order] = np.stack(dual, axis=1)
    return L1Solution(
        np.stack(coefficients, axis=1), np.array(objective), np.array(gap), unsorted_dual, max(iterations)
    )


def _interior_point(
    problem: L1Problem, x: np.ndarray, mu: float, w: np.ndarray, tolerance: float, max_iterations: int
) -> tuple[np.ndarray, float, float, np.ndarray, int]:
    """One output: (coefficients, objective, gap, dual, iterations)."""
    B, B_T, R = problem.design, problem.design_T, problem.bending
    total = w.sum()
    centre = w @ x / total
    x = x - centre

    # A least-squares spline starts it, and its residuals give the unit of length.
    unit = max(np.abs(x).max(), np.finfo(float).tiny)
    factor = _cholesky(problem.gram_band(w) + 2 * mu / unit * problem.bending_band)
    if factor is None:
        raise ValueError(_UNHELD)
    c = _solve(factor, B_T @ (w * x))
    residual = B @ c - x
    scale = max(w @ np.abs(residual) / total, 1e-12 * unit)
    x, c, residual = x / scale, c / scale, residual / scale
    bend = 2 * mu * scale  # the quadratic term grows as scale^2, the L1 term as scale

    # Start inside: y follows the sign of the residual, and the split leaves room on both sides.
    smooth = np.sqrt(residual**2 + 1.0)
    y = 0.9 * w * residual / smooth
    p, q = (smooth + residual) / 2, (smooth - residual) / 2
    slack_p, slack_q = w - y, w + y

    for iteration in range(max_iterations + 1):
        residual = B @ c - x
        bending_pull = bend * (R @ c)
        # Each dual variable from its smaller slack, which keeps its digits.
        y = np.where(slack_p < slack_q, w - slack_p, slack_q - w)
        dual_residual = B_T @ y + bending_pull
        objective = w @ np.abs(residual) + c @ bending_pull / 2
        # For every c*: F(c*) >= F(c) - (sum w|r| - y.r) + dual_residual.(c* - c), by convexity.
        gap = np.maximum(w * np.abs(residual) - y * residual, 0.0).sum()
        gap += np.abs(dual_residual).sum() * np.abs(c).max()
        if gap <= tolerance * max(objective, 1e-9 * total) or iteration == max_iterations:
            break

        D = 1.0 / (p / slack_p + q / slack_q)
        factor = _cholesky(problem.gram_band(D) + bend * problem.bending_band)
        if factor is None:  # at the limit of double precision: the gap says how near we are
            break
        primal_residual = residual - p + q

        def step(g_p, g_q, D=D, factor=factor, r_d=dual_residual, r_p=primal_residual, slack=(slack_p, slack_q)):
            """Newton step that changes p (w - y) by g_p and q (w + y) by g_q to first order, and closes residuals."""
            g_p, g_q = g_p / slack[0], g_q / slack[1]
            h = D * (r_p - g_p + g_q)
            dc = _solve(factor, -r_d - B_T @ h)
            dy = D * (B @ dc) + h
            dp, dq = g_p + p / slack[0] * dy, g_q - q / slack[1] * dy  # noqa: B023
            return dc, dp, dq, dy

        # Predictor: straight to the solution; how far it gets tells how much centring the corrector needs.
        centrality = (p @ slack_p + q @ slack_q) / (2 * total)
        _, dp, dq, dy = step(-p * slack_p, -q * slack_q)
        alpha = _step_length((p, dp), (q, dq), (slack_p, -dy), (slack_q, dy))
        ahead = (p + alpha * dp) @ (slack_p - alpha * dy) + (q + alpha * dq) @ (slack_q + alpha * dy)
        target = centrality * min(ahead / (2 * total * centrality), 1.0) ** 3
        # Corrector: centring and the second-order term of the complementarity.
        dc, dp, dq, dy = step(target * w - p * slack_p + dp * dy, target * w - q * slack_q - dq * dy)
        alpha = 0.995 * _step_length((p, dp), (q, dq), (slack_p, -dy), (slack_q, dy))
        c, p, q = c + alpha * dc, p + alpha * dp, q + alpha * dq
        slack_p, slack_q = slack_p - alpha * dy, slack_q + alpha * dy

    return c * scale + centre, objective * scale, gap * scale, y, iteration


@cache
def _blas() -> ThreadpoolController:
    return ThreadpoolController()


def _one_blas_thread() -> AbstractContextManager:
    """BLAS on one thread: narrow bands gain nothing from more, and where cores are busy they wait for each other."""
    return _blas().limit(limits=1, user_api="blas")


def _step_length(*pairs: tuple[np.ndarray, np.ndarray]) -> float:
    """Longest step up to 1 along d that keeps every v in the pairs (v, d) positive."""
    return 1.0 / max(1.0, *(-np.min(d / v) for v, d in pairs))


def _solve(factor: np.ndarray, rhs: np.ndarray) -> np.ndarray:
    return cho_solve_banded((factor, True), rhs, check_finite=False)


def _cholesky(band: np.ndarray) -> np.ndarray | None:
    """Lower factor of a banded matrix; None where it is not positive definite in double precision."""
    try:
        return cholesky_banded(band, lower=True, overwrite_ab=True, check_finite=False)
    except np.linalg.LinAlgError:
        return None


def cvxpy_reference(
    problem: L1Problem,
    x: np.ndarray,
    mu: float | np.ndarray,
    weights: np.ndarray | None = None,
    *,
    tolerance: float = 1e-9,
) -> L1Solution:
    """The same minimum from CLARABEL through cvxpy: slower, and independent of this module's algorithm.

    Its `duality_gap` is NaN: CLARABEL's own stopping rule stands for it.
    """
    import cvxpy as cp

    n, k = x.shape
    w = np.ones((n, k)) if weights is None else weights
    mu = np.broadcast_to(mu, k)
    centre = np.average(x, axis=0, weights=w[:, 0])
    unit = np.maximum(np.abs(x - centre).max(axis=0), np.finfo(float).tiny)
    coefficients, dual = np.empty((problem.grid.size, k)), np.empty((n, k))
    iterations = 0
    for j in range(k):
        c, residual = cp.Variable(problem.grid.size), cp.Variable(n)
        split = residual == problem.design @ c - (x[:, j] - centre[j]) / unit[j]
        energy = cp.quad_form(c, mu[j] * unit[j] * problem.bending, assume_PSD=True)
        model = cp.Problem(cp.Minimize(w[:, j] @ cp.abs(residual) + energy), [split])
        model.solve(solver=cp.CLARABEL, tol_gap_rel=tolerance, tol_gap_abs=tolerance, tol_feas=min(1e-8, tolerance))
        if c.value is None:
            raise ValueError(f"smoothness: CLARABEL found no solution ({model.status}); increase it.")
        coefficients[:, j], dual[:, j] = c.value * unit[j] + centre[j], split.dual_value
        iterations = max(iterations, model.solver_stats.num_iters or 0)
    fitted = problem.design @ coefficients - x
    objective = (w * np.abs(fitted)).sum(axis=0) + mu * (coefficients * (problem.bending @ coefficients)).sum(axis=0)
    return L1Solution(coefficients, objective, np.full(k, np.nan), dual, iterations)


def least_squares(
    problem: L1Problem,
    x: np.ndarray,
    mu: float | np.ndarray,
    weights: np.ndarray | None = None,
    *,
    tolerance: float = 0.0,
) -> L1Solution:
    """The baseline that the L1 norm is there to beat: sum_i (w_i (b_i.c - x_i))^2 + mu c.R.c, in closed form.

    `tolerance` is not used; `dual` is the gradient of the data term.
    """
    k = x.shape[1]
    w = np.ones_like(x) if weights is None else weights
    coefficients = np.empty((problem.grid.size, k))
    for j, mu_j in enumerate(np.broadcast_to(mu, k)):
        factor = _cholesky(problem.gram_band(w[:, j] ** 2) + mu_j * problem.bending_band)
        if factor is None:
            raise ValueError(_UNHELD)
        coefficients[:, j] = _solve(factor, problem.design_T @ (w[:, j] ** 2 * x[:, j]))
    residual = problem.design @ coefficients - x
    energy = (coefficients * (problem.bending @ coefficients)).sum(axis=0)
    objective = ((w * residual) ** 2).sum(axis=0) + mu * energy
    return L1Solution(coefficients, objective, np.zeros(k), 2 * w**2 * residual, 1)
