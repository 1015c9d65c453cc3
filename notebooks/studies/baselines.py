"""What the paper argues against: perspective resection, and affine factorisation with a metric upgrade."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import rq

from lib.calibration.checks import check_spread
from lib.geometry import finite_points, points

__all__ = [
    "Factorisation",
    "PerspectiveCamera",
    "factorise",
    "perspective_dlt",
    "similarity",
    "triangulate_perspective",
]


@dataclass(frozen=True, eq=False)
class PerspectiveCamera:
    """u = P [x; 1], dehomogenised; `matrix` (3, 4)."""

    matrix: np.ndarray

    def project(self, x: ArrayLike) -> np.ndarray:
        """Pixels (n, 2) of points (n, 3) mm."""
        x = points(x, 3, "x")
        h = x @ self.matrix[:, :3].T + self.matrix[:, 3]
        return h[:, :2] / h[:, 2:]

    def decompose(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """K (3, 3) with positive diagonal and K[2, 2] = 1, R (3, 3) rotation, camera centre (3,) mm, by RQ."""
        P = self.matrix * np.sign(np.linalg.det(self.matrix[:, :3]))
        K, R = rq(P[:, :3])
        signs = np.diag(np.sign(np.diag(K)))
        K, R = K @ signs, signs @ R
        return K / K[2, 2], R, -np.linalg.solve(P[:, :3], P[:, 3])

    @property
    def condition(self) -> float:
        """Condition number of the left 3 x 3 block: infinite for an affine camera."""
        return float(np.linalg.cond(self.matrix[:, :3]))


def perspective_dlt(x_mm: ArrayLike, u: ArrayLike) -> PerspectiveCamera:
    """Normalised DLT of a perspective camera (Hartley and Zisserman, Alg. 7.1), n >= 6.

    Raises
    ------
    ValueError
        For NaN rows, fewer than six points, coplanar points.
    """
    x, u = finite_points(x_mm, 3, "x_mm"), finite_points(u, 2, "u")
    check_spread(x, u)
    if len(x) < 6:
        raise ValueError(f"x_mm: {len(x)} points; a perspective camera needs at least 6.")
    to_x, x_n = _normalised(x)
    to_u, u_n = _normalised(u)
    h = np.column_stack([x_n, np.ones(len(x))])
    zero = np.zeros_like(h)
    rows = np.concatenate([np.hstack([h, zero, -u_n[:, :1] * h]), np.hstack([zero, h, -u_n[:, 1:] * h])])
    P = np.linalg.svd(rows)[2][-1].reshape(3, 4)
    return PerspectiveCamera(np.linalg.solve(to_u, P @ to_x))


def _normalised(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Similarity to zero mean and mean distance sqrt(dimension), and the points moved by it."""
    d = z.shape[1]
    mean = z.mean(axis=0)
    scale = np.sqrt(d) / np.linalg.norm(z - mean, axis=1).mean()
    T = np.eye(d + 1)
    T[:d, :d] *= scale
    T[:d, d] = -scale * mean
    return T, (z - mean) * scale


def triangulate_perspective(cameras: Sequence[PerspectiveCamera], u: Sequence[ArrayLike]) -> np.ndarray:
    """(n, 3) mm by linear triangulation, with one reweighting by the depth."""
    u = [points(pixels, 2, "u") for pixels in u]
    x = None
    for _ in range(2):
        A, b = [], []
        for camera, pixels in zip(cameras, u, strict=True):
            P = camera.matrix
            w = 1.0 if x is None else 1.0 / (x @ P[2, :3] + P[2, 3])[:, None, None]
            A.append(w * (P[:2, :3] - pixels[:, :, None] * P[2, :3]))
            b.append((w if np.isscalar(w) else w[:, :, 0]) * (pixels * P[2, 3] - P[:2, 3]))
        A, b = np.concatenate(A, axis=1), np.concatenate(b, axis=1)
        At = np.swapaxes(A, 1, 2)
        x = np.linalg.solve(At @ A, At @ b[:, :, None])[:, :, 0]
    return x


@dataclass(frozen=True, eq=False)
class Factorisation:
    """Shape (n, 3) and scaled orthographic views `linear` (v, 2, 3), `offset_px` (v, 2), up to a similarity of space.

    `metric` is False where the upgrade's quadric was not positive definite and the nearest one was taken.
    """

    shape: np.ndarray
    linear: np.ndarray
    offset_px: np.ndarray
    metric: bool


def factorise(u: ArrayLike) -> Factorisation:
    """Affine factorisation with the metric upgrade (Tomasi and Kanade 1992; Weinshall and Tomasi 1995 for zooms).

    Parameters
    ----------
    u:
        (v, n, 2) px: n >= 4 rigid points in v >= 3 views.  Pixels must be square; two views leave a one-parameter family of
        shapes (Koenderink and van Doorn), which is why a stereo pair needs the robot, or more views.

    Raises
    ------
    ValueError
        For fewer than three views or four points, NaN, or views whose rotation does not determine the upgrade.
    """
    u = np.asarray(u, dtype=np.float64)
    if u.ndim != 3 or u.shape[2] != 2 or len(u) < 3 or u.shape[1] < 4:
        raise ValueError(f"u: expected (v >= 3, n >= 4, 2) pixels, got {u.shape}.")
    if not np.isfinite(u).all():
        raise ValueError("u: factorisation needs every point in every view; drop points with NaN.")
    offset = u.mean(axis=1)
    W = (u - offset[:, None]).transpose(0, 2, 1).reshape(2 * len(u), -1)
    left, size, right = np.linalg.svd(W, full_matrices=False)
    if size[2] < 1e-9 * size[0]:
        raise ValueError("u: the points are coplanar or the views do not differ; rank 3 is needed.")
    M, S = left[:, :3] * np.sqrt(size[:3]), np.sqrt(size[:3])[:, None] * right[:3]

    def products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Row of the linear system: a^T Q b in the six entries of the symmetric Q."""
        o = np.outer(a, b)
        return np.array([o[0, 0], o[1, 1], o[2, 2], o[0, 1] + o[1, 0], o[0, 2] + o[2, 0], o[1, 2] + o[2, 1]])

    rows = []
    for a, b in M.reshape(-1, 2, 3):
        rows += [products(a, a) - products(b, b), products(a, b)]
    _, sizes, basis = np.linalg.svd(np.array(rows))
    if sizes[4] < 1e-9 * sizes[0]:
        raise ValueError("u: the views do not determine the metric upgrade; rotate about a second axis.")
    q = basis[5]
    Q = np.array([[q[0], q[3], q[4]], [q[3], q[1], q[5]], [q[4], q[5], q[2]]])
    Q *= np.sign(np.trace(Q))
    values, vectors = np.linalg.eigh(Q)
    metric = bool(values[0] > 0)
    values = np.maximum(values, 1e-6 * values[-1])
    upgrade = vectors * np.sqrt(values)
    linear = (M @ upgrade).reshape(-1, 2, 3)
    shape = np.linalg.solve(upgrade, S).T
    return Factorisation(shape, linear, offset, metric)


def similarity(source: ArrayLike, target: ArrayLike) -> np.ndarray:
    """`source` (n, 3) moved onto `target` by the best similarity, a reflection allowed: factorisation fixes neither."""
    a, b = finite_points(source, 3, "source"), finite_points(target, 3, "target")
    a_mean, b_mean = a.mean(axis=0), b.mean(axis=0)
    left, _, right = np.linalg.svd((b - b_mean).T @ (a - a_mean))
    R = left @ right
    moved = (a - a_mean) @ R.T
    return b_mean + moved * ((moved * (b - b_mean)).sum() / (moved**2).sum())
