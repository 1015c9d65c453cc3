"""L1 splines: min_c sum_i w_i |b_i.c - x_i| + mu c.R.c, the problem of paper Eq. (6), one output at a time.

Eq. (6) decouples over x, y and z.  Each output is a quadratic programme whose Newton matrix B'DB + 2 mu R has the narrow
band of the spline's grid.  `interior_point` needs about a dozen factorisations; the duality gap bounds its error.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.linalg.lapack import dpbtrf, dpbtrs

from lib.parallel import single_threaded_blas
from lib.surface.grid import SplineGrid, cubic_basis

UNHELD = (
    "smoothness: too small to determine control points that have no data near them; increase it, or use fewer control points."
)
_PAIRS = np.triu_indices(4)


class L1Problem:
    """Points u (n, 2) px, all inside the domain of `grid`, and the constant parts of the Newton matrix."""

    def __init__(self, grid: SplineGrid, u: np.ndarray) -> None:
        self.grid, self.u, self.bending = grid, u, grid.bending

    @cached_property
    def design(self) -> sparse.csr_matrix:
        """B (n, size): B @ coefficients is the spline at the points."""
        return self.grid.design(self.u)

    def normal_band(self, weights: np.ndarray, stiffness: float = 0.0) -> np.ndarray:
        """B' diag(weights) B + stiffness R for weights (n,), as a lower band (bandwidth + 1, size)."""
        slot, along_x, along_y, scatter, bending = self._blocks
        packed = np.zeros((len(along_x), along_x.shape[1], 1))
        packed.ravel()[slot] = weights
        band = scatter @ np.matmul(along_y, packed * along_x).ravel() + stiffness * bending
        return band.reshape(self.grid.size, -1).T  # its columns are contiguous, as LAPACK needs them

    @cached_property
    def _blocks(self) -> tuple[np.ndarray, ...]:
        """The points by cells, in blocks of equal size so that sums over cells are batched products: slots of the points; the
        10 distinct products of basis functions along x, and along y; the matrix that adds the sums to the band; R as a band.
        """
        grid, height = self.grid, self.grid.bandwidth + 1
        cell, t = grid.locate(self.u)
        corner, inverse, counts = np.unique(cell @ grid.stride, return_inverse=True, return_counts=True)
        size = int(np.clip(-(-len(t) // len(counts)), 4, 64))
        n_blocks = -(-counts // size)
        starts = np.cumsum(n_blocks) - n_blocks
        slot = np.empty(len(t), dtype=np.intp)
        rank = np.arange(len(t)) - np.repeat(np.cumsum(counts) - counts, counts)
        slot[np.argsort(inverse, kind="stable")] = np.repeat(starts, counts) * size + rank
        along = np.zeros((2, n_blocks.sum() * size, 10))
        along[:, slot] = (cubic_basis(t)[..., _PAIRS[0]] * cubic_basis(t)[..., _PAIRS[1]]).swapaxes(0, 1)
        along_x, along_y = along.reshape(2, -1, size, 10)
        j, i = np.indices((4, 4)).reshape(2, -1)
        local = np.column_stack([i, j]) @ grid.stride
        a, b = np.nonzero(local[:, None] >= local)
        pair = np.zeros((4, 4), dtype=np.intp)
        pair[_PAIRS] = pair[_PAIRS[::-1]] = np.arange(10)
        corner = np.repeat(corner, n_blocks)
        place = (corner[:, None] + local[b]) * height + local[a] - local[b]
        column = np.arange(len(corner))[:, None] * 100 + (pair[j[a], j[b]] * 10 + pair[i[a], i[b]])
        entries = np.ones(place.size), (place.ravel(), column.ravel())
        scatter = sparse.csc_matrix(entries, shape=(height * grid.size, 100 * len(corner)))
        lower = sparse.tril(self.bending).tocoo()
        bending = np.bincount(lower.col * height + lower.row - lower.col, lower.data, minlength=height * grid.size)
        return slot, along_x, along_y.transpose(0, 2, 1), scatter, bending


@dataclass(frozen=True)
class L1Solution:
    """Minimum of sum_i w_i |b_i.c - x_i| + mu c.R.c for each of k outputs, with a bound on its error."""

    coefficients: np.ndarray  # c (size, k)
    objective: np.ndarray  # (k,) values of the sum at c
    duality_gap: np.ndarray  # (k,) upper bound on objective - minimum, which follows from `dual`
    dual: np.ndarray  # y (n, k), a dual feasible point, |y_i| <= w_i: the force of each point on the surface


def interior_point(
    problem: L1Problem, x: np.ndarray, mu: float | np.ndarray, weights: np.ndarray | None = None, *,
    tolerance: float = 1e-9, max_iterations: int = 60,
) -> L1Solution:  # fmt: skip
    """Primal-dual interior point method with Mehrotra's predictor and corrector (Nocedal and Wright, Sec. 16.6).

    Args:
        x: (n, k) data of k outputs.
        mu: Weight of the bending energy, at least 0; a number, or (k,) one for each output.
        weights: w (n, k) > 0; None is 1.
        tolerance: Stop when the duality gap is below this fraction of the objective.

    A ValueError refuses data that do not determine the coefficients (a control point without data, at mu = 0).
    """
    weights = np.ones_like(x) if weights is None else weights
    columns = zip(x.T, np.broadcast_to(mu, x.shape[1]), weights.T, strict=True)
    with single_threaded_blas():
        outputs = [_interior_point(problem, *column, tolerance, max_iterations) for column in columns]
    coefficients, objective, gap, dual = zip(*outputs, strict=True)
    return L1Solution(np.stack(coefficients, 1), np.array(objective), np.array(gap), np.stack(dual, 1))


def _interior_point(
    problem: L1Problem, x: np.ndarray, mu: float, w: np.ndarray, tolerance: float, max_iterations: int
) -> tuple[np.ndarray, float, float, np.ndarray]:
    """One output: (coefficients, objective, gap, dual)."""
    B, B_T, R = problem.design, problem.design.T, problem.bending
    total = w.sum()
    centre = w @ x / total
    x = x - centre

    # The initial value is a least-squares spline, not too stiff for rounding; its residuals give the unit of length.
    unit = max(np.abs(x).max(), 1e-9)  # x may be constant
    if (factor := cholesky(problem.normal_band(w, 2 * min(mu / unit, 1e12)))) is None:
        raise ValueError(UNHELD)
    c = dpbtrs(factor, B_T @ (w * x), lower=1)[0]
    residual = B @ c - x
    scale = max(w @ np.abs(residual) / total, 1e-12 * unit)
    x, c, residual = x / scale, c / scale, residual / scale
    bend = 2 * mu * scale  # the quadratic term grows as scale^2, the L1 term as scale

    # The residual is p - q with p, q > 0; the dual y has slacks w - y for p and w + y for q.  On the central path
    # p (w - y) = q (w + y) = w * a common factor.  A step of length alpha multiplies the dual residual by 1 - alpha.
    smooth = 1.0 + np.sqrt(residual**2 + 1.0)
    p, q = (smooth + residual) / 2, (smooth - residual) / 2
    slack_p, slack_q = w / p, w / q
    dual_residual = np.abs(B_T @ (w - slack_p) + bend * (R @ c)).sum()

    def certificate() -> tuple[float, float]:
        """Objective, and upper bound on objective - minimum, from c and y alone."""
        residual = B @ c - x
        objective = w @ np.abs(residual) + c @ bending_pull / 2
        # For every c*: F(c*) >= F(c) - (sum w|r| - y.r) + dual_residual.(c* - c), by convexity.
        gap = np.maximum(w * np.abs(residual) - y * residual, 0.0).sum()
        return objective, gap + np.abs(B_T @ y + bending_pull).sum() * np.abs(c).max()

    for iteration in range(max_iterations + 1):
        bending_pull = bend * (R @ c)
        # Compute each dual variable from its smaller slack, which is numerically more accurate.
        y = np.where(slack_p < slack_q, w - slack_p, slack_q - w)
        product_p, product_q = p * slack_p, q * slack_q
        complementarity = product_p.sum() + product_q.sum()
        # The bound costs two products with B, so compute it only when it may be small enough.
        enough = tolerance * max(w @ (p + q) + c @ bending_pull / 2, 1e-9 * total)
        if complementarity + dual_residual * np.abs(c).max() <= 4 * enough:
            objective, gap = certificate()
            if gap <= tolerance * max(objective, 1e-9 * total):
                break
        p_over, q_over = p / slack_p, q / slack_q
        D = 1.0 / (p_over + q_over)
        factor = cholesky(problem.normal_band(D, bend)) if iteration < max_iterations else None
        if factor is None:  # no steps left, or the limit of double precision; the gap shows how close it is
            objective, gap = certificate()
            break

        def newton(pull, D=D, factor=factor, y=y, bending_pull=bending_pull):
            """Newton step (dc, dy) that makes the dual residual zero, with D (B dc + pull) = dy."""
            pull = D * pull
            dc = dpbtrs(factor, -bending_pull - B_T @ (y + pull), lower=1)[0]
            return dc, D * (B @ dc) + pull

        # Predictor: straight to the solution.  Its feasible length alpha determines the corrector's centring.
        _, dy = newton(p - q)
        ratio_p, ratio_q = dy / slack_p, dy / slack_q
        alpha = 1.0 / max(1.0, 1.0 - ratio_p.min(), ratio_p.max(), 1.0 + ratio_q.max(), -ratio_q.min())
        bent_p, bent_q = product_p * ratio_p * (1.0 - ratio_p), -product_q * ratio_q * (1.0 + ratio_q)
        ahead = (1.0 - alpha) * complementarity + alpha**2 * (bent_p.sum() + bent_q.sum())
        centrality = complementarity / (2 * total)
        target = centrality * min(ahead / complementarity, 1.0) ** 3 * w
        # Corrector.
        goal_p, goal_q = (target - bent_p) / slack_p, (target - bent_q) / slack_q
        dc, dy = newton(p - q - goal_p + goal_q)
        dp, dq = goal_p - p + p_over * dy, goal_q - q - q_over * dy
        shrinking = ((p, dp), (q, dq), (slack_p, -dy), (slack_q, dy))
        longest = 1.0 / max(1.0, *(-np.min(step / value) for value, step in shrinking))  # at most 1, keeps all positive
        alpha = (1.0 - np.clip(centrality, 1e-3, 5e-3)) * longest
        c, p, q = c + alpha * dc, p + alpha * dp, q + alpha * dq
        slack_p, slack_q = slack_p - alpha * dy, slack_q + alpha * dy
        dual_residual *= 1.0 - alpha

    return c * scale + centre, objective * scale, gap * scale, y


def cholesky(band: np.ndarray) -> np.ndarray | None:
    """Lower Cholesky factor of a banded matrix, which is overwritten; None if it is not numerically positive definite."""
    factor, info = dpbtrf(band, lower=1, overwrite_ab=1)
    return None if info else factor
