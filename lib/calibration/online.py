"""Calibration frame by frame: fold new rows into the moments, let old ones fade, solve again."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lib.calibration.affine import Moments, affine_minimum
from lib.calibration.robust import gate
from lib.cameras import AffineCamera, StereoRig
from lib.geometry import points

__all__ = ["OnlineCalibration"]


class OnlineCalibration:
    """The affine minimum of all rows so far, older ones weighed down, in constant time and memory.

    Parameters
    ----------
    sigma_u_px, sigma_x_mm:
        Noise levels; they weigh the terms and gate outliers.
    forgetting:
        Weight that remains of the past after each `add`, in (0, 1]; 1 forgets nothing.
    """

    def __init__(self, *, sigma_u_px: float = 1.0, sigma_x_mm: float = 0.010, forgetting: float = 1.0) -> None:
        if not (sigma_u_px > 0 and sigma_x_mm >= 0):
            raise ValueError("sigma_u_px, sigma_x_mm: must be positive.")
        if not 0 < forgetting <= 1:
            raise ValueError(f"forgetting: must lie in (0, 1], got {forgetting}.")
        self.sigma_u_px, self.sigma_x_mm, self.forgetting = sigma_u_px, sigma_x_mm, forgetting
        self.moments: Moments | None = None
        self._matrix: np.ndarray | None = None

    @property
    def ready(self) -> bool:
        """True as soon as the rows span a volume well beyond the robot's accuracy."""
        if self.moments is None or self.moments.weight < 6:
            return False
        thickness = np.sqrt(max(np.linalg.eigvalsh(self.moments.scatter[-3:, -3:])[0], 0.0) / self.moments.weight)
        return bool(thickness > max(5.0 * self.sigma_x_mm, 1e-9))

    def add(self, x_mm: ArrayLike, u_left: ArrayLike, u_right: ArrayLike) -> np.ndarray:
        """Fold in the rows of a frame; rows with NaN, and rows beyond the gate once `ready`, are left out.

        Returns
        -------
        (n,) bool, the rows used.
        """
        x = points(x_mm, 3, "x_mm")
        y = np.hstack([points(u_left, 2, "u_left"), points(u_right, 2, "u_right")])
        if len(x) != len(y):
            raise ValueError(f"x_mm, u: {len(x)} and {len(y)} rows; correspondences go row by row.")
        used = np.isfinite(x).all(axis=1) & np.isfinite(y).all(axis=1)
        if self.ready and used.any():
            matrix = self._solve()
            A = matrix[:, :3]
            r = np.where(used[:, None], y - x @ A.T - matrix[:, 3], 0.0)
            # A new row's residual also has the calibration's own uncertainty: (1 + leverage) S.
            d = x - self.moments.mean[4:]
            inverse = np.linalg.inv(self.moments.scatter[4:, 4:])
            leverage = 1.0 / self.moments.weight + np.einsum("ni,ij,nj->n", d, inverse, d)
            S = self.sigma_u_px**2 * np.eye(4) + self.sigma_x_mm**2 * A @ A.T
            distance2 = np.einsum("ni,ij,nj->n", r, np.linalg.inv(S), r) / (1.0 + leverage)
            used &= distance2 < gate(100, 4)
        if self.moments is not None:
            self.moments = self.moments.faded(self.forgetting)
        if used.any():
            new = Moments.of(x[used], y[used])
            self.moments = new if self.moments is None else self.moments.merged(new)
            self._matrix = None
        return used

    def solve(self) -> StereoRig:
        """The rig of the rows so far.

        Raises
        ------
        ValueError
            While the rows do not span a volume.
        """
        if not self.ready:
            raise ValueError("OnlineCalibration: the rows so far do not span a volume; add frames at other positions.")
        matrix = self._solve()
        return StereoRig(AffineCamera(matrix[:2]), AffineCamera(matrix[2:]))

    @property
    def covariance(self) -> np.ndarray:
        """(16, 16) of the matrices' entries, left row by row, then right: S (x) (H^T H)^-1."""
        rig = self.solve()
        S = self.sigma_u_px**2 * np.eye(4) + self.sigma_x_mm**2 * rig.linear @ rig.linear.T
        mean, n = self.moments.mean[4:], self.moments.weight
        HtH = np.zeros((4, 4))
        HtH[:3, :3] = self.moments.scatter[4:, 4:] + n * np.outer(mean, mean)
        HtH[:3, 3] = HtH[3, :3] = n * mean
        HtH[3, 3] = n
        return np.kron(S, np.linalg.inv(HtH))

    def _solve(self) -> np.ndarray:
        if self._matrix is None:
            self._matrix = affine_minimum(self.moments, self.sigma_u_px**2, self.sigma_x_mm**2).matrix
        return self._matrix
