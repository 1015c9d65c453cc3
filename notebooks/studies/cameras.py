"""Perspective cameras by DLT, with which the studies compare affine ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import rq

from lib.geometry import finite_points, points


def rms(error: ArrayLike) -> float:
    """Root mean square of the lengths of vectors (n, k)."""
    return float(np.sqrt((np.asarray(error) ** 2).sum(axis=1).mean()))


@dataclass(frozen=True, eq=False)
class PerspectiveCamera:
    """A perspective camera: u is P [x; 1], dehomogenised, with the `matrix` P (3, 4)."""

    matrix: np.ndarray

    def project(self, x: ArrayLike) -> np.ndarray:
        """Pixels (n, 2) of points (n, 3) mm."""
        x = points(x, 3, "x_mm")
        h = x @ self.matrix[:, :3].T + self.matrix[:, 3]
        return h[:, :2] / h[:, 2:]

    def decompose(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """K (3, 3) with positive diagonal and K[2, 2] = 1, R (3, 3) rotation, camera centre (3,) mm, by RQ."""
        P = self.matrix * np.sign(np.linalg.det(self.matrix[:, :3]))
        K, R = rq(P[:, :3])
        signs = np.diag(np.sign(np.diag(K)))
        K, R = K @ signs, signs @ R
        return K / K[2, 2], R, -np.linalg.solve(P[:, :3], P[:, 3])


def perspective_dlt(x_mm: ArrayLike, u: ArrayLike) -> PerspectiveCamera:
    """Normalised DLT of a perspective camera (Hartley and Zisserman, Alg. 7.1).

    Parameters
    ----------
    x_mm, u:
        (n, 3) and (n, 2) px, n >= 6, not coplanar.

    Raises
    ------
    ValueError
        If a row is not finite, or there are fewer than six.
    """
    x, u = finite_points(x_mm, 3, "x_mm"), finite_points(u, 2, "u")
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
    """The similarity to zero mean and mean distance sqrt(dimension), and the points transformed by it."""
    d = z.shape[1]
    mean = z.mean(axis=0)
    scale = np.sqrt(d) / np.linalg.norm(z - mean, axis=1).mean()
    T = np.eye(d + 1)
    T[:d, :d] *= scale
    T[:d, d] = -scale * mean
    return T, (z - mean) * scale


def triangulate_perspective(cameras: Sequence[PerspectiveCamera], u: Sequence[ArrayLike]) -> np.ndarray:
    """Points (n, 3) mm from pixels (n, 2) of each camera: linear triangulation, repeated with weights by depth."""
    u = [points(pixels, 2, "u") for pixels in u]
    weights = [np.ones(len(pixels)) for pixels in u]
    for _ in range(2):
        A, b = [], []
        for camera, pixels, w in zip(cameras, u, weights, strict=True):
            P = camera.matrix
            A.append(w[:, None, None] * (P[:2, :3] - pixels[:, :, None] * P[2, :3]))
            b.append(w[:, None] * (pixels * P[2, 3] - P[:2, 3]))
        A, b = np.concatenate(A, axis=1), np.concatenate(b, axis=1)
        At = np.swapaxes(A, 1, 2)
        x = np.linalg.solve(At @ A, At @ b[:, :, None])[:, :, 0]
        weights = [1.0 / (x @ camera.matrix[2, :3] + camera.matrix[2, 3]) for camera in cameras]
    return x
