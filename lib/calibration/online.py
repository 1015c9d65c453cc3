"""A calibration that goes on: each new frame moves it by one step, in constant time and memory."""

import numpy as np

from lib.calibration.calibration import Calibration
from lib.calibration.robust import gate
from lib.cameras import StereoRig
from lib.correspondences import Correspondences
from lib.geometry import precision, view_distances2
from lib.least_squares import inverse


class OnlineCalibration:
    """A calibration's minimum, moved by all rows that came since: an extended Kalman filter of the model's parameters.

    It has the calibration's camera model, and its information from the calibration's rows; each new row counts by its own
    covariance, or the calibration's where it states none.  So it starts where the calibration ended, and the calibration's
    noise levels judge the new rows.

    >>> from lib.calibration import calibrate
    >>> rng, A = np.random.default_rng(0), np.array([[99.0, 0, -9], [0, 99, 0], [99, 0, 9], [0, 99, 0]])
    >>> x = rng.uniform(-4, 4, (60, 3))
    >>> y = x @ A.T + rng.normal(0, 1, (60, 4))
    >>> online = OnlineCalibration(calibrate(x[:30], [y[:30, :2], y[:30, 2:]]))
    >>> int(online.add(Correspondences.of_points(x[30:], y[30:, :2], y[30:, 2:])).sum())
    60
    >>> online.solve().linear[0].round().astype(int).tolist()
    [99, 0, -9]
    """

    def __init__(self, calibration: Calibration) -> None:
        self._calibration, self._state = calibration, calibration.minimum.state
        self._information = calibration.minimum.information
        self._covariance = self._first = inverse(self._information)

    def add(self, data: Correspondences) -> np.ndarray:
        """Fold in the rows of a frame; returns the views (n, 2) bool that were used, those the rig so far does not refuse."""
        known, variance_x = self._calibration, self._calibration.sigma_x_mm**2
        used = data.seen & np.isfinite(data.x_mm).all(axis=1, keepdims=True)
        pixels, noise = data.stacked_px, known.detection_covariance(data)
        x = np.where(used.any(axis=1, keepdims=True), data.x_mm, self._state.reference)
        y, J_x, J = self._state.evaluate(x)
        r, S = np.where(np.repeat(used, 2, axis=1), pixels - y, 0.0), noise + variance_x * J_x @ J_x.mT
        used &= view_distances2(r, S + J @ self._covariance @ J.mT) < gate(100, 2)  # the rig is uncertain itself
        if used.any():
            W = precision(S, used)
            # The derivatives belong to the corrected points, as in `fit`: those of noisy ones would flatten the depth.
            moved = variance_x * np.einsum("nij,nik,nk->nj", J_x, W, r)
            y, J_x, J = self._state.evaluate(x + moved)
            r = np.where(np.repeat(used, 2, axis=1), pixels - y + np.einsum("nij,nj->ni", J_x, moved), 0.0)
            WJ = W @ J
            self._information = self._information + np.einsum("nip,niq->pq", J, WJ)
            self._covariance = inverse(self._information)
            self._state = self._state.moved(self._covariance @ np.einsum("nip,ni->p", WJ, r))
        return used

    def remains(self, x_mm: np.ndarray) -> np.ndarray:
        """(n,) of the variance of the calibration's projections of x_mm (n, 3), what the rows since then have left."""
        J = self._state.evaluate(x_mm)[2]
        now, first = (np.einsum("nip,pq,niq->n", J, known, J) for known in (self._covariance, self._first))
        return now / first

    def solve(self) -> StereoRig:
        """The rig of the rows so far."""
        return StereoRig(*self._state.cameras())
