"""Calibration frame by frame: fold new rows into the moments, let old ones fade, solve again."""

import numpy as np
from numpy.typing import ArrayLike

from lib.calibration.affine import Moments, affine_minimum, distances2
from lib.calibration.robust import consensus, gate
from lib.cameras import AffineCamera, StereoRig
from lib.correspondences import Correspondences
from lib.geometry import points

__all__ = ["OnlineCalibration"]

_START_ROWS = 30  # that must agree on a rig before single rows are judged by it
_MOST_ROWS = 240  # kept until then
_CHI2_4_MEDIAN = 3.357


class OnlineCalibration:
    """The affine minimum of all rows so far, older ones weighed down, in constant time and memory.

    The first rows are kept and judged together; from then on a row is judged by the rig of those before it.

    Args:
        sigma_u_px, sigma_x_mm: Noise levels; they weigh the terms and judge the rows.
        forgetting: Weight that remains of the past after each `add`, in (0, 1]; 1 forgets nothing.

    Attributes:
        moments: Of the rows used, None before they agree on a rig.
        rejected_share: Of about the 100 newest rows; near 1 where the cameras moved or the noise levels are wrong.

    >>> rng, A = np.random.default_rng(0), np.array([[99.0, 0, 9], [0, 99, 0], [99, 0, -9], [0, 99, 0]])
    >>> online = OnlineCalibration()
    >>> for _ in range(20):
    ...     x = rng.uniform(-4, 4, (3, 3))
    ...     y = x @ A.T + rng.normal(0, 1, (3, 4))
    ...     _ = online.add(x, y[:, :2], y[:, 2:])
    >>> online.ready, online.solve().linear.round(0)[0].tolist()
    (True, [99.0, 0.0, 9.0])
    """

    def __init__(self, *, sigma_u_px: float = 1.0, sigma_x_mm: float = 0.010, forgetting: float = 1.0) -> None:
        if not (sigma_u_px > 0 and sigma_x_mm >= 0):
            raise ValueError("sigma_u_px, sigma_x_mm: must be positive.")
        if not 0 < forgetting <= 1:
            raise ValueError(f"forgetting: must lie in (0, 1], got {forgetting}.")
        self.sigma_u_px, self.sigma_x_mm, self.forgetting = sigma_u_px, sigma_x_mm, forgetting
        self.moments: Moments | None = None
        self.rejected_share = 0.0
        self._first: np.ndarray | None = np.empty((0, 7))  # rows (x, y) until they agree on a rig

    @property
    def ready(self) -> bool:
        """True as soon as rows that agree span a volume well beyond the robot's accuracy."""
        return self.moments is not None and self.moments.weight >= 8 and self._spans(self.moments)

    def add(
        self, data: Correspondences | ArrayLike, u_left: ArrayLike | None = None, u_right: ArrayLike | None = None
    ) -> np.ndarray:
        """Fold in the rows of a frame, and return which were used (n,): the complete ones that are not judged wrong.

        `data` is Correspondences; or positions (n, 3) mm, with `u_left` and `u_right` (n, 2) px, NaN where missing.
        """
        complete = True
        if isinstance(data, Correspondences):
            data, u_left, u_right, complete = data.x_mm, data.u_left, data.u_right, data.is_complete
        x = points(data, 3, "x_mm")
        y = np.hstack([points(u_left, 2, "u_left"), points(u_right, 2, "u_right")])
        if len(x) != len(y):
            raise ValueError(f"x_mm, u: {len(x)} and {len(y)} rows; correspondences go row by row.")
        used = complete & np.isfinite(np.hstack([x, y])).all(axis=1)
        if not used.any():
            return used
        right = self._start(x[used], y[used]) if self._first is not None else self._fold(x[used], y[used])
        for fine in right:
            self.rejected_share += 0.01 * (float(not fine) - self.rejected_share)
        used[used] = right
        return used

    def _start(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Judge all rows so far together."""
        self._first = np.vstack([self._first, np.hstack([x, y])])
        first_x, first_y, keep = self._first[:, :3], self._first[:, 3:], np.ones(len(self._first), dtype=bool)
        if len(keep) >= 8 and self._spans(Moments.of(first_x, first_y)):
            try:
                keep = consensus(first_x, first_y, None, np.random.default_rng(0), sigma_x_mm=self.sigma_x_mm)[0].all(axis=1)
                rows = first_x[keep], first_y[keep]
                # Few rows may agree by chance, but not to the noise that is known.
                keep &= bool(keep.any()) and np.median(self._distances2(*rows)) < 9.0 * _CHI2_4_MEDIAN
            except ValueError:  # nothing agrees yet
                keep[:] = False
        self.moments = Moments.of(first_x[keep], first_y[keep]) if keep.any() else None
        if len(keep) >= _START_ROWS and self.ready:
            self._first = None
        elif len(keep) > _MOST_ROWS:
            self._first = self._first[::2]
        return keep[-len(x) :]

    def _distances2(self, x: np.ndarray, y: np.ndarray, moments: Moments | None = None) -> np.ndarray:
        """Squared Mahalanobis distances (n,) of rows to the rig of `moments`, their own if None."""
        matrix = affine_minimum(moments or Moments.of(x, y), self.sigma_u_px**2, self.sigma_x_mm**2).matrix
        return distances2(y - x @ matrix[:, :3].T - matrix[:, 3], matrix[:, :3], self.sigma_u_px, self.sigma_x_mm)

    def _fold(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Judge the rows by the rig of those before, and add them to the moments."""
        # A new row's residual also has the calibration's own uncertainty: (1 + leverage) S.
        d = x - self.moments.mean[4:]
        leverage = 1.0 / self.moments.weight + np.einsum("ni,ij,nj->n", d, np.linalg.inv(self.moments.scatter[4:, 4:]), d)
        right = self._distances2(x, y, self.moments) / (1.0 + leverage) < gate(100, 4)
        self.moments = self.moments.faded(self.forgetting)
        if right.any():
            self.moments = self.moments.merged(Moments.of(x[right], y[right]))
        return right

    def solve(self) -> StereoRig:
        """The rig of the rows so far; a ValueError while they do not span a volume."""
        if not self.ready:
            raise ValueError("OnlineCalibration: the rows so far do not span a volume; add frames at other positions.")
        matrix = affine_minimum(self.moments, self.sigma_u_px**2, self.sigma_x_mm**2).matrix
        return StereoRig(AffineCamera(matrix[:2]), AffineCamera(matrix[2:]))

    @property
    def covariance(self) -> np.ndarray:
        """(16, 16) of the matrices' entries, left row by row, then right: S (x) (H^T H)^-1."""
        rig = self.solve()
        S = self.sigma_u_px**2 * np.eye(4) + self.sigma_x_mm**2 * rig.linear @ rig.linear.T
        h = np.append(self.moments.mean[4:], 1.0)
        HtH = self.moments.weight * np.outer(h, h)
        HtH[:3, :3] += self.moments.scatter[4:, 4:]
        return np.kron(S, np.linalg.inv(HtH))

    def _spans(self, moments: Moments) -> bool:
        thickness = np.sqrt(max(np.linalg.eigvalsh(moments.scatter[-3:, -3:])[0], 0.0) / moments.weight)
        return bool(thickness > max(5.0 * self.sigma_x_mm, 1e-9))
