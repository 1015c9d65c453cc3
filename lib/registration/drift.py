"""Detects that the microscope was moved: cumulative sums over the residuals of the calibrated rig, frame by frame."""

from collections import deque

import numpy as np
from numpy.typing import ArrayLike

from lib.cameras import StereoRig
from lib.correspondences import Correspondences
from lib.geometry import pair_covariance

#: The tested quantities: a frame's mean residual along the pixel directions of four lateral shifts and of a shift in depth,
#: and across the epipolar lines; and the chi-square of its landmarks ("scatter").
AXES = ("lateral", "lateral", "lateral", "lateral", "depth", "epipolar", "scatter")
# Shifts of the tool to be detected, mm along the principal directions of the rig; the tests ignore less than half of them.
_SHIFT_MM = np.array([[20, 0, 0], [0, 20, 0], [14, 14, 0], [14, -14, 0], [0, 0, 40]]) / 1e3
_SHIFT_SD = (1.0, 8.0)  # bounds on these shifts in standard deviations of a frame; the last two axes are tested for 2
_FRAMES = 20_000  # mean number of frames between false alarms, if the frames' errors were independent
# Largest share of the alarm level that one frame adds: _BURST times its score, between _LEAST and _CAP.  Then a single bad
# frame raises no alarm; nor do, across the epipolar lines and along the depth, a few frames with the same error.
_LEAST, _CAP, _BURST = 0.2, 0.55, (1.0, 1.0, 1.0, 1.0, 0.1, 0.03, 0.03)
_MEMORY = 1000  # number of frames from which the noise is estimated
_FEW = 40  # with about this many frames or fewer, the estimated standard deviation is raised, by up to a factor of 2
_LEAST_LAGS = (4, 4, 4, 4, 10, 10, 10)  # least number of lags in the long-run variance: as many frames as an alarm takes
_LATERAL, _LARGEST_RHO = np.array(AXES) == "lateral", 0.95  # largest correlation assumed between neighbouring frames
# Prior of the factor by which correlation raises the variance; it counts as many frames, for a few determine it poorly.
_INFLATION, _INFLATION_FRAMES = (1.2, 1.2, 1.2, 1.2, 1.0, 1.3, 1.3), 1500
_SLOW = 300  # number of frames over which the bias is averaged
_RIG_SDS = 0.7  # a shift by this many standard deviations of the rig is no drift
_LARGEST_BIAS_PX = 0.5  # largest bias of a frame's mean; more is a drift
_FREEDOM = 4.0  # degrees of freedom of Student's t for landmarks about the frame's mean: an outlier moves the mean little


class DriftMonitor:
    """CUSUM tests (Page 1954) on the residuals r = u - rig.project(x), for each axis of `AXES` and each sign.

    The detector's error is biased and correlated in time, and its stated noise may be wrong.  So the bias is estimated as a
    slow mean of the residuals, within half a pixel, and the noise as their long-run standard deviation.  It allows for
    correlation over ten frames, laterally over more; errors in depth that last longer raise more false alarms.  The score z
    is the residual minus the bias, divided by the noise.  Each frame adds to a sum S the log likelihood ratio between the
    shift to be detected and none.  The alarm level gives a false alarm every `_FRAMES` frames (Siegmund 1985).  The initial
    noise is `covariance_px2` of (u_left, u_right), a number, (2, 2) or (4, 4) px^2, and `sigma_x_mm` of the robot's report,
    per coordinate.

    Attributes:
        statistic: Largest S after the last frame, in units of its alarm level; above 1 the cameras have moved.
        axis: The axis of `AXES` with this S.
        since: Number of frames since that S was zero: an estimate of how long ago the motion began.
        score: Largest score of the last frame alone, in standard deviations.
        history: (chi2, degrees of freedom, statistic) of the last 1000 frames.
        inflation: Variance of the mean of many frames along the depth, divided by the one that the stated noise implies.

    >>> from lib.cameras import AffineCamera
    >>> camera = AffineCamera([[100, 0, 0, 0], [0, 100, 0, 0]])
    >>> monitor = DriftMonitor(StereoRig(camera, camera), covariance_px2=1.0)
    >>> [monitor.update([[0, 0, 0]], [[u, 0]], [[u, 0]]) for u in (0.5, 9.0, 9.0, 9.0, 9.0)]
    [False, False, False, False, True]
    """

    def __init__(self, rig: StereoRig, *, covariance_px2: ArrayLike, sigma_x_mm: float = 0.010) -> None:
        if not sigma_x_mm >= 0:
            raise ValueError(f"sigma_x_mm: must not be negative, got {sigma_x_mm}.")
        self.covariance_px2, self.sigma_x_mm = pair_covariance(covariance_px2, 1), sigma_x_mm
        self.history: deque[tuple[float, int, float]] = deque(maxlen=1000)
        self._scores: deque[np.ndarray] = deque(maxlen=_MEMORY)
        self._noise, self.inflation = np.full(len(AXES), 2.0), 4.0
        self.reset(rig)

    def reset(self, rig: StereoRig) -> None:
        """Restart with a newly registered rig; only the estimated noise is kept."""
        self._bias, self._seen = np.zeros(len(AXES)), 0
        self.forget()
        self.follow(rig)

    def forget(self) -> None:
        """Restart the sums, for instance because the cause of their rise is known."""
        self._sums, self._runs = np.zeros((2, len(AXES))), np.zeros((2, len(AXES)), dtype=int)
        self.statistic, self.axis, self.since, self.score = 0.0, "", 0, 0.0

    def follow(self, rig: StereoRig) -> None:
        """Continue with a better estimate of the same rig; sums, bias and noise are kept."""
        self.rig = rig
        u, px_per_mm, _ = np.linalg.svd(rig.linear)
        moves = u[:, :3] * np.maximum(px_per_mm, 1e-9) @ _SHIFT_MM.T  # parallel cameras see no depth
        self._shift_px = np.linalg.norm(moves, axis=0)
        self._axes = np.vstack([(moves / self._shift_px).T, u[:, 3]])

    def update(
        self, data: Correspondences | ArrayLike, u_left: ArrayLike | None = None, u_right: ArrayLike | None = None,
        covariance_px2: ArrayLike | None = None, rig_px2: ArrayLike | None = None,
    ) -> bool:  # fmt: skip
        """Add the complete rows of a frame, Correspondences or x_mm (k, 3) and pixels (k, 2); True = the cameras moved.

        Args:
            covariance_px2: (k, 4, 4) noise of this frame's residuals; None = the usual noise.
            rig_px2: (k, 4, 4) covariance of the rig's projections.  It is large far from the landmarks that the rig was
                calibrated with; there successive frames have the same error without any drift.
        """
        data = data if isinstance(data, Correspondences) else Correspondences.of_points(data, u_left, u_right)
        usual = self.covariance_px2 + self.sigma_x_mm**2 * self.rig.linear @ self.rig.linear.T
        covariance = usual if covariance_px2 is None else pair_covariance(covariance_px2, len(data))
        used, uncertain = data.is_complete, np.zeros((4, 4)) if rig_px2 is None else np.asarray(rig_px2)
        covariance, uncertain = (np.broadcast_to(c, (len(used), 4, 4))[used] for c in (covariance, uncertain))
        covariance, data = covariance + uncertain, data.subset(used)
        if not np.isfinite(covariance).all():
            raise ValueError("covariance_px2: must be finite for every landmark that both images show.")
        residual = data.stacked_px - np.hstack(self.rig.project(data.x_mm))
        chi2 = 0.0
        if len(residual):
            weight = np.linalg.inv(covariance)
            chi2 = float(np.einsum("ni,nij,nj->", residual, weight, residual))
            sd = np.sqrt(np.diag(self._axes @ np.linalg.inv(weight.sum(axis=0)) @ self._axes.T))
            # Wilson and Hilferty 1931: the chi-square as a normal score, which allows for the number of landmarks.
            spread = 2.0 / (9.0 * residual.size)
            scatter = (np.cbrt(chi2 / residual.size) - (1.0 - spread)) / np.sqrt(spread)
            rig_sd = np.sqrt(np.diag(self._axes @ uncertain.mean(axis=0) @ self._axes.T)) / sd
            self._add(np.append(self._axes @ _robust_mean(residual, weight) / sd, scatter), sd, np.append(rig_sd, 0.0))
        self.history.append((chi2, residual.size, self.statistic))
        return self.statistic > 1.0

    def _add(self, value: np.ndarray, sd: np.ndarray, rig_sd: np.ndarray) -> None:
        largest_bias = _LARGEST_BIAS_PX / np.append(sd, sd.min())
        z = (value - np.clip(self._bias, -largest_bias, largest_bias)) / self._noise
        shift = np.append(np.clip(self._shift_px / (sd[:-1] * self._noise[:-2]), *_SHIFT_SD), (2.0, 2.0))
        level = np.log(2 * len(AXES) * _FRAMES * shift**2 / 2.0) - 1.166 * shift
        # Allow for the uncertainty of the bias after few frames, and for that of the rig.
        slack = shift / 2.0 + 1.0 / np.sqrt(self._seen + 10.0) + _RIG_SDS * rig_sd / self._noise
        signed = np.stack([z, np.append(-z[:-1], 0.0)])  # less scatter than usual is no fault
        gain = np.minimum(shift * (signed - slack) / level, np.clip(_BURST * np.abs(z), _LEAST, _CAP))
        self._sums = np.maximum(self._sums + gain, 0.0)
        self._runs = np.where(self._sums > 0, self._runs + 1, 0)
        side, axis = np.unravel_index(np.argmax(self._sums), self._sums.shape)
        self.statistic, self.axis, self.since = float(self._sums[side, axis]), AXES[axis], int(self._runs[side, axis])
        self.score = float(np.abs(z).max())
        # Clip outlying frames, which are neither noise nor bias.
        clipped = self._bias + np.clip(value - self._bias, -3.0 * self._noise, 3.0 * self._noise)
        self._scores.append(clipped - self._bias)
        self._seen += 1
        self._bias = self._bias + (clipped - self._bias) * max(1.0 / (self._seen + 10.0), 1.0 / _SLOW)
        if self._seen % 10 == 0:
            self._noise = _long_run_sd(np.array(self._scores), _INFLATION_FRAMES)
            self.inflation = float(_long_run_sd(np.array(self._scores))[AXES.index("depth")] ** 2)


def _robust_mean(residual: np.ndarray, weight: np.ndarray) -> np.ndarray:
    share = np.ones(len(residual))
    for _ in range(4):
        total, pull = np.einsum("n,nij->ij", share, weight), np.einsum("n,nij,nj->i", share, weight, residual)
        off = residual - (mean := np.linalg.solve(total, pull))
        share = (_FREEDOM + 4.0) / (_FREEDOM + np.einsum("ni,nij,nj->n", off, weight, off))
    return mean


def _long_run_sd(values: np.ndarray, known: int = 0) -> np.ndarray:
    """Long-run standard deviation (k,) of series (n, k): that of independent values whose means scatter as much.

    It sums the autocovariances with a triangular window (Bartlett).  The prior `_INFLATION` counts as `known` frames.
    Laterally a detector's error can last for long.  There the window's width follows from the correlation of neighbours
    (Andrews 1991), and a lower confidence bound of the sum limits the result from below.
    """
    n = len(values)
    d = values - values.mean(axis=0)
    variance = (d**2).mean(axis=0)
    rho = np.clip((d[1:] * d[:-1]).sum(axis=0) / n / np.maximum(variance, 1e-12), 0.0, _LARGEST_RHO)
    wide = _LATERAL * 1.1447 * np.cbrt(4.0 * rho**2 / (1.0 - rho**2) ** 2 * n)
    widths, total = np.minimum(np.maximum(_LEAST_LAGS, wide).astype(int), n // 8), variance.copy()
    for lag in range(1, int(widths.max()) + 1):
        total += 2.0 * np.maximum(1.0 - lag / (widths + 1.0), 0.0) * (d[lag:] * d[:-lag]).sum(axis=0) / n
    bound = _LATERAL * total / (1.0 + 2.0 * np.sqrt(4.0 / 3.0 * widths / n))  # two standard deviations of `total` lower
    few, least = 1.0 + 3.0 / (1.0 + (n / _FEW) ** 2), np.maximum(np.maximum(variance, bound), 0.05)
    return np.sqrt(few * np.maximum((n * total + known * np.array(_INFLATION) * variance) / (n + known), least))
