"""The affine stereo problem in closed form: moments, DLT, the global minimum of Eq. (3), noise levels.

With y = (u_left, u_right) stacked, y = A x + t + noise.  Minimising the paper's Eq. (3) over the corrected pixels
and points leaves E = 1/2 sum r^T S^-1 r with r = y - A x - t and S = v_u I + v_x A A^T, the same S for every point.
So E depends on the data only through their second moments, and its global minimum is an eigenvector problem
(errors-in-variables, total least squares; Golub and Van Loan, "An analysis of the total least squares problem", 1980).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lib.calibration.checks import check_spread
from lib.cameras import AffineCamera
from lib.geometry import finite_points

__all__ = ["AffineMinimum", "Moments", "affine_minimum", "dlt", "estimate_noise", "paper_variances", "regress"]


def dlt(x_mm: ArrayLike, u: ArrayLike) -> AffineCamera:
    """Affine direct linear transform of one camera: least squares of u = M [x; 1] (paper Eq. 4).

    Parameters
    ----------
    x_mm:
        (n, 3) points in the robot frame, n >= 4, not coplanar.
    u:
        (n, 2) pixels.

    Raises
    ------
    ValueError
        For NaN rows, fewer than four points, coplanar or collinear points.
    """
    x, u = finite_points(x_mm, 3, "x_mm"), finite_points(u, 2, "u")
    check_spread(x, u)
    return AffineCamera(regress(x, u))


def regress(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[A, t] (m, 4) of the least-squares fit y = A x + t, on centred and scaled points."""
    mean, scale = x.mean(axis=0), x.std()
    A = np.linalg.lstsq((x - mean) / scale, y - y.mean(axis=0), rcond=None)[0].T / scale
    return np.column_stack([A, y.mean(axis=0) - A @ mean])


@dataclass(frozen=True, eq=False)
class Moments:
    """Weight, mean and scatter of z = (y, x): all that the affine problem needs to know of its data.

    Attributes
    ----------
    weight:
        Number of points, or the sum of their weights.
    mean:
        (m + 3,), pixels first, then mm.
    scatter:
        (m + 3, m + 3), the weighted sum of (z - mean)(z - mean)^T.
    """

    weight: float
    mean: np.ndarray
    scatter: np.ndarray

    @classmethod
    def of(cls, x: np.ndarray, y: np.ndarray) -> Moments:
        """Moments of points x (n, 3) and stacked pixels y (n, m)."""
        z = np.hstack([y, x])
        mean = z.mean(axis=0)
        z -= mean
        return cls(float(len(z)), mean, z.T @ z)

    def merged(self, other: Moments) -> Moments:
        """Moments of both sets together (Chan, Golub and LeVeque's update)."""
        weight = self.weight + other.weight
        step = other.mean - self.mean
        scatter = self.scatter + other.scatter + np.outer(step, step) * (self.weight * other.weight / weight)
        return Moments(weight, self.mean + step * (other.weight / weight), scatter)

    def faded(self, factor: float) -> Moments:
        """The same points at `factor` times their weight."""
        return Moments(self.weight * factor, self.mean, self.scatter * factor)


@dataclass(frozen=True, eq=False)
class AffineMinimum:
    """The cameras [A, t] stacked as `matrix` (m, 4), and the energy `cost` there."""

    matrix: np.ndarray
    cost: float


def affine_minimum(moments: Moments, variance_u: float, variance_x: float) -> AffineMinimum:
    """Global minimum of 1/2 sum |y - A x~ - t|^2 / variance_u + |x~ - x|^2 / variance_x over A, t and every x~.

    With z = (y / sigma_u, x / sigma_x) centred, the energy is the squared distance of the z to a 3-dimensional
    subspace, so the three leading eigenvectors of their scatter solve it: no initial value, no iteration.

    Parameters
    ----------
    moments:
        Of the correspondences.
    variance_u, variance_x:
        px^2 and mm^2; variance_x = 0 is plain least squares (DLT).
    """
    m = len(moments.mean) - 3
    scatter = moments.scatter
    smallest = np.linalg.eigvalsh(scatter[m:, m:])[0] / moments.weight
    if variance_x <= 1e-14 * smallest:
        A = np.linalg.solve(scatter[m:, m:], scatter[m:, :m]).T
        cost = 0.5 * np.trace(scatter[:m, :m] - A @ scatter[m:, :m]) / variance_u
    else:
        scale = np.repeat([variance_u**-0.5, variance_x**-0.5], [m, 3])
        values, vectors = np.linalg.eigh(scatter * np.outer(scale, scale))
        leading = vectors[:, m:]
        A = np.linalg.solve(leading[m:].T, leading[:m].T).T * np.sqrt(variance_u / variance_x)
        cost = 0.5 * values[:m].sum()
    matrix = np.column_stack([A, moments.mean[:m] - A @ moments.mean[m:]])
    return AffineMinimum(matrix, float(max(cost, 0.0)))


def paper_variances(sigma_u_px: float, sigma_x_mm: float) -> tuple[float, float]:
    """(variance_u, variance_x) that make `affine_minimum` minimise Eq. (3) exactly as printed.

    Eq. (3) weighs the pixel term by 1/sigma_u, the point term by 1/sigma_x and the reprojection term by 1.
    Eliminating the corrected pixels leaves the weight a/(1 + a), a = 1/sigma_u, so 1 + sigma_u stands for the variance;
    sigma_x stands for the point's.  The result depends on the unit of length, here mm.
    """
    return 1.0 + sigma_u_px, sigma_x_mm


def estimate_noise(
    residuals: np.ndarray,
    A: np.ndarray,
    parameters: int,
    *,
    sigma_u_px: float | None = None,
    sigma_x_mm: float | None = None,
) -> tuple[float, float]:
    """sigma_u and sigma_x from residuals whose covariance is sigma_u^2 I + sigma_x^2 A A^T.

    Along the epipolar direction (n^T A = 0) the robot's error cannot show, so the residual there is sigma_u alone; the
    other directions add sigma_x.  Maximum likelihood by Fisher scoring over the eigenvectors of A A^T.  A single camera
    has no epipolar direction: unless one level is given, everything is attributed to the pixels.

    Parameters
    ----------
    residuals:
        (n, m) px, y - A x - t.
    A:
        (m, 3).
    parameters:
        Fitted parameters, for the degrees of freedom.
    sigma_u_px, sigma_x_mm:
        A level that is known and kept.

    Returns
    -------
    sigma_u_px, sigma_x_mm
    """
    n, m = residuals.shape
    if sigma_u_px is not None and sigma_x_mm is not None:
        return float(sigma_u_px), float(sigma_x_mm)
    freedom = n - parameters / m
    if freedom < 2:  # nothing to learn from: the weights that make plain least squares of the cameras
        return (1.0 if sigma_u_px is None else float(sigma_u_px)), (0.0 if sigma_x_mm is None else float(sigma_x_mm))
    gain, directions = np.linalg.eigh(A @ A.T)
    gain = np.maximum(gain, 0.0)
    observed = ((residuals @ directions) ** 2).sum(axis=0) / freedom
    floor = 1e-18 + 1e-24 * gain.max()
    if sigma_u_px is None and sigma_x_mm is None and m < 3:
        return float(np.sqrt(max(observed.mean(), floor))), 0.0
    if sigma_u_px is not None:
        v_u = float(sigma_u_px) ** 2
    else:
        v_u = max(observed[0], floor)
    if sigma_x_mm is not None:
        v_x = float(sigma_x_mm) ** 2
    else:  # a start that is right where either noise is negligible
        seen = gain > 1e-9 * gain.max()
        v_x = float(np.median(np.maximum(observed[seen] - v_u, 0.0) / gain[seen])) if seen.any() else 0.0
    design = np.column_stack([np.ones(m), gain])
    free = np.array([sigma_u_px is None, sigma_x_mm is None])
    v = np.array([v_u, v_x])
    for _ in range(50):
        weight = 1.0 / np.maximum(design @ v, floor) ** 2
        active = free.copy()
        target = observed - design[:, ~active] @ v[~active]
        new = v.copy()
        new[active] = _weighted(design[:, active], target, weight)
        if new[1] < 0 and free[1]:  # the bound v_x >= 0 binds
            new[1] = 0.0
            if free[0]:
                new[0] = (weight @ observed) / weight.sum()
        new[0] = max(new[0], floor) if free[0] else v[0]
        if np.allclose(new, v, rtol=1e-10, atol=0.0):
            break
        v = new
    return float(np.sqrt(new[0])), float(np.sqrt(new[1]))


def _weighted(design: np.ndarray, target: np.ndarray, weight: np.ndarray) -> np.ndarray:
    scale = np.abs(design).max(axis=0)
    B = design / scale
    return np.linalg.lstsq(B * np.sqrt(weight)[:, None], target * np.sqrt(weight), rcond=None)[0] / scale
