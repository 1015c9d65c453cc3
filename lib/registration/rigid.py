"""Rigid registration of point sets: the sum of norms of Eq. (7), and the sum of squared norms."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from lib.geometry import RigidTransform, align_rotation, finite_points, points

_STARTS = 12  # random triples of points as initial values, in addition to the least-squares solution
_ITERATIONS = 300


@dataclass(frozen=True, eq=False)
class Registration:
    """An estimated rigid motion `transform`, target_from_source, and its uncertainty.

    `covariance` (6, 6) belongs to a small error (rotation omega in rad, translation tau in mm) in the target frame: the
    error of a registered point p is omega x (p - centre_mm) + tau, where `centre_mm` (3,) is the centre of the data.

    `residuals` (n,) has the norm of each row's residual in mm (`register`) or its Mahalanobis distance (`register_images`),
    NaN where a row was not used.  `weights` (n,) are the rows' weights in the last step, 1 = full.  `cost` is the minimum
    of the estimator's own loss.
    """

    transform: RigidTransform
    covariance: np.ndarray
    centre_mm: np.ndarray
    residuals: np.ndarray
    weights: np.ndarray
    cost: float

    @property
    def translation_sd_mm(self) -> np.ndarray:
        """Standard deviation (3,) of a registered point at `centre_mm`."""
        return np.sqrt(np.diag(self.covariance)[3:])

    def covariance_at(self, x_source: ArrayLike) -> np.ndarray:
        """Covariance (n, 3, 3) in mm^2 of registered points, from the uncertainty of the transform alone."""
        jacobian = motion_jacobian(self.transform.apply(points(x_source, 3, "x_source")) - self.centre_mm)
        return jacobian @ self.covariance @ np.swapaxes(jacobian, 1, 2)


def motion_jacobian(offset: np.ndarray) -> np.ndarray:
    """(n, 3, 6): derivative by (omega, tau) of points at `offset` (n, 3) from the centre of rotation."""
    return np.concatenate([np.cross(np.eye(3), offset[:, None]).mT, np.tile(np.eye(3), (len(offset), 1, 1))], axis=2)


def check_spread(x: np.ndarray, name: str) -> None:
    """Raise a ValueError for fewer than three points, and for points on a line: they do not determine the rotation."""
    if len(x) < 3:
        raise ValueError(f"{name}: {len(x)} points; a rigid motion needs at least 3 that are not on a line.")
    spread = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
    if spread[1] <= 1e-6 * max(spread[0], 1e-12 * max(1.0, np.abs(x).max())):
        raise ValueError(f"{name}: the points lie on one line or coincide; the rotation about it is unknown. Add frames.")


def register(x_source: ArrayLike, x_target: ArrayLike, *, loss: Literal["norm", "squared"] = "norm") -> Registration:
    """The rigid transform that maps `x_source` to `x_target`, point by point (paper Eq. 7).

    Args:
        x_source, x_target: (n, 3) mm, n >= 3; in the paper the triangulated landmarks and the robot's report of them.
        loss: "norm" minimises sum |R x + t - y|, Eq. (7) as printed: robust, solved by iteratively reweighted least
            squares from several initial values.  "squared" minimises the sum of squares, in closed form (Kabsch 1976).

    The covariance is the sandwich of an M-estimator (Huber 1967).  It assumes neither Gaussian nor isotropic noise, but needs
    many points: below about ten it is unreliable.  With "norm", standard deviations are accurate to about 30 %.  A ValueError
    refuses arrays of different lengths, NaN, fewer than three points, and points on a line.

    >>> x = np.array([[0.0, 0, 0], [4, 0, 0], [0, 3, 0], [0, 0, 2], [3, 3, 0], [2, 0, 1]])
    >>> y = x + [0.5, 0.25, -1]
    >>> y[3] += 10.0  # a gross error
    >>> register(x, y).transform.t.round(6).tolist()
    [0.5, 0.25, -1.0]
    """
    x, y = finite_points(x_source, 3, "x_source"), finite_points(x_target, 3, "x_target")
    if len(x) != len(y):
        raise ValueError(f"x_source, x_target: {len(x)} and {len(y)} points; give them in pairs.")
    if loss not in ("norm", "squared"):
        raise ValueError(f"loss: 'norm' or 'squared', got {loss!r}.")
    check_spread(x, "x_source")
    check_spread(y, "x_target")
    centre_x, centre_y = x.mean(axis=0), y.mean(axis=0)
    x0, y0 = x - centre_x, y - centre_y
    (R,), (t,) = _kabsch(x0, y0, np.ones((1, len(x)))) if loss == "squared" else _sum_of_norms(x0, y0)
    residual = x0 @ R.T + t - y0
    norm = np.linalg.norm(residual, axis=1)
    median = float(np.median(norm))
    weights = np.ones(len(x)) if loss == "squared" else 1.0 / np.maximum(norm, max(1e-6 * median, 1e-12))
    centre = weights @ y0 / weights.sum()
    curvature, pull = np.broadcast_to(np.eye(3), (len(x), 3, 3)), residual
    if loss == "norm":  # its Hessian is singular at r = 0: take that of sqrt(r^2 + s^2), with s of the residuals' size
        length = np.hypot(norm, max(0.4 * median, 1e-12))[:, None]
        direction, pull = residual / length, residual / np.maximum(norm, 1e-300)[:, None]
        curvature = (curvature - direction[:, :, None] * direction[:, None, :]) / length[:, None]
    J = motion_jacobian(x0 @ R.T + t - centre)
    covariance = sandwich((J.mT @ curvature @ J).sum(axis=0), np.einsum("nki,nk->ni", J, pull), 6)
    transform = RigidTransform(R, t + centre_y - R @ centre_x)
    cost = float(norm.sum() if loss == "norm" else (norm**2).sum())
    return Registration(transform, covariance, centre + centre_y, norm, weights / weights.max(), cost)


def _kabsch(x: np.ndarray, y: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted least-squares rotations (s, 3, 3) and translations (s, 3) for weights (s, n)."""
    weights = weights / weights.sum(axis=1, keepdims=True)
    mean_x, mean_y = weights @ x, weights @ y
    R = align_rotation(np.swapaxes(weights[:, :, None] * y, 1, 2) @ x - mean_y[:, :, None] * mean_x[:, None, :])
    return R, mean_y - np.einsum("sij,sj->si", R, mean_x)


def _sum_of_norms(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weiszfeld's iteration, extended by a rotation, from the least-squares solution and from triples of points."""
    rng = np.random.default_rng(0)
    triples = [np.isin(np.arange(len(x)), rng.choice(len(x), 3, replace=False)) for _ in range(_STARTS)]
    R, t = _kabsch(x, y, np.array([np.ones(len(x)), *triples]))
    floor, before = 1e-12 * max(1.0, float(np.abs(y).max())), np.empty(0)
    for iteration in range(_ITERATIONS):
        norm = np.linalg.norm(x @ np.swapaxes(R, 1, 2) + t[:, None] - y, axis=2)
        cost = norm.sum(axis=1)
        if iteration == 8:  # the ranking is settled: continue only with the best
            best = [int(cost.argmin())]
            R, t, norm, cost, before = R[best], t[best], norm[best], cost[best], before[best]
        if iteration >= 8 and before[0] - cost[0] <= 1e-14 * cost[0] + floor:
            break
        before = cost
        R, t = _kabsch(x, y, 1.0 / np.maximum(norm, floor))
    return R, t


def sandwich(hessian: np.ndarray, gradient: np.ndarray, parameters: float) -> np.ndarray:
    """Covariance of an M-estimator (Huber 1967) from its Hessian and each row's gradient (n, 6)."""
    n, bread = len(gradient), np.linalg.pinv(hessian, rcond=1e-12, hermitian=True)
    return bread @ (gradient.T @ gradient) @ bread * (n / max(n - parameters, 1))
