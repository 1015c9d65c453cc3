"""A calibration that goes on: fold each new frame into the moments, and solve again in constant time and memory."""

import numpy as np

from lib.calibration.affine import Moments, affine_minimum
from lib.calibration.calibration import Calibration
from lib.calibration.robust import gate
from lib.cameras import AffineCamera, StereoRig
from lib.correspondences import Correspondences

__all__ = ["OnlineCalibration"]


class OnlineCalibration:
    """The affine minimum of a calibration's rows and of all that came since.

    Args:
        calibration: Where it starts: its rows that both images show, and its noise levels, which judge the new ones.

    >>> from lib.calibration import calibrate
    >>> rng, A = np.random.default_rng(0), np.array([[99.0, 0, -9], [0, 99, 0], [99, 0, 9], [0, 99, 0]])
    >>> x = rng.uniform(-4, 4, (60, 3))
    >>> y = x @ A.T + rng.normal(0, 1, (60, 4))
    >>> online = OnlineCalibration(calibrate(x[:30], [y[:30, :2], y[:30, 2:]]))
    >>> int(online.add(Correspondences.of_points(x[30:], y[30:, :2], y[30:, 2:])).sum())
    30
    >>> online.solve().linear[0].round().astype(int).tolist()
    [99, 0, -9]
    """

    def __init__(self, calibration: Calibration) -> None:
        self.sigma_u_px, self.sigma_x_mm = calibration.sigma_u_px, calibration.sigma_x_mm
        rows = calibration.view_inliers.all(axis=1)
        self.moments = self._first = Moments.of(calibration.x_mm[rows], calibration.y_px[rows])

    def add(self, data: Correspondences) -> np.ndarray:
        """Fold in the rows of a frame, and return which were used (n,): complete ones that the rig so far does not refuse."""
        used = data.is_complete
        x, y = data.x_mm[used], np.hstack([data.u_left, data.u_right])[used]
        # A new row's residual also has the calibration's own uncertainty: (1 + leverage) S.
        leverage = _leverage(self.moments, x)
        A = self._matrix[:, :3]
        r, S = y - x @ A.T - self._matrix[:, 3], self.sigma_u_px**2 * np.eye(4) + self.sigma_x_mm**2 * A @ A.T
        right = np.einsum("ni,ij,nj->n", r, np.linalg.inv(S), r) / (1.0 + leverage) < gate(100, 4)
        if right.any():
            self.moments = self.moments.merged(Moments.of(x[right], y[right]))
        used[used] = right
        return used

    def remains(self, x_mm: np.ndarray) -> np.ndarray:
        """(n,) of the variance of the calibration's projections of x_mm (n, 3), what the rows since then have left."""
        return _leverage(self.moments, x_mm) / _leverage(self._first, x_mm)

    @property
    def _matrix(self) -> np.ndarray:
        return affine_minimum(self.moments, self.sigma_u_px**2, self.sigma_x_mm**2).matrix

    def solve(self) -> StereoRig:
        """The rig of the rows so far."""
        matrix = self._matrix
        return StereoRig(AffineCamera(matrix[:2]), AffineCamera(matrix[2:]))


def _leverage(moments: Moments, x_mm: np.ndarray) -> np.ndarray:
    d = x_mm - moments.mean[4:]
    return 1.0 / moments.weight + np.einsum("ni,ij,nj->n", d, np.linalg.inv(moments.scatter[4:, 4:]), d)
