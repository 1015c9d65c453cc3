"""Triangulation of matches: one constant matrix for affine pairs, Gauss-Newton on the pixels for near-affine ones."""

from dataclasses import dataclass

import numpy as np

from lib.cameras.affine import MatrixCamera
from lib.cameras.near_affine import NearAffineCamera

__all__ = ["Points", "best_linear", "triangulate_near_affine"]

_Pair = tuple[MatrixCamera, MatrixCamera]
#: Points at a time: few enough for their arrays to stay in the processor's cache.
_BLOCK = 8192


@dataclass(frozen=True)
class Points:
    """Triangulated points: `x_mm` (n, 3), `covariance_mm2` (n, 3, 3), signed `epipolar_px` residual (n,)."""

    x_mm: np.ndarray
    covariance_mm2: np.ndarray
    epipolar_px: np.ndarray


def best_linear(A: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Best linear estimator (..., 3, 4) of x from y = A x + noise, and the estimate's covariance (..., 3, 3)."""
    shape = np.broadcast_shapes(A.shape[:-2], covariance.shape[:-2])
    weight_A = np.linalg.solve(covariance, np.broadcast_to(A, (*shape, 4, 3)))
    covariance_mm2 = np.linalg.inv(np.swapaxes(A, -1, -2) @ weight_A)
    return covariance_mm2 @ np.swapaxes(weight_A, -1, -2), covariance_mm2


def triangulate_near_affine(
    cameras: _Pair, y: np.ndarray, covariance: np.ndarray, affine_normal: np.ndarray, steps: int = 2
) -> Points:
    """Linear for each point (the projection's denominator multiplied out), then Gauss-Newton steps on the pixels.

    Args:
        y: (n, 4) left and right pixels; NaN rows stay NaN, and so does a match that only a point behind a camera
            explains.
        covariance: (1, 4, 4) or (n, 4, 4), as `lib.geometry.pair_covariance` gives it.
        affine_normal: (4,) of the pair of affine cameras, which says the sign of the epipolar residuals.
    """
    n = len(y)
    x, covariance_mm2, epipolar = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan), np.full(n, np.nan)
    known = np.flatnonzero(np.isfinite(y).all(axis=1))
    for start in range(0, len(known), _BLOCK):
        rows = known[start : start + _BLOCK]
        W = np.linalg.inv(covariance if len(covariance) == 1 else covariance[rows])
        found, in_front = _linear(cameras, y[rows]), np.ones(len(rows), dtype=bool)
        for _ in range(steps):
            J, r, ahead = _linearised(cameras, found, y[rows])
            in_front &= ahead
            found = found + _step(J, r, W)[0]
        J, r, ahead = _linearised(cameras, found, y[rows])
        in_front &= ahead
        x[rows[in_front]], covariance_mm2[rows[in_front]] = found[in_front], _step(J, r, W)[1][in_front]
        normal = _null_vector(J, affine_normal)
        epipolar[rows[in_front]] = np.einsum("ni,ni->n", normal, r)[in_front]
    return Points(x, covariance_mm2, epipolar)


def _linear(cameras: _Pair, y: np.ndarray) -> np.ndarray:
    """x (n, 3) from P_i [x; 1] - u_i P_3 [x; 1] = 0 for undistorted pixels."""
    rows, right_hand = [], []
    for camera, u in zip(cameras, (y[:, :2], y[:, 2:]), strict=True):
        P, u = camera.projection_matrix, camera.undistort(u) if isinstance(camera, NearAffineCamera) else u
        rows.append(P[:2, :3] - u[:, :, None] * P[2, :3])
        right_hand.append(u * P[2, 3] - P[:2, 3])
    return _step(np.concatenate(rows, axis=1), np.concatenate(right_hand, axis=1), np.eye(4))[0]


def _linearised(cameras: _Pair, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Jacobian (n, 4, 3), residuals (n, 4), and which points lie before both cameras; the others stand at the centre."""
    in_front = np.all([camera.depth_ratio(x) > 0 for camera in cameras if isinstance(camera, NearAffineCamera)], axis=0)
    safe = np.where(in_front[:, None], x, getattr(cameras[0], "reference_mm", np.zeros(3)))
    J = np.concatenate([camera.jacobian(safe) for camera in cameras], axis=1)
    return J, y - np.hstack([camera.project(safe) for camera in cameras]), in_front


def _step(J: np.ndarray, r: np.ndarray, W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted least squares of r = J x: x (n, 3) and the inverse (n, 3, 3) of the normal matrix."""
    WJ = W @ J
    inverse = _inverse_3x3(np.swapaxes(J, 1, 2) @ WJ)
    return (inverse @ (np.swapaxes(WJ, 1, 2) @ r[..., None]))[..., 0], inverse


def _inverse_3x3(N: np.ndarray) -> np.ndarray:
    """Inverses of symmetric matrices (n, 3, 3) by cofactors: several times faster than a stack of factorisations."""
    n = np.ascontiguousarray(np.moveaxis(N, 0, -1))
    a, b, c, d, e, f = n[0, 0], n[0, 1], n[0, 2], n[1, 1], n[1, 2], n[2, 2]
    cofactor = np.array(
        [
            [d * f - e * e, c * e - b * f, b * e - c * d],
            [c * e - b * f, a * f - c * c, b * c - a * e],
            [b * e - c * d, b * c - a * e, a * d - b * b],
        ]
    )
    return np.moveaxis(cofactor / (a * cofactor[0, 0] + b * cofactor[0, 1] + c * cofactor[0, 2]), -1, 0)


def _null_vector(J: np.ndarray, affine: np.ndarray) -> np.ndarray:
    """Unit vectors (n, 4) orthogonal to the columns of J (n, 4, 3), turned to the side of the affine rig's normal."""
    a, b, c = np.moveaxis(J, 0, -1).transpose(1, 0, 2)  # the columns, (4, n) each
    minors = []
    for i in range(4):
        p, q, r = (k for k in range(4) if k != i)
        minor = a[p] * (b[q] * c[r] - b[r] * c[q]) - a[q] * (b[p] * c[r] - b[r] * c[p])
        minors.append((minor + a[r] * (b[p] * c[q] - b[q] * c[p])) * (-1) ** i)
    normal = np.stack(minors, axis=1)
    return normal * (np.sign(normal @ affine) / np.linalg.norm(normal, axis=1))[:, None]
