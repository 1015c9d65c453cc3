"""Robust surface fit: data, smoothness, rejection and uncertainty around the solver (paper Sec. IV-B, Eq. 6)."""

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from lib.cameras import AffineCamera
from lib.geometry import finite_points
from lib.surface.bspline import BSplineSurface, SurfaceFit
from lib.surface.grid import SplineGrid
from lib.surface.solver import L1Problem, L1Solution, interior_point

#: Default rejection: points whose L1 norm exceeds this many times the median.  Gaussian noise along one axis puts
#: 0.1 % of its points beyond it.
REJECT_MEDIANS = 5.0
_FOLDS = 3
_ENOUGH_HELD_OUT, _QUICK_HELD_OUT = 1500, 1000  # points in the folds that are tried: more only cost time
_LADDER = 10.0**0.5  # step between candidates of the smoothness
_EXTENT = 8  # at most so many steps from the first candidate, either way


def fit_surface(
    u: ArrayLike, x_mm: ArrayLike, *, domain: tuple[float, float, float, float], control: tuple[int, int] = (20, 20),
    smoothness: float | None = None, reject_mm: float | None = None, covariance_mm2: ArrayLike | None = None,
    camera: AffineCamera | None = None, solver: Callable[..., L1Solution] = interior_point, tolerance: float = 1e-8,
    quick: bool = False,
) -> BSplineSurface:  # fmt: skip
    """The bicubic B-spline Psi that minimises paper Eq. (6), sum_i |Psi(u_i) - x_i|_1 + mu int |d^2 Psi / du^2|^2 du.

    Points whose L1 norm exceeds `reject_mm` at this surface are dropped and it is fitted once more, as in the paper.

    Args:
        u: (n, 2) left image points, px.  Points outside the domain are not used.
        x_mm: (n, 3) points, mm.
        domain: (x0, y0, x1, y1) px that the surface covers.
        control: (n_x, n_y) control points.
        smoothness: mu >= 0, px^2 / mm.  None chooses it by the mean L1 error of held-out points, whatever their order.
        reject_mm: Bound on the L1 norm of a point's residual.  None is `REJECT_MEDIANS` times the median L1 norm at the
            first fit, or as much as leaves points enough to fit; infinity keeps all.
        covariance_mm2: Covariance of the points, (3, 3) or (n, 3, 3).  Eq. (6) is then taken in whitened coordinates:
            along the principal axes of the mean covariance, each residual divided by its own standard deviation (and
            the whole multiplied by the mean, so that it stays in mm).  None is the paper's plain norm.
        camera: The left camera, affine.  Its ray through u is then exact, Psi(u) = ray(u) + s(u) d, and only the depth
            s along the viewing direction d is fitted, to d.x: one spline in the place of three.  Give `u` as matched in
            the image.
        solver: Takes the place of `lib.surface.solver.interior_point`, for comparisons.
        tolerance: Duality gap at which the solver stops, relative to the objective.
        quick: Choose the smoothness and reject points at fits of five Newton steps, within some percent of the minimum;
            only the final fit is solved to `tolerance`.

    A ValueError refuses NaN and points that determine no surface: fewer in the domain than 16 or a quarter of control points.
    """
    grid = SplineGrid(domain, control)
    u, x = finite_points(u, 2, "u"), finite_points(x_mm, 3, "x_mm")
    if len(u) != len(x):
        raise ValueError(f"u, x_mm: {len(u)} image points and {len(x)} points; they come in pairs.")
    used = grid.inside(u)
    least = max(16, grid.size // 4)
    if used.sum() < least:
        raise ValueError(
            f"u: {used.sum()} of {len(u)} points lie in the domain, and {grid.size} control points need {least} or more. "
            "Match more points, give fewer control points, or check that domain and u are both px of the left image."
        )
    spread = np.linalg.svd(u[used] - u[used].mean(axis=0), compute_uv=False)
    if spread[1] < 1e-6 * spread[0]:
        raise ValueError("u: the points lie on one line of the image, which does not determine a surface.")
    axes, values, norms = _outputs(x, covariance_mm2, camera)
    if smoothness is not None and not (np.isfinite(smoothness) and smoothness >= 0):
        raise ValueError(f"smoothness: mu must be a number >= 0 px^2/mm, or None to choose it; got {smoothness}.")
    if reject_mm is not None and not reject_mm > 0:
        raise ValueError(f"reject_mm: a bound in mm above 0, infinity, or None; got {reject_mm}.")
    exact = search = solver
    if solver is interior_point:
        exact = partial(solver, tolerance=tolerance)
        # As near the minimum as the choice of the smoothness needs.
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
            # The point of each ray that lies in the plane through the origin across the view.
            control_points = control_points + (grid.sites - camera.offset_px) @ np.linalg.pinv(camera.linear).T
        return problem, solution, BSplineSurface(grid, control_points)

    def residuals(surface: BSplineSurface) -> np.ndarray:
        # With a camera only the depth is fitted, so only it can be wrong.
        difference = surface(u) - x
        return difference if camera is None else (difference @ axes.T) @ axes

    problem, solution, surface = solve(used, search if quick else exact)
    norm = np.abs(residuals(surface)).sum(axis=1)
    if reject_mm is None:
        # A surface as flexible as the points are few meets many of them exactly, and a median says nothing.
        reject_mm = max(REJECT_MEDIANS * float(np.median(norm[used])), float(np.partition(norm[used], least - 1)[least - 1]))
    inliers = used & (np.nan_to_num(norm, nan=np.inf) <= reject_mm)
    if quick or (inliers != used).any():
        if inliers.sum() < least:
            found = f"only {inliers.sum()} of {used.sum()} points lie within {reject_mm:.4g} mm of the surface"
            raise ValueError(f"reject_mm: {found}; increase it.")
        problem, solution, surface = solve(inliers, exact)
    fit = SurfaceFit(
        objective=float(solution.objective.sum()), duality_gap=float(solution.duality_gap.sum()),
        smoothness=float(smoothness), reject_mm=float(reject_mm), inliers=inliers, residual_mm=residuals(surface),
        held_out=held_out, axes=axes, problem=problem, penalty=mu, weights=norms[inliers],
        residual=problem.design @ solution.coefficients - values[inliers],
    )  # fmt: skip
    return BSplineSurface(grid, surface.control_points_mm, fit)


def _outputs(
    x: np.ndarray, covariance_mm2: ArrayLike | None, camera: AffineCamera | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(axes (k, 3), values (n, k) = x along them, weights (n, k) of their absolute residuals)."""
    if camera is not None and not isinstance(camera, AffineCamera):
        raise ValueError("camera: the rays of a near-affine camera make the depth no B-spline; fit without a camera.")
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
    """The smoothness of least held-out error, and the candidates tried with their errors (m, 2).

    The error is the mean L1 error, in mm, of points kept out of the fit.  It is in mm also where the fit is whitened: else
    the axes across the view, which are all but linear in u and so like any smoothness, would outvote the depth.

    It walks down a ladder of half decades to the lowest rung, then takes the parabola through it and its neighbours.
    """
    n, stiffness = len(u), norms.mean(axis=0)
    fold = np.empty(n, dtype=np.intp)
    fold[np.lexsort((*values.T, u[:, 0], u[:, 1]))] = np.arange(n) % _FOLDS
    parts = [
        (L1Problem(grid, u[fold != f]), fold != f, grid.design(u[fold == f]), fold == f)
        for f in range(min(_FOLDS, -(-enough * _FOLDS // n)))
    ]
    # In the middle of what surfaces have needed; any start leads to the same end.
    spread = np.median(np.abs(values - np.median(values, axis=0)))
    unit = 0.001 / _LADDER * n * float(np.prod(grid.cell_px)) / max(spread, 1e-9)
    errors: dict[int, float] = {}

    def error(step: int) -> float:
        if step not in errors:
            total, count = 0.0, 0
            for problem, train, design, test in parts:
                scaled = unit * _LADDER**step * stiffness * train.sum() / n
                apart = np.abs(design @ solver(problem, values[train], scaled, norms[train]).coefficients - values[test])
                total += float((norms[test] / stiffness * apart).sum())
                count += test.sum()
            errors[step] = total / count
        return errors[step]

    best, direction = (0, 1) if error(1) < error(0) else (0, -1)
    while abs(best) < _EXTENT and error(best + direction) < error(best):
        best += direction
    exponent = float(best)
    if {best - 1, best + 1} <= errors.keys():
        slope = (errors[best + 1] - errors[best - 1]) / 2
        curvature = errors[best + 1] - 2 * errors[best] + errors[best - 1]
        exponent -= float(np.clip(slope / max(curvature, 1e-300), -0.5, 0.5))
    return unit * _LADDER**exponent, np.array([(unit * _LADDER**step, errors[step]) for step in sorted(errors)])
