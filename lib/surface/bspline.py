"""Surfaces R^2 -> R^3 as bicubic B-splines: position, normal, uncertainty, distance of a tool (Sec. IV-B).

The parameter is the left image point u = (x, y) px.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline
from scipy.linalg import cho_solve_banded

from lib.cameras import AffineCamera
from lib.geometry import points, store_array
from lib.surface.grid import SplineGrid
from lib.surface.solver import UNHELD, L1Problem, cholesky


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
        held_out: (m, 2) candidates of the smoothness and their mean held-out L1 error (mm); (0, 2) where it was given.
        axes: (k, 3) orthonormal directions along which the L1 norm was taken: the axes of the frame for the plain fit.
        problem, penalty, weights, residual: What was solved last, over the inliers: the points on their grid, mu (k,)
            of each output along `axes`, factors (n, k) of the absolute residuals, and the residuals (n, k).
    """

    objective: float
    duality_gap: float
    smoothness: float
    reject_mm: float
    inliers: np.ndarray
    residual_mm: np.ndarray
    held_out: np.ndarray
    axes: np.ndarray
    problem: L1Problem = field(repr=False)
    penalty: np.ndarray = field(repr=False)
    weights: np.ndarray = field(repr=False)
    residual: np.ndarray = field(repr=False)

    def covariance(self, u: np.ndarray) -> np.ndarray:
        """Covariance (n, 3, 3) mm^2 of Psi(u) (n, 2), NaN outside the domain.

        The curvature of the expected L1 loss is 2 f(0) B'B, where f(0) is the density of the residuals at zero; with the
        bending energy as the prior this gives C = (2 f B'B + 2 mu R)^-1 / (2 f) for the coefficients of an output (Koenker,
        Quantile Regression, Sec. 4.2; Wahba, J. R. Stat. Soc. B 45, 1983, for reading the penalty as a prior, which makes the
        bands hold the smoothing bias on average).  Neighbouring matches share part of their error; C is inflated by how much
        more the signs of residuals in a quarter of a cell agree than independent ones would.  Outputs correlate as the signs
        of their residuals do.  What all points share, such as the error of the calibration, is not in it.
        """
        result = np.full((len(u), 3, 3), np.nan)
        grid = self.problem.grid
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
        for mu, weights, size in zip(self.penalty, self.weights.T, np.abs(self.weights * self.residual).T, strict=True):
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
        signs, grid = np.sign(self.residual), self.problem.grid
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


@dataclass(frozen=True)
class ToolDistance:
    """Distance of points to a surface; positive on the camera's side of it, NaN outside the domain.

    Attributes:
        along_view_mm: (n,) to the surface point that the camera sees behind the tool.
        along_normal_mm: (n,) to the nearest surface point.
        nearest_mm, nearest_u: That nearest point (n, 3) and its parameter (n, 2).
    """

    along_view_mm: np.ndarray
    along_normal_mm: np.ndarray
    nearest_mm: np.ndarray
    nearest_u: np.ndarray


@dataclass(frozen=True, eq=False)
class BSplineSurface:
    """x = Psi(u), a bicubic B-spline from left image points (px) to points (mm, the frame of the fitted points).

    Attributes:
        grid: Domain and number of control points.
        control_points_mm: (n_y, n_x, 3).
        fit: How it was found: data term, smoothness, inliers, certificate (`SurfaceFit`); None where it was not fitted.
    """

    grid: SplineGrid
    control_points_mm: np.ndarray
    fit: SurfaceFit | None = None

    def __post_init__(self) -> None:
        store_array(self, "control_points_mm", (*self.grid.control[::-1], 3))

    @property
    def objective(self) -> float:
        """Eq. (6) at this surface over the final inliers, in mm and px; NaN for a surface that was not fitted."""
        return self.fit.objective if self.fit else float("nan")

    @property
    def inliers(self) -> np.ndarray | None:
        """(n,) bool: the points that the final fit used; None for a surface that was not fitted."""
        return self.fit.inliers if self.fit else None

    def __call__(self, u: ArrayLike) -> np.ndarray:
        """Points (n, 3) mm at image points (n, 2) px; NaN outside the domain."""
        return self.derivative(u, (0, 0))

    def derivative(self, u: ArrayLike, order: tuple[int, int]) -> np.ndarray:
        """d^(p+q) Psi / dx^p dy^q, (n, 3) mm per px^(p+q), for order (p, q), each up to 2; NaN outside the domain."""
        u = points(u, 2, "u")
        result = np.full((len(u), 3), np.nan)
        inside = self.grid.inside(u)
        result[inside] = self.grid.design(u[inside], order) @ self.grid.flatten(self.control_points_mm)
        return result

    def on_grid(self, x_px: ArrayLike, y_px: ArrayLike) -> np.ndarray:
        """Points (len(y), len(x), 3) on the lattice of columns `x_px` and rows `y_px`: fast for whole images."""
        values = self.control_points_mm
        for axis, u in ((1, x_px), (0, y_px)):
            position = (np.asarray(u, dtype=np.float64) - self.grid.domain[1 - axis]) / self.grid.cell_px[1 - axis]
            values = BSpline(np.arange(-3.0, values.shape[axis] + 1), values, 3, axis=axis, extrapolate=False)(position)
        return values

    def normal(self, u: ArrayLike) -> np.ndarray:
        """Unit normals (n, 3), towards the camera (for an unmirrored camera in a right-handed frame)."""
        normal = np.cross(self.derivative(u, (0, 1)), self.derivative(u, (1, 0)))
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def covariance(self, u: ArrayLike) -> np.ndarray:
        """Covariance (n, 3, 3) mm^2 of Psi(u) from the scatter of the fitted points; see `SurfaceFit.covariance`."""
        if self.fit is None:
            raise ValueError("covariance: this surface was not fitted to points, so its uncertainty is not known.")
        return self.fit.covariance(points(u, 2, "u"))

    def distance(self, x_mm: ArrayLike, camera: AffineCamera) -> ToolDistance:
        """Distance of points (n, 3), such as tool tips, to the surface along the view and along the surface's normal.

        The points are in the frame of the surface, NaN rows stay NaN; `camera` is the left one, whose image parametrises it.
        """
        x = points(x_mm, 3, "x_mm")
        start = camera.project(x)
        along_view = (self(start) - x) @ camera.viewing_direction
        low, high = np.reshape(self.grid.domain, (2, 2))
        u = np.clip(start, low, high)
        seen = np.isfinite(u).all(axis=1)
        for _ in range(20):  # Gauss-Newton steps towards the nearest point; each stays inside the domain
            orders = (0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)
            psi, psi_x, psi_y, psi_xx, psi_xy, psi_yy = (self.derivative(u[seen], order) for order in orders)
            jacobian = np.stack([psi_x, psi_y], axis=2)
            gap = x[seen] - psi
            normal = np.einsum("nki,nkj->nij", jacobian, jacobian)
            # Second-order term of the distance: keeps steps right where the tool is far above a curved surface.
            hessian = normal - np.einsum("ijnk,nk->nij", [[psi_xx, psi_xy], [psi_xy, psi_yy]], gap)
            convex = (np.linalg.det(hessian) > 0) & (hessian[:, 0, 0] > 0)
            hessian[~convex] = normal[~convex]
            step = np.linalg.solve(hessian, np.einsum("nki,nk->ni", jacobian, gap)[..., None])[..., 0]
            u[seen] = np.clip(u[seen] + step, low, high)
            if not step.size or np.abs(step).max() < 1e-7:
                break
        # At the domain's border the nearest point may lie beyond it: then there is none to name.
        u[~np.isfinite(along_view)] = np.nan
        nearest = self(u)
        return ToolDistance(along_view, np.einsum("nk,nk->n", x - nearest, self.normal(u)), nearest, u)
