"""Surfaces R^2 -> R^3 as bicubic B-splines: position, uncertainty, distance to a tool, and their robust fit (Sec. IV-B).

The parameter is the left image point u = (x, y) px.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline
from scipy.linalg import cho_solve_banded
from scipy.spatial import KDTree

from lib.cameras import AffineCamera
from lib.geometry import finite_points, points, store_array
from lib.surface.grid import SplineGrid
from lib.surface.solver import UNHELD, L1Problem, L1Solution, cholesky, interior_point

#: Default rejection: L1 norms above this many times the median, which 0.1 % of Gaussian residuals along one axis exceed.
REJECT_MEDIANS = 5.0
_FOLDS = 3
_ENOUGH_HELD_OUT, _QUICK_HELD_OUT = 1500, 1000  # held-out points that suffice to choose the smoothness
_LADDER = 10.0**0.5  # ratio of neighbouring candidates of the smoothness
_LARGEST = 1e18  # smoothness above which rounding hides the data; far below, the surface is already a plane
_EXTENT = 8  # largest number of steps from the first candidate, up or down


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    """Results of a fit.  The attributes from `problem` on belong to the last fit, to the inliers."""

    objective: float  # Eq. (6) over the final inliers; norms are whitened with point covariances, and depths with a camera
    duality_gap: float  # upper bound on objective - minimum, in the unit of the objective
    smoothness: float  # mu of Eq. (6), px^2 / mm: given, or chosen by held-out error
    reject_mm: float  # bound on the L1 norm of a point's residual, applied after the first fit
    inliers: np.ndarray  # (n,) bool: points that the final fit used
    held_out: np.ndarray  # (m, 2) candidates of the smoothness and their mean held-out L1 error (mm); (0, 2) if it was given
    axes: np.ndarray  # (k, 3) orthonormal directions along which the L1 norm was taken; the frame's axes for the plain fit
    problem: L1Problem = field(repr=False)  # the inliers and their grid
    penalty: np.ndarray = field(repr=False)  # (k,) mu of each output along `axes`
    bending_energy: np.ndarray = field(repr=False)  # (k,) c.R.c of each output
    weights: np.ndarray = field(repr=False)  # (n, k) factors on the absolute residuals
    residual: np.ndarray = field(repr=False)  # (n, k)
    inflation: float = 1.0  # least factor on the variance, for common errors of neighbours that the surface follows

    @cached_property
    def posterior(self) -> list[tuple[np.ndarray, float]]:
        """For each output, the Cholesky factor of 2 f B'W^2 B + 2 mu R and the density f of the residuals at zero.

        The smoothness of least held-out error often suits a flatter surface than this one.  Where no data are near, its prior
        would then promise too much.  So mu is reduced until the bending energy is what the prior expects: 4 f mu c.R.c equals
        the number of coefficients that the data determine, without the three of a plane (MacKay, Neural Comput. 4, 1992).
        """
        posterior, sizes = [], np.abs(self.weights * self.residual)
        for mu, energy, weights, size in zip(self.penalty, self.bending_energy, self.weights.T, sizes.T, strict=True):
            # The surface interpolates some points exactly.  Half of the others are within their median: f = 0.5 / (2 median).
            free = size[size > 1e-3 * size.mean()]
            if not len(free):
                what = "the surface passes through all its points, so their scatter is not known"
                raise ValueError(f"covariance: {what}; fit fewer control points.")
            density = 0.25 / max(np.median(free), np.finfo(float).tiny)
            factor = self._factor(mu, density, weights)
            loose = 2 * mu * np.trace(cho_solve_banded((factor, True), self.problem.bending.toarray()))
            excess = 4 * density * mu * energy / max(self.problem.grid.size - loose - 3, 1.0)
            posterior.append((self._factor(mu / excess, density, weights) if excess > 1 else factor, density))
        return posterior

    def _factor(self, mu: float, density: float, weights: np.ndarray) -> np.ndarray:
        factor = cholesky(self.problem.normal_band(2 * density * weights**2, 2 * mu))
        if factor is None:
            raise ValueError(UNHELD)
        return factor

    @cached_property
    def agreement(self) -> tuple[np.ndarray, np.ndarray]:
        """Of residual signs: variance (k,) of their sums over quarter cells, 1 = independent; correlation (k, k)."""
        signs, inflation = np.sign(self.residual), sign_inflation(self.problem.grid, self.problem.u, self.residual, 0.5)
        norm = np.sqrt(np.maximum((signs**2).sum(axis=0), 1.0))
        correlation = signs.T @ signs / np.outer(norm, norm)
        np.fill_diagonal(correlation, 1.0)
        return np.maximum(inflation, self.inflation), correlation


@dataclass(frozen=True)
class ToolDistance:
    """Distance of points to a surface; positive on the camera's side of it, NaN outside the domain.

    `along_view_mm` (n,) is the distance to the surface point at the same left pixel.  `along_normal_mm` (n,) is the distance
    to the nearest point `nearest_mm` (n, 3) at the parameter `nearest_u` (n, 2); NaN if that is beyond the domain's border.
    """

    along_view_mm: np.ndarray
    along_normal_mm: np.ndarray
    nearest_mm: np.ndarray
    nearest_u: np.ndarray


@dataclass(frozen=True, eq=False)
class BSplineSurface:
    """x = Psi(u), a bicubic B-spline from left image points (px) to points (mm, the frame of the fitted points).

    `grid` is the domain and the layout of `control_points_mm` (n_y, n_x, 3); `fit` is None if the surface was not fitted.
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
        """Points (len(y), len(x), 3) at the columns `x_px` and the rows `y_px`: fast for whole images."""
        values = self.control_points_mm
        for axis, u in ((1, x_px), (0, y_px)):
            u, low, high = np.asarray(u, dtype=np.float64), self.grid.domain[1 - axis], self.grid.domain[3 - axis]
            position = (u - low) / self.grid.cell_px[1 - axis]
            position = np.where((u >= low) & (u <= high), np.clip(position, 0, values.shape[axis] - 3), position)  # rounding
            values = BSpline(np.arange(-3.0, values.shape[axis] + 1), values, 3, axis=axis, extrapolate=False)(position)
        return values

    def normal(self, u: ArrayLike) -> np.ndarray:
        """Unit normals (n, 3), towards the camera (for an unmirrored camera in a right-handed frame)."""
        normal = np.cross(self.derivative(u, (0, 1)), self.derivative(u, (1, 0)))
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def covariance(self, u: ArrayLike) -> np.ndarray:
        """Covariance (n, 3, 3) mm^2 of Psi(u) (n, 2) from the scatter of the fitted points; NaN outside the domain.

        With f the density of the residuals at zero and the bending energy as the prior, the coefficients of an output have
        C = (2 f B'B + 2 mu R)^-1 / (2 f) (Koenker, Quantile Regression, Sec. 4.2; Wahba, J. R. Stat. Soc. B 45, 1983).
        Errors of neighbouring matches are correlated, so C is inflated by the correlation of the signs of their residuals,
        or by `SurfaceFit.inflation` if that is more; the outputs are correlated as these signs are.  Common errors of all
        points, such as the calibration's, are left out.
        Where no point is near, as below a mask, only the prior limits the surface: it does not expect a step there, nor all
        of an undulation as wide as the mask (in simulations 67 % of such errors were within 1.96 standard deviations).
        """
        if self.fit is None:
            raise ValueError("covariance: this surface was not fitted to points, so its uncertainty is not known.")
        u, axes, (inflation, correlation) = points(u, 2, "u"), self.fit.axes, self.fit.agreement
        result, inside = np.full((len(u), 3, 3), np.nan), np.flatnonzero(self.grid.inside(u))
        for part in np.array_split(inside, max(1, len(inside) // 2048)):
            B = self.grid.design(u[part]).toarray().T
            variance = [(B * cho_solve_banded((factor, True), B)).sum(axis=0) / (2 * f) for factor, f in self.fit.posterior]
            sigma = np.sqrt(np.stack(variance, axis=1) * inflation)
            result[part] = np.einsum("ki,nkl,lj->nij", axes, sigma[:, :, None] * correlation * sigma[:, None, :], axes)
        return result

    @cached_property
    def _lattice(self) -> tuple[np.ndarray, KDTree]:
        """Image points (m, 2), 3 x 3 in each cell, and a search tree of the surface there: initial values for `distance`."""
        low, high = np.reshape(self.grid.domain, (2, 2))
        x, y = (np.linspace(*ends) for ends in zip(low, high, 3 * np.array(self.grid.cells) + 1, strict=True))
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), KDTree(self.on_grid(x, y).reshape(-1, 3))

    def distance(self, x_mm: ArrayLike, camera: AffineCamera) -> ToolDistance:
        """Distance of points (n, 3), such as tool tips, to the surface along the view and along the surface's normal.

        The points are in the frame of the surface; NaN rows stay NaN.  `camera` is the left one, whose image is the domain.
        """
        x = points(x_mm, 3, "x_mm")
        behind = camera.project(x)
        along_view = (self(behind) - x) @ camera.viewing_direction
        low, high = np.reshape(self.grid.domain, (2, 2))
        u, seen = np.full_like(behind, np.nan), np.isfinite(along_view)
        lattice, tree = self._lattice
        u[seen] = lattice[tree.query(x[seen])[1]]
        for _ in range(20):  # Gauss-Newton steps towards the nearest point; each stays inside the domain
            orders = (0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)
            psi, psi_x, psi_y, psi_xx, psi_xy, psi_yy = (self.derivative(u[seen], order) for order in orders)
            jacobian = np.stack([psi_x, psi_y], axis=2)
            gap = x[seen] - psi
            normal = np.einsum("nki,nkj->nij", jacobian, jacobian)
            # The second-order term makes the steps accurate where the tool is far above a curved surface.
            hessian = normal - np.einsum("ijnk,nk->nij", [[psi_xx, psi_xy], [psi_xy, psi_yy]], gap)
            convex = (np.linalg.det(hessian) > 0) & (hessian[:, 0, 0] > 0)
            hessian[~convex] = normal[~convex]
            step = np.linalg.solve(hessian, np.einsum("nki,nk->ni", jacobian, gap)[..., None])[..., 0]
            before, u[seen] = u[seen], np.clip(u[seen] + step, low, high)
            if np.abs(u[seen] - before).max(initial=0.0) < 1e-7:
                break
        # Where the last step was clipped, the nearest point is beyond the domain's border and unknown.
        u[seen] = np.where((np.abs(before + step - u[seen]) < 1e-6).all(axis=1, keepdims=True), u[seen], np.nan)
        nearest = self(u)
        return ToolDistance(along_view, np.einsum("nk,nk->n", x - nearest, self.normal(u)), nearest, u)


def sign_inflation(grid: SplineGrid, u: np.ndarray, residual: np.ndarray, cells: float) -> np.ndarray:
    """Variance (k,) of the sums of the signs of residuals (n, k) in squares of so many cells; 1 = independent, at least 1."""
    cell, t = grid.locate(u)
    square = np.floor((cell + t) / cells).astype(np.intp) @ (1, 4 * grid.size)
    _, group, counts = np.unique(square, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(group, column) for column in np.sign(residual).T], axis=1)
    return np.maximum((sums**2).sum(axis=0) / counts.sum(), 1.0)


def fewest_points(control: tuple[int, int]) -> int:
    """Least number of points to which `fit_surface` fits a surface with control points in these columns and rows."""
    return max(16, control[0] * control[1] // 4)


def fit_surface(
    u: ArrayLike, x_mm: ArrayLike, *, domain: tuple[float, float, float, float], control: tuple[int, int] = (20, 20),
    smoothness: float | None = None, reject_mm: float | None = None, covariance_mm2: ArrayLike | None = None,
    camera: AffineCamera | None = None, solver: Callable[..., L1Solution] = interior_point, quick: bool = False,
) -> BSplineSurface:  # fmt: skip
    """The bicubic B-spline Psi that minimises paper Eq. (6), sum_i |Psi(u_i) - x_i|_1 + mu int |d^2 Psi / du^2|^2 du.

    Points whose L1 norm exceeds `reject_mm` at this surface are dropped, and the fit is repeated once, as in the paper.

    Args:
        u: (n, 2) left image points, px.  Points outside the domain are not used.
        x_mm: (n, 3) points, mm.
        domain: (x0, y0, x1, y1) px that the surface covers.
        control: (n_x, n_y) control points.
        smoothness: mu, 0 to 1e18 px^2 / mm.  None chooses it by the mean L1 error of held-out points, whatever their order.
        reject_mm: Bound on the L1 norm of a point's residual.  None is `REJECT_MEDIANS` times the median L1 norm at the
            first fit, or more if too few points would remain; infinity keeps all.
        covariance_mm2: Covariance of the points, (3, 3) or (n, 3, 3).  Residuals are then taken along the principal axes of
            its mean and weighted by 1 / standard deviation, with a mean weight of 1.  None is the paper's plain norm.
        camera: The left camera, affine.  Its ray through u is then exact, Psi(u) = ray(u) + s(u) d, and only the depth
            s along the viewing direction d is fitted, to d.x.  Give `u` as matched in the image.
        solver: Replaces `lib.surface.solver.interior_point`, for comparisons.
        quick: Smoothness and inliers are chosen with five Newton steps, some percent above the minimum, and the final fit
            stops at a duality gap of 1e-4 of the objective; else it stops at 1e-8.

    A ValueError refuses NaN and too few points in the domain: fewer than 16 or than a quarter of the control points.
    """
    grid = SplineGrid(domain, control)
    u, x = finite_points(u, 2, "u"), finite_points(x_mm, 3, "x_mm")
    if len(u) != len(x):
        raise ValueError(f"u, x_mm: {len(u)} image points and {len(x)} points; they come in pairs.")
    used = grid.inside(u)
    least = fewest_points(control)
    if used.sum() < least:
        what = f"{used.sum()} of {len(u)} points lie in the domain, and {grid.size} control points need {least} or more"
        cure = "Match more points, give fewer control points, or check that domain and u are both px of the left image"
        raise ValueError(f"u: {what}. {cure}.")
    spread = np.linalg.svd(u[used] - u[used].mean(axis=0), compute_uv=False)
    if spread[1] < 1e-6 * spread[0]:
        raise ValueError("u: the points lie on one line of the image, which does not determine a surface.")
    axes, values, norms = _outputs(x, covariance_mm2, camera)
    if smoothness is not None and not 0 <= smoothness <= _LARGEST:
        raise ValueError(f"smoothness: mu must be from 0 to {_LARGEST:g} px^2/mm, or None to choose it; got {smoothness}.")
    if reject_mm is not None and not reject_mm > 0:
        raise ValueError(f"reject_mm: a bound in mm above 0, infinity, or None; got {reject_mm}.")
    exact = search = solver
    if solver is interior_point:
        exact = partial(solver, tolerance=1e-4 if quick else 1e-8)
        # A coarser tolerance suffices to choose the smoothness.
        search = partial(solver, max_iterations=5) if quick else partial(solver, tolerance=1e-3)
    held_out = np.empty((0, 2))
    if smoothness is None:
        enough = _QUICK_HELD_OUT if quick else _ENOUGH_HELD_OUT
        smoothness, held_out = _choose_smoothness(grid, u[used], values[used], norms[used], search, enough)
    mu = smoothness * norms[used].mean(axis=0)

    def solve(chosen: np.ndarray, solver: Callable[..., L1Solution]) -> tuple[L1Problem, L1Solution, BSplineSurface]:
        problem = L1Problem(grid, u[chosen])
        solution = solver(problem, values[chosen], mu, norms[chosen])
        control_points = grid.unflatten(solution.coefficients) @ axes
        if camera is not None:
            # Add the point of each ray in the plane through the origin that is perpendicular to the view.
            control_points = control_points + (grid.sites - camera.offset_px) @ np.linalg.pinv(camera.linear).T
        return problem, solution, BSplineSurface(grid, control_points)

    problem, solution, surface = solve(used, search if quick else exact)
    norm = np.abs((surface(u) - x) @ axes.T @ axes).sum(axis=1)  # with a camera only the depth counts
    if reject_mm is None:
        # With few points for its control points, a surface interpolates many of them and the median is meaningless.
        reject_mm = max(REJECT_MEDIANS * float(np.median(norm[used])), float(np.partition(norm[used], least - 1)[least - 1]))
    inliers = used & (np.nan_to_num(norm, nan=np.inf) <= reject_mm)
    if quick or (inliers != used).any():
        if inliers.sum() < least:
            found = f"only {inliers.sum()} of {used.sum()} points lie within {reject_mm:.4g} mm of the surface"
            raise ValueError(f"reject_mm: {found}; increase it.")
        problem, solution, surface = solve(inliers, exact)
    c = solution.coefficients
    fit = SurfaceFit(
        objective=float(solution.objective.sum()), duality_gap=float(solution.duality_gap.sum()),
        smoothness=float(smoothness), reject_mm=float(reject_mm), inliers=inliers, held_out=held_out, axes=axes, penalty=mu,
        bending_energy=(c * (problem.bending @ c)).sum(axis=0),
        problem=problem, weights=norms[inliers], residual=problem.design @ c - values[inliers],
    )  # fmt: skip
    return BSplineSurface(grid, surface.control_points_mm, fit)


def _outputs(x: np.ndarray, covariance_mm2: ArrayLike | None, camera: AffineCamera | None) -> tuple[np.ndarray, ...]:
    """Axes (k, 3), values (n, k) of x along them, and weights (n, k) of the absolute residuals."""
    if camera is not None and not isinstance(camera, AffineCamera):
        raise ValueError("camera: the rays of a near-affine camera have no depth that is a B-spline; fit without a camera.")
    n = len(x)
    axes = np.eye(3) if camera is None else camera.viewing_direction[None]
    if covariance_mm2 is None:
        return axes, x @ axes.T, np.ones((n, len(axes)))
    covariance = np.asarray(covariance_mm2, dtype=np.float64)
    if covariance.shape not in {(3, 3), (n, 3, 3)}:
        raise ValueError(f"covariance_mm2: expected (3, 3) or ({n}, 3, 3), got {covariance.shape}.")
    covariance = np.broadcast_to(covariance, (n, 3, 3))
    if camera is None and np.isfinite(covariance).all():
        axes = np.linalg.eigh(covariance.mean(axis=0))[1].T
    variance = np.einsum("ki,nij,kj->nk", axes, covariance, axes)
    if not (np.isfinite(variance) & (variance > 0)).all():
        raise ValueError("covariance_mm2: must be finite and positive definite for every point.")
    inverse_sigma = variance**-0.5
    return axes, x @ axes.T, inverse_sigma / inverse_sigma.mean()


def _choose_smoothness(
    grid: SplineGrid, u: np.ndarray, values: np.ndarray, norms: np.ndarray, solver: Callable[..., L1Solution], enough: int
) -> tuple[float, np.ndarray]:
    """The smoothness of least mean L1 error of held-out points, and the candidates tried with their errors (m, 2).

    The error is in mm even if the fit is whitened.  Else the two axes across the view would dominate the depth, although
    they are nearly linear in u and so insensitive to the smoothness.
    """
    n, stiffness = len(u), norms.mean(axis=0)
    fold = np.empty(n, dtype=np.intp)
    fold[np.lexsort((*values.T, u[:, 0], u[:, 1]))] = np.arange(n) % _FOLDS
    tests = [fold == f for f in range(min(_FOLDS, -(-enough * _FOLDS // n)))]
    parts = [(L1Problem(grid, u[~test]), ~test, grid.design(u[test]), test) for test in tests]
    # A typical value as the first candidate; the result hardly depends on it.
    spread = np.median(np.abs(values - np.median(values, axis=0)))
    unit = 0.001 / _LADDER * n * float(np.prod(grid.cell_px)) / max(spread, 1e-6)
    errors: dict[int, float] = {}

    def error(step: int) -> float:
        if step not in errors:
            total = 0.0
            for problem, train, design, test in parts:
                scaled = unit * _LADDER**step * stiffness * train.sum() / n
                apart = np.abs(design @ solver(problem, values[train], scaled, norms[train]).coefficients - values[test])
                total += float((norms[test] / stiffness * apart).sum())
            errors[step] = total / np.sum(tests)
        return errors[step]

    # Descend in steps of half a decade to the least error, then take the minimum of the parabola through its neighbours.
    best, direction = (0, 1) if error(1) < error(0) else (0, -1)
    while abs(best) < _EXTENT and error(best + direction) < error(best):
        best += direction
    exponent = float(best)
    if {best - 1, best + 1} <= errors.keys():
        slope = (errors[best + 1] - errors[best - 1]) / 2
        curvature = errors[best + 1] - 2 * errors[best] + errors[best - 1]
        exponent -= float(np.clip(slope / max(curvature, 1e-300), -0.5, 0.5))
    return unit * _LADDER**exponent, np.array([(unit * _LADDER**step, errors[step]) for step in sorted(errors)])
