"""How a surface was found, and how sure it is."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.linalg import cho_solve_banded

from lib.surface.grid import SplineGrid
from lib.surface.solver import UNHELD, L1Problem, cholesky

__all__ = ["SurfaceFit"]


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    """How a surface was found.

    Attributes:
        objective: Eq. (6) over the final inliers.  With point covariances the norms are whitened, with a camera depths.
        duality_gap: Proven bound, in the unit of the objective, on its distance from the minimum.
        smoothness: mu of Eq. (6), px^2 / mm: given, or chosen by held-out error.
        reject_mm: Bound on the L1 norm of a point's residual that was applied, after the first fit.
        inliers: (n,) points that the final fit used.
        residual_mm: (n, 3) Psi(u) - x of every given point at the final surface; NaN where u lies outside.
        iterations: Newton steps of the final solve.
        held_out: (m, 2) candidates of the smoothness and their mean held-out L1 error (mm); (0, 2) where it was given.
        axes: (k, 3) orthonormal directions along which the L1 norm was taken: the axes of the frame for the plain fit.
        method: The solver.
        problem, penalty, weights, residual: What was solved last, over the inliers: the points on their grid, mu (k,)
            of each output along `axes`, factors (n, k) of the absolute residuals, and the residuals (n, k).
    """

    objective: float
    duality_gap: float
    smoothness: float
    reject_mm: float
    inliers: np.ndarray
    residual_mm: np.ndarray
    iterations: int
    held_out: np.ndarray
    axes: np.ndarray
    method: str
    problem: L1Problem = field(repr=False)
    penalty: np.ndarray = field(repr=False)
    weights: np.ndarray = field(repr=False)
    residual: np.ndarray = field(repr=False)

    def covariance(self, grid: SplineGrid, u: np.ndarray) -> np.ndarray:
        """Covariance (n, 3, 3) mm^2 of Psi(u) (n, 2), NaN outside the domain.

        The curvature of the expected L1 loss is 2 f(0) B'B, where f(0) is the density of the residuals at zero; with
        the bending energy as the prior this gives C = (2 f B'B + 2 mu R)^-1 / (2 f) for the coefficients of an output
        (Koenker, Quantile Regression, Sec. 4.2; Wahba, J. R. Stat. Soc. B 45, 1983, for reading the penalty as a
        prior, which makes the bands hold the smoothing bias on average).  Neighbouring matches share part of their
        error; C is inflated by how much more the signs of residuals in a quarter of a cell agree than independent ones
        would.  Outputs correlate as the signs of their residuals do.  What all points share, such as the error of the
        calibration, is not in it.

        Raises:
            ValueError: For a fit by least squares, to which this does not apply.
        """
        if self.method == "least_squares":
            raise ValueError("covariance: of the L1 fit; fit with method 'interior_point'.")
        result = np.full((len(u), 3, 3), np.nan)
        inside = np.flatnonzero(grid.inside(u))
        for part in np.array_split(inside, max(1, len(inside) // 2048)):
            columns = grid.design(u[part]).toarray().T
            variance = [
                (columns * cho_solve_banded((factor, True), columns)).sum(axis=0) / (2 * density)
                for factor, density in self._posterior
            ]
            sigma = np.sqrt(np.stack(variance, axis=1) * self._inflation)
            covariance = sigma[:, :, None] * self._correlation * sigma[:, None, :]
            result[part] = np.einsum("ki,nkl,lj->nij", self.axes, covariance, self.axes)
        return result

    @cached_property
    def _posterior(self) -> list[tuple[np.ndarray, float]]:
        """Factor of 2 f B'W^2 B + 2 mu R and density f, one an output."""
        posterior = []
        scatter = np.abs(self.weights * self.residual).T
        for mu, weights, size in zip(self.penalty, self.weights.T, scatter, strict=True):
            # The surface meets some points exactly; only the others show the scatter, half of them within their median.
            free = size[size > 1e-3 * size.mean()]
            density = 0.25 / max(np.median(free), np.finfo(float).tiny) if len(free) else np.inf
            factor = cholesky(self.problem.normal_band(2 * density * weights**2, 2 * mu))
            if factor is None or not np.isfinite(density):
                raise ValueError(UNHELD)
            posterior.append((factor, density))
        return posterior

    @cached_property
    def _inflation(self) -> np.ndarray:
        """Variance (k,) of the sum of residual signs in a quarter of a cell, over that of independent signs."""
        signs = np.sign(self.residual)
        grid = self.problem.grid
        cell, t = grid.locate(self.problem.u)
        quarter = (2 * cell + (t >= 0.5)) @ (1, 2 * grid.cells[0])
        _, place, counts = np.unique(quarter, return_inverse=True, return_counts=True)
        sums = np.stack([np.bincount(place, column) for column in signs.T], axis=1)
        return np.maximum((sums**2).sum(axis=0) / counts.sum(), 1.0)

    @cached_property
    def _correlation(self) -> np.ndarray:
        signs = np.sign(self.residual)
        norm = np.sqrt(np.maximum((signs**2).sum(axis=0), 1.0))
        correlation = signs.T @ signs / np.outer(norm, norm)
        np.fill_diagonal(correlation, 1.0)
        return correlation
