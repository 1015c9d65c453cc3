"""Has the microscope been moved?  A cumulative sum of how badly the calibrated rig explains each frame."""

from collections import deque

import numpy as np
from numpy.typing import ArrayLike

from lib.cameras import StereoRig
from lib.correspondences import Correspondences
from lib.geometry import pair_covariance

__all__ = ["DriftMonitor"]


class DriftMonitor:
    """CUSUM test (Page 1954) on the chi-square of the landmarks' reprojection, frame by frame.

    A frame's chi^2 sums r^T C^-1 r over its landmarks, r = u - rig.project(x), C = covariance + sigma_x^2 A A^T.  It is
    turned to a standard normal score z (Wilson and Hilferty 1931), so that frames with missing landmarks count alike,
    and S <- max(0, S + min(z, cap) - slack).  S above `threshold` says that the cameras moved.

    Args:
        rig:
            As calibrated or last registered.
        covariance_px2, sigma_x_mm:
            Noise: of (u_left, u_right), a number, (2, 2) or (4, 4) px^2; and of the robot's report, per coordinate.
        slack, threshold, cap:
            Score that still counts as no change, half of the shift that should be noticed; alarm level; and largest score
            of one frame, below threshold + slack so that a single bad detection raises no alarm.  With the defaults a false
            alarm comes less than once in a million frames, once in ten thousand where the noise is 10 % larger than stated.

        `statistic` is S after the last frame, `history` has (chi2, degrees of freedom, S) of the last 1000 frames.  A
        covariance that is not positive definite raises a ValueError: it would hide every drift.

    >>> from lib.cameras import AffineCamera
    >>> camera = AffineCamera([[100, 0, 0, 0], [0, 100, 0, 0]])
    >>> monitor = DriftMonitor(StereoRig(camera, camera), covariance_px2=1.0)
    >>> [monitor.update([[0, 0, 0]], [[u, 0]], [[u, 0]]) for u in (0.5, 9.0, 9.0)]
    [False, False, True]
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
        if not (0 < slack < cap and threshold > 0 and sigma_x_mm >= 0):
            raise ValueError("slack, threshold, cap, sigma_x_mm: need 0 < slack < cap, threshold > 0, sigma_x_mm >= 0.")
        self.covariance_px2, self.sigma_x_mm = pair_covariance(covariance_px2, 1), sigma_x_mm
        self.slack, self.threshold, self.cap = slack, threshold, cap
        self.history: deque[tuple[float, int, float]] = deque(maxlen=1000)
        self.reset(rig)

    def reset(self, rig: StereoRig) -> None:
        """Go on with another rig, from a clean slate; `history` stays."""
        self.rig, self.statistic = rig, 0.0

    def update(
        self,
        data: Correspondences | ArrayLike,
        u_left: ArrayLike | None = None,
        u_right: ArrayLike | None = None,
        covariance_px2: ArrayLike | None = None,
    ) -> bool:
        """Take in one frame; True = the cameras have moved.

        Args:
            data, u_left, u_right: The frame's Correspondences; or x_mm (k, 3) and pixels (k, 2).  Incomplete rows are
                left out.
            covariance_px2: (k, 4, 4) of the residuals of this frame, if it is known better than in general: where the
                rig itself is uncertain, far from the landmarks that it was calibrated with.
        """
        data = data if isinstance(data, Correspondences) else Correspondences.of_points(data, u_left, u_right)
        if covariance_px2 is None:
            covariance = self.covariance_px2 + self.sigma_x_mm**2 * self.rig.linear @ self.rig.linear.T
        else:
            covariance = pair_covariance(covariance_px2, len(data))
        used = data.is_complete
        covariance, data = np.broadcast_to(covariance, (len(used), 4, 4))[used], data.subset(used)
        if not np.isfinite(covariance).all():
            raise ValueError("covariance_px2: must be finite for every landmark that both images show.")
        residual = np.hstack([data.u_left, data.u_right]) - np.hstack(self.rig.project(data.x_mm))
        freedom = residual.size
        chi2 = float((residual * np.linalg.solve(covariance, residual[:, :, None])[:, :, 0]).sum())
        if freedom:
            spread = 2.0 / (9.0 * freedom)
            score = (np.cbrt(chi2 / freedom) - (1.0 - spread)) / np.sqrt(spread)
            self.statistic = max(0.0, self.statistic + min(score, self.cap) - self.slack)
        self.history.append((chi2, freedom, self.statistic))
        return self.statistic > self.threshold
