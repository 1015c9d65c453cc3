"""Has the microscope been moved?  Cumulative sums over what the calibrated rig leaves unexplained, frame by frame."""

from collections import deque

import numpy as np
from numpy.typing import ArrayLike

from lib.cameras import StereoRig
from lib.correspondences import Correspondences
from lib.geometry import pair_covariance

#: What is watched: the mean residual of a frame's landmarks along the directions of the images that lateral shifts move,
#: along the one that a shift in depth moves, and across the epipolar lines; and their chi-square.
AXES = ("lateral", "lateral", "lateral", "lateral", "depth", "epipolar", "scatter")
# Shifts of the tool that are tested for, along the principal directions of the rig; half of them counts as none.
_SHIFT_MM = np.array([[20, 0, 0], [0, 20, 0], [14, 14, 0], [14, -14, 0], [0, 0, 40]]) / 1e3
_SHIFT_SD = (1.0, 8.0)  # of a frame: least and largest shift that a test is made for; the other axes are tested for 2
_FRAMES = 20_000  # between false alarms, if frames erred independently
# Most that one frame adds, of the alarm level: so that neither a single bad frame raises an alarm nor, across and along the
# depth, a detector that is wrong alike for some frames.  That grows with the score between two bounds.
_LEAST, _CAP, _BURST = 0.2, 0.55, (1.0, 1.0, 1.0, 1.0, 0.1, 0.03, 0.03)
_MEMORY = 1000  # frames that tell the noise
_FEW = 40  # frames: with fewer the noise is taken for larger than they say, up to twice
_WANDER = (4, 4, 4, 4, 10, 10, 10)  # frames over which correlated noise counts at least: as many as an alarm takes
_SIDEWAYS, _MOST_ALIKE = np.array(AXES) == "lateral", 0.95  # the most that neighbouring frames are taken to correlate
# By what that raises the variance, before the frames tell: as if so many frames had told it, for few say little of it.
_RAISES, _RAISES_FRAMES = (1.2, 1.2, 1.2, 1.2, 1.0, 1.3, 1.3), 1500
_SLOW = 300  # frames over which the bias is averaged
_UNCERTAIN = 0.7  # standard deviations of the rig that are no drift
_LARGEST_BIAS_PX = 0.5  # of a frame's mean; more is a drift
_FREEDOM = 4.0  # of the Student t of a landmark about the frame's mean: one wrong landmark moves the mean little


class DriftMonitor:
    """CUSUM tests (Page 1954) on the residuals r = u - rig.project(x), one on each axis of `AXES` and to each side.

    The detector's error is biased and correlated in time, and its stated noise may be wrong.  So the bias is the slow mean of
    the residuals, within half a pixel, and the noise is their own long-run standard deviation, which counts correlated frames
    for what they are worth.  A score z is the residual less its bias in this unit.  It adds to the sum S the logarithm of how
    much likelier the shift to be noticed makes it; the alarm level is that of `_FRAMES` frames (Siegmund 1985).
    The noise to start from is `covariance_px2` of (u_left, u_right), a number, (2, 2) or (4, 4) px^2, and `sigma_x_mm` of the
    robot's report, per coordinate.

    Attributes:
        statistic: Largest S after the last frame, in units of its alarm level; above 1 the cameras have moved.
        axis: The axis of `AXES` that it stands on.
        since: Frames since that S was last zero: about how long ago it began.
        score: Largest score of the last frame alone, in standard deviations.
        history: (chi2, degrees of freedom, statistic) of the last 1000 frames.
        inflation: Variance of the mean of many frames over what the stated noise makes it, along the depth.

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
        """Go on with a rig that was registered anew, from a clean slate; the noise stays known."""
        self._bias, self._seen = np.zeros(len(AXES)), 0
        self.forget()
        self.follow(rig)

    def forget(self) -> None:
        """Start the sums anew: what made them large is known."""
        self._sums, self._runs = np.zeros((2, len(AXES))), np.zeros((2, len(AXES)), dtype=int)
        self.statistic, self.axis, self.since, self.score = 0.0, "", 0, 0.0

    def follow(self, rig: StereoRig) -> None:
        """Go on with the same rig, known a little better."""
        self.rig = rig
        u, px_per_mm, _ = np.linalg.svd(rig.linear)
        moves = u[:, :3] * np.maximum(px_per_mm, 1e-9) @ _SHIFT_MM.T  # cameras that look alike see no depth
        self._shift_px = np.linalg.norm(moves, axis=0)
        self._axes = np.vstack([(moves / self._shift_px).T, u[:, 3]])

    def update(
        self, data: Correspondences | ArrayLike, u_left: ArrayLike | None = None, u_right: ArrayLike | None = None,
        covariance_px2: ArrayLike | None = None, rig_px2: ArrayLike | None = None,
    ) -> bool:  # fmt: skip
        """Take in the complete rows of a frame, Correspondences or x_mm (k, 3) and pixels (k, 2); True = the cameras moved.

        Args:
            covariance_px2: (k, 4, 4) noise of this frame's residuals, if it is known better than in general.
            rig_px2: (k, 4, 4) covariance of the rig's projections.  It is large far from the landmarks that the rig was
                calibrated with, and frame after frame errs alike there, which is no drift.
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
            # Wilson and Hilferty 1931: a chi-square as a normal score, so that missing landmarks count alike.
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
        # The bias of few frames is uncertain itself, and so is the rig.
        slack = shift / 2.0 + 1.0 / np.sqrt(self._seen + 10.0) + _UNCERTAIN * rig_sd / self._noise
        signed = np.stack([z, np.append(-z[:-1], 0.0)])  # landmarks that scatter less than usual are no fault
        gain = np.minimum(shift * (signed - slack) / level, np.clip(_BURST * np.abs(z), _LEAST, _CAP))
        self._sums = np.maximum(self._sums + gain, 0.0)
        self._runs = np.where(self._sums > 0, self._runs + 1, 0)
        side, axis = np.unravel_index(np.argmax(self._sums), self._sums.shape)
        self.statistic, self.axis, self.since = float(self._sums[side, axis]), AXES[axis], int(self._runs[side, axis])
        self.score = float(np.abs(z).max())
        # A frame that stands out tells of something else than noise and bias.
        tame = self._bias + np.clip(value - self._bias, -3.0 * self._noise, 3.0 * self._noise)
        self._scores.append(tame - self._bias)
        self._seen += 1
        self._bias = self._bias + (tame - self._bias) * max(1.0 / (self._seen + 10.0), 1.0 / _SLOW)
        if self._seen % 10 == 0:
            self._noise = _long_run_sd(np.array(self._scores), _RAISES_FRAMES)
            self.inflation = float(_long_run_sd(np.array(self._scores))[AXES.index("depth")] ** 2)


def _robust_mean(residual: np.ndarray, weight: np.ndarray) -> np.ndarray:
    share = np.ones(len(residual))
    for _ in range(4):
        total, pull = np.einsum("n,nij->ij", share, weight), np.einsum("n,nij,nj->i", share, weight, residual)
        off = residual - (mean := np.linalg.solve(total, pull))
        share = (_FREEDOM + 4.0) / (_FREEDOM + np.einsum("ni,nij,nj->n", off, weight, off))
    return mean


def _long_run_sd(values: np.ndarray, known: int = 0) -> np.ndarray:
    """(k,) of series (n, k): the standard deviation that independent frames would need for means to scatter as these do.

    The autocovariances are summed under a triangle (Bartlett); `_RAISES` counts for `known` frames beside them.  Sideways a
    detector can err alike for long.  There the triangle is as wide as the correlation of neighbours asks for (Andrews 1991),
    and what it surely shows counts in full.
    """
    n = len(values)
    d = values - values.mean(axis=0)
    variance = (d**2).mean(axis=0)
    rho = np.clip((d[1:] * d[:-1]).sum(axis=0) / n / np.maximum(variance, 1e-12), 0.0, _MOST_ALIKE)
    wide = _SIDEWAYS * 1.1447 * np.cbrt(4.0 * rho**2 / (1.0 - rho**2) ** 2 * n)
    widths, total = np.minimum(np.maximum(_WANDER, wide).astype(int), n // 8), variance.copy()
    for lag in range(1, int(widths.max()) + 1):
        total += 2.0 * np.maximum(1.0 - lag / (widths + 1.0), 0.0) * (d[lag:] * d[:-lag]).sum(axis=0) / n
    sure = _SIDEWAYS * total / (1.0 + 2.0 * np.sqrt(4.0 / 3.0 * widths / n))  # two of its standard deviations less
    few, least = 1.0 + 3.0 / (1.0 + (n / _FEW) ** 2), np.maximum(np.maximum(variance, sure), 0.05)
    return np.sqrt(few * np.maximum((n * total + known * np.array(_RAISES) * variance) / (n + known), least))
