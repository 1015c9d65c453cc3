"""Has the microscope been moved?  A cumulative sum of how badly the calibrated rig explains each frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lib.cameras import StereoRig
from lib.geometry import points
from lib.registration.images import stack_covariance

__all__ = ["DriftMonitor"]


class DriftMonitor:
    """CUSUM test (Page 1954) on the chi-square of the landmarks' reprojection, frame by frame.

    A frame's chi^2 sums r^T C^-1 r over its landmarks, r = u - rig.project(x), C = covariance + sigma_x^2 A A^T.  It is
    turned to a standard normal score z (Wilson and Hilferty 1931), so that frames with missing landmarks count alike,
    and S <- max(0, S + min(z, cap) - slack).  S above `threshold` says that the cameras moved.

    Parameters
    ----------
    rig:
        As calibrated or last registered.
    covariance_px2:
        Of (u_left, u_right): a number, (2, 2) or (4, 4).
    sigma_x_mm:
        Standard deviation of the robot's report, per coordinate.
    slack:
        Score that still counts as no change; half of the shift that should be noticed.
    threshold:
        Alarm level.  With the defaults a false alarm comes less than once in a million frames, once in ten thousand
        where the noise is 10 % larger than said.
    cap:
        Largest score of one frame, below `threshold` + `slack` so that a single bad detection raises no alarm.

    Attributes
    ----------
    statistic:
        S after the last frame.
    history:
        (chi2, degrees of freedom, S) of every frame.
    """

    def __init__(
        self,
        rig: StereoRig,
        *,
        covariance_px2: ArrayLike,
        sigma_x_mm: float = 0.010,
        slack: float = 1.0,
        threshold: float = 8.0,
        cap: float = 6.0,
    ) -> None:
        if not 0 < slack < cap or not threshold > 0:
            raise ValueError("slack, threshold, cap: need 0 < slack < cap and threshold > 0.")
        self.covariance_px2 = stack_covariance(covariance_px2, 1)[0]
        self.sigma_x_mm = float(sigma_x_mm)
        self.slack, self.threshold, self.cap = float(slack), float(threshold), float(cap)
        self.history: list[tuple[float, int, float]] = []
        self.reset(rig)

    def reset(self, rig: StereoRig) -> None:
        """Go on with another rig, from a clean slate; `history` stays."""
        self.rig = rig
        self.statistic = 0.0
        self._covariance = self.covariance_px2 + self.sigma_x_mm**2 * rig.linear @ rig.linear.T

    @property
    def alarm(self) -> bool:
        """True while the statistic is above the threshold."""
        return self.statistic > self.threshold

    def update(
        self, x_mm: ArrayLike, u_left: ArrayLike, u_right: ArrayLike, covariance_px2: ArrayLike | None = None
    ) -> bool:
        """Take in one frame; True = the cameras have moved.

        Parameters
        ----------
        x_mm, u_left, u_right:
            (k, 3) mm and (k, 2) px: the frame's landmarks; rows with NaN are left out.  A frame without any changes
            nothing.
        covariance_px2:
            (k, 4, 4) of the residuals of this frame, if it is known better than in general: where the rig itself is
            uncertain, far from the landmarks that it was calibrated with.
        """
        x = points(x_mm, 3, "x_mm")
        y = np.hstack([points(u_left, 2, "u_left"), points(u_right, 2, "u_right")])
        residual = y - np.hstack(self.rig.project(x))
        covariance = stack_covariance(self._covariance if covariance_px2 is None else covariance_px2, len(x))
        seen = np.isfinite(residual).all(axis=1)
        residual = residual[seen]
        freedom = residual.size
        chi2 = float((residual * np.linalg.solve(covariance[seen], residual[:, :, None])[:, :, 0]).sum())
        if freedom:
            spread = 2.0 / (9.0 * freedom)
            score = (np.cbrt(chi2 / freedom) - (1.0 - spread)) / np.sqrt(spread)
            self.statistic = max(0.0, self.statistic + min(score, self.cap) - self.slack)
        self.history.append((chi2, freedom, self.statistic))
        return self.alarm
