"""The affine stereo problem in closed form: DLT, the global minimum of Eq. (3), noise levels.

With y = (u_left, u_right) stacked, y = A x + t + noise.  Eliminating the corrected pixels and points from the paper's
Eq. (3) gives E = 1/2 sum r^T S^-1 r with r = y - A x - t and S = v_u I + v_x A A^T.  S is the same for every point,
so E depends on the data only through their second moments, and its global minimum is an eigenvector problem
(errors-in-variables, total least squares; Golub and Van Loan, "An analysis of the total least squares problem", 1980).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import nnls

from lib.calibration.checks import check_spread, stacked_rows
from lib.cameras import AffineCamera


def dlt(x_mm: ArrayLike, u: ArrayLike) -> AffineCamera:
    """Affine direct linear transform of one camera: least-squares solution of u = M [x; 1] (paper Eq. 4).

    A ValueError refuses points x_mm (n, 3) and pixels u (n, 2) unless n >= 4, all are finite and x_mm is not coplanar.

    >>> x = np.vstack([np.zeros(3), np.eye(3)])
    >>> dlt(x, AffineCamera([[100, 1, 8, 960], [2, 100, 3, 540]]).project(x)).matrix.round(6).tolist()
    [[100.0, 1.0, 8.0, 960.0], [2.0, 100.0, 3.0, 540.0]]
    """
    x, y = stacked_rows(x_mm, [u])
    check_spread(x)
    return AffineCamera(regress(x, y))


def regress(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[A, t] (m, 4) of the least-squares fit y = A x + t, computed with centred and scaled points."""
    mean, scale = x.mean(axis=0), x.std() or 1.0
    A = np.linalg.lstsq((x - mean) / scale, y - y.mean(axis=0), rcond=None)[0].T / scale
    return np.column_stack([A, y.mean(axis=0) - A @ mean])


def camera_columns(x: np.ndarray, m: int) -> np.ndarray:
    """(n, m, 4 m) derivatives of m pixel coordinates of points x (n, 3) by the entries of [A, t], row by row."""
    return np.einsum("nj,ik->nikj", np.column_stack([x, np.ones(len(x))]), np.eye(m)).reshape(len(x), m, 4 * m)


class AffineMinimum(NamedTuple):
    """The stacked cameras [A, t] as `matrix` (m, 4), and their energy `cost`."""

    matrix: np.ndarray
    cost: float


def affine_minimum(x: np.ndarray, y: np.ndarray, variance_u: float, variance_x: float) -> AffineMinimum:
    """Global minimum of 1/2 sum |y - A x~ - t|^2 / variance_u + |x~ - x|^2 / variance_x over A, t and every x~.

    Positions x (n, 3) are in mm, stacked pixels y (n, m) in px, the variances in px^2 and mm^2.
    With z = (y / sigma_u, x / sigma_x) centred, the energy is half the sum of squared distances of the z to a
    3-dimensional subspace.  The three leading eigenvectors of the scatter matrix of z span the best subspace, so no
    initial value and no iteration are needed.  variance_x = 0 is plain least squares (DLT).
    """
    z, m = np.hstack([y, x]), y.shape[1]
    mean = z.mean(axis=0)
    z -= mean
    scatter = z.T @ z
    if variance_x <= 1e-14 * (np.linalg.eigvalsh(scatter[m:, m:])[0] / len(x)):  # negligible against the spread of x
        A = np.linalg.solve(scatter[m:, m:], scatter[m:, :m]).T
        cost = 0.5 * np.trace(scatter[:m, :m] - A @ scatter[m:, :m]) / variance_u
    else:
        scale = np.repeat([variance_u**-0.5, variance_x**-0.5], [m, 3])
        values, vectors = np.linalg.eigh(scatter * np.outer(scale, scale))
        leading = vectors[:, m:]
        A = np.linalg.solve(leading[m:].T, leading[:m].T).T * np.sqrt(variance_u / variance_x)
        cost = 0.5 * values[:m].sum()
    return AffineMinimum(np.column_stack([A, mean[:m] - A @ mean[m:]]), float(max(cost, 0.0)))


def paper_variances(sigma_u_px: float, sigma_x_mm: float) -> tuple[float, float]:
    """(variance_u, variance_x) with which `affine_minimum` minimises Eq. (3) exactly as printed.

    Eq. (3) weighs the pixel term by 1/sigma_u, the point term by 1/sigma_x and the reprojection term by 1.
    Eliminating the corrected pixels gives the weight a/(1 + a), a = 1/sigma_u, so 1 + sigma_u takes the place of the
    pixels' variance, and sigma_x that of the points'.  The result depends on the unit of length, here mm.
    """
    return 1.0 + sigma_u_px, sigma_x_mm


def estimate_noise(
    residuals: np.ndarray, A: np.ndarray, parameters: int, views: np.ndarray | None = None,
    claimed_px2: np.ndarray | None = None, *, sigma_u_px: float | None = None, sigma_x_mm: float | None = None,
) -> tuple[float, float]:  # fmt: skip
    """sigma_u and sigma_x from residuals (n, m) whose covariance is sigma_u^2 I + sigma_x^2 A A^T.

    Along the epipolar direction e (e^T A = 0) the noise is sigma_u alone; other directions contain sigma_x, too.  Fisher
    scoring maximises the likelihood of the residuals along the eigenvectors of A A^T, for the `views` (n, m / 2) bool of
    each row (None = all).  Single views have no epipolar direction: without pairs sigma_x is 0 unless one level is given.
    `parameters` is the number of fitted parameters.  A given level is kept.  `claimed_px2` (1 or n, m, m), a detector's
    covariances, take the place of I: one factor of 1 or more scales them, and sigma_u is their `noise_rms_px`.
    """
    n, m = residuals.shape
    code = np.full(n, 3) if views is None else views @ [1, 2][: m // 2]
    claimed = np.eye(m)[None] if claimed_px2 is None else claimed_px2
    unit = noise_rms_px(claimed)
    least = np.array([0.0 if claimed_px2 is None else 1.0, 0.0])
    count = 2.0 * ((code & 1).sum() + (code >> 1).sum() * (m > 2))
    known = np.array([np.nan if sigma is None else float(sigma) for sigma in (sigma_u_px, sigma_x_mm)])
    if claimed_px2 is not None and sigma_u_px is not None:
        known[0] = unit
    free, share = np.isnan(known), 1.0 - parameters / count
    if share * count < 2 * m or not free.any():  # too few residuals: noise levels that give plain least squares
        return tuple(np.where(free, [unit, 0.0], known).tolist())
    parts = []
    for kind in np.unique(code):
        own, rows = np.repeat([kind & 1, kind & 2], 2)[:m] > 0, code == kind
        white = np.linalg.inv(np.linalg.cholesky((claimed if len(claimed) == 1 else claimed[rows])[:, own][:, :, own]))
        values, directions = np.linalg.eigh(white @ (A[own] @ A[own].T) @ np.swapaxes(white, 1, 2))
        square = np.square(np.swapaxes(directions, 1, 2) @ white @ residuals[rows][:, own, None])[:, :, 0] / share
        square, weight = (square, share) if len(white) > 1 else (square.mean(axis=0), share * rows.sum())
        parts.append((np.maximum(values, 0.0).ravel(), square.ravel(), np.full(square.size, weight)))
    gain, observed, freedom = (np.concatenate(part) for part in zip(*parts, strict=True))
    floor = 1e-18 + 1e-24 * gain.max()
    least[0] = max(least[0], floor)
    if free.all() and not (np.bincount(code, minlength=4)[3] >= 4 and m > 2):
        return float(unit * np.sqrt(max((freedom @ observed) / freedom.sum(), least[0]))), 0.0
    # The initial value is right if either noise is negligible.  `flat`: directions with the least sigma_x.
    flat = gain <= max(gain.min() * (1.0 + 1e-9), 1e-9 * gain.max())
    v = np.where(free, [max((freedom @ (observed * flat)) / (freedom @ flat), least[0]), 0.0], (known / [unit, 1.0]) ** 2)
    if free[1] and not flat.all():
        v[1] = np.median(np.maximum(observed[~flat] - v[0], 0.0) / gain[~flat])
    design = np.column_stack([np.ones(len(gain)), gain])
    scale, start = design[:, free].max(axis=0), np.where(free, least, v)
    columns, excess, root_freedom = design[:, free] / scale, observed - design @ start, np.sqrt(freedom)
    for _ in range(50):
        root, new = root_freedom / np.maximum(design @ v, floor), start.copy()
        new[free] += nnls(columns * root[:, None], excess * root)[0] / scale
        if (np.abs(new - v) <= 1e-10 * v).all():
            break
        v = new
    return float(unit * np.sqrt(new[0])), float(np.sqrt(new[1]))


def noise_rms_px(covariance_px2: np.ndarray) -> float:
    """RMS standard deviation of a pixel coordinate over covariances (n, m, m), each at most three times the median one."""
    variance = np.trace(covariance_px2, axis1=1, axis2=2) / covariance_px2.shape[1]
    return float(np.sqrt(np.minimum(variance, 9.0 * np.median(variance)).mean()))  # else one row may decide
