"""Fits of hypotheses about a recording's fault: affine cameras plus additional terms under heavy-tailed noise; the evidence.

The residual of a row in one image has a bivariate Student t density.  Its scale and degrees of freedom are fitted as well, so
that a fault shows even if 30 % of the landmarks are wrong.  All fits include constant offsets of the landmarks in the tool's
axes and a finite working distance, both with a prior, because every microscope has these, whatever else is wrong.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import takewhile
from typing import Self

import numpy as np
from scipy.linalg.lapack import dposv

from lib.calibration import LandmarkOffsets
from lib.calibration.affine import regress
from lib.calibration.offsets import rows_axes, tool_axes
from lib.calibration.robust import tightest_sample
from lib.calibration.timing import Paths
from lib.correspondences import Correspondences
from lib.recordings import Kinematics

SIDES = ("left", "right")
#: Degrees of freedom that are tried: heavier tails than the bivariate Cauchy's (1) to nearly Gaussian.
_FREEDOM = np.array([0.7, 1.0, 2.0, 4.0, 10.0, 100.0])
HOPELESS = 20.0  # fits that start with a log likelihood this far below that of "nothing is wrong" never beat it
_LEAST_GAIN, _LEAST_EXPLAINED = 6.0, 0.02  # least gain of a hypothesis that is named, and least share that it explains
FITS = 0.03  # scale of the residuals over the spread of the pixels, below which the cameras fit
_LEAST_ROBOT_MM, _TIMES = 0.03, 3.0  # a good robot errs by less than this, or this multiple of its stated accuracy
_NEARLY_SHUT, _SHUT_NOISE = 0.15, 3.0  # opening of nearly shut jaws, as a share of the tool's length; factor on their noise
_LEAST_PX = 0.02  # smaller residuals are rounding errors
_TRIAL_ROUNDS = 6  # rounds of a fit that only ranks candidate frames
#: Loss of log likelihood that rules out another frame for a change: errors that depend on the pose made 18 of a true one.
_SURE_CUT = 25.0
_ALIKE = 1.0  # two positions of a frame whose losses differ by less are equally likely
_BLOCK = 8  # frames over which residuals may be correlated
_LONGEST_S = 0.25  # longest step between frames whose positions can replace the robot's log
_PARAMETERS = 21  # two cameras with one distance (17), and about as many of the nine offsets as the data determine


@dataclass(frozen=True)
class Shape:
    """A bivariate Student t density: its scale in px and its degrees of freedom."""

    scale: float
    freedom: float

    @classmethod
    def of(cls, r2: np.ndarray, least: float, before: Self | None = None) -> tuple[Self, float]:
        """Likeliest shape for squared residuals (k,), near `before`, with freedom >= `least`; and its log likelihood."""
        tried = _FREEDOM[least <= _FREEDOM]
        if before:
            tried = tried[np.abs(np.arange(len(tried)) - tried.searchsorted(before.freedom)) <= 1]
        freedom, share = tried[:, None], (tried[:, None] + 2.0) / (2.0 * len(r2))
        s2 = np.full(freedom.shape, before.scale if before else max(np.sqrt(np.median(r2)), _LEAST_PX)) ** 2
        for _ in range(4):
            s2 = np.maximum(share * s2 * (r2 / (freedom * s2 + r2)).sum(axis=1, keepdims=True), _LEAST_PX**2)
        likelihood = cls(np.sqrt(s2), freedom).log_density(r2).sum(axis=1)
        best = likelihood.argmax()
        return cls(float(np.sqrt(s2[best, 0])), float(freedom[best, 0])), float(likelihood[best])

    def log_density(self, r2: np.ndarray) -> np.ndarray:
        """Log density of residuals, given their squares (px^2).

        >>> bool(np.isclose(Shape(1.0, 4.0).log_density(np.zeros(1))[0], -np.log(2 * np.pi)))
        True
        """
        s2, freedom = self.scale**2, self.freedom
        return np.log1p(r2 / (freedom * s2)) * (-0.5 * (freedom + 2.0)) - np.log(2.0 * np.pi * s2)


@dataclass(frozen=True, eq=False)
class Robust:
    """The robust fit of a `Problem`; axes of length 2 are left and right image, then x and y."""

    start: np.ndarray  # (26,) cameras, offsets and 1/distance, from which another fit may start
    M: np.ndarray  # (2, 2, 4) cameras for positions relative to `Problem.centre`
    theta: np.ndarray  # (k,) coefficients of the additional terms
    covariance: np.ndarray  # (k, k) of theta
    moved_px: np.ndarray  # (n, 2, 2) shift of the pixels by the additional terms
    offsets: np.ndarray  # (3, 3) mm of the landmarks in the tool's axes
    offset_covariance: np.ndarray  # (9, 9) mm^2 of these
    nearness: tuple[float, float]  # 1/distance, per mm, and its standard deviation
    camera_covariance: np.ndarray  # (16, 16) of M
    residuals: np.ndarray  # (n, 2, 2) px
    apart: np.ndarray  # (n,) bool: rows whose noise has a shape of its own
    shapes: tuple[Shape, ...]  # of the noise: of the usual rows, then of those `apart`
    total: float  # log likelihood plus log priors of offsets and distance
    design: float  # design effect: rows count as this many times fewer, since their errors are correlated


@dataclass(frozen=True, eq=False)
class Problem:
    """The rows of a recording that are fitted."""

    x: np.ndarray  # (n, 2, 3) mm, the robot's positions for the left and for the right image, relative to `centre`
    y: np.ndarray  # (n, 2, 2) px
    seen: np.ndarray  # (n, 2) bool
    noise: np.ndarray  # (n, 2) relative standard deviation by the detector's covariances; about 1
    stated_px: np.ndarray  # (n, 2) RMS distance error that the detector states; 0 where it states none
    axes: np.ndarray  # (n, 3, 3) of the tool, 0 where unknown
    frame: np.ndarray  # (n,) index of the row's frame among those that are fitted
    number: np.ndarray  # (frames,) number of each such frame in the recording
    landmark: np.ndarray  # (n,)
    time: np.ndarray  # (n,) s, video clock
    centre: np.ndarray  # (3,) mm, the median position
    centre_px: np.ndarray  # (2,) of the images
    offset_sd: float = 0.1  # mm, prior: a robot's tool calibration errs, and a detector marks a point beside the landmark
    nearness_sd: float = 0.006  # per mm, prior of 1/distance: a microscope stands 150 mm away or more

    @classmethod
    def of(cls, data: Correspondences, size: tuple[int, int] | None = None, offsets: LandmarkOffsets | None = None) -> Self:
        """The rows that the robot reports and an image of `size` (width, height) px shows; `offsets` may turn the axes."""
        rows = np.isfinite(data.x_mm).all(axis=1) & data.seen.any(axis=1)
        axes = np.nan_to_num(rows_axes(data, offsets.offset if offsets and offsets.turns else None))[rows]
        data = data.subset(rows)
        variance = np.trace(data.covariance_px2, axis1=2, axis2=3)
        with np.errstate(all="ignore"):
            noise = np.sqrt(variance / np.nanmedian(variance)) if np.isfinite(variance).any() else variance
        noise = np.clip(np.where(np.isfinite(noise), noise, 1.0), 0.5, 4.0)
        number, frame = np.unique(data.frame, return_inverse=True)
        if axes.any():  # offsets turn the axes of nearly shut jaws, which adds errors
            tool = data.grid("x_mm")
            opening, length = tool[:, 2] - tool[:, 1], (tool[:, 1] + tool[:, 2]) / 2 - tool[:, 0]
            shut = np.linalg.norm(opening, axis=1) < _NEARLY_SHUT * np.linalg.norm(length, axis=1)
            noise *= np.where(shut, _SHUT_NOISE, 1.0)[frame, None]
            noise /= np.median(noise)
        centre = np.median(data.x_mm, axis=0) if len(data) else np.zeros(3)
        y = np.stack([data.u_left, data.u_right], axis=1)
        x = np.repeat((data.x_mm - centre)[:, None], 2, axis=1)
        centre_px = (np.array(size) - 1) / 2 if size else np.nanmedian(y, axis=(0, 1)) if len(data) else np.zeros(2)
        of_rows = (axes, frame, number, data.landmark, data.time_s)
        return cls(x, y, data.seen, noise, np.sqrt(np.nan_to_num(variance)), *of_rows, centre, centre_px)

    def __len__(self) -> int:
        return len(self.x)

    @cached_property
    def used(self) -> np.ndarray:
        """(n, 2) bool: the image shows the landmark and the robot reports it."""
        return self.seen & np.isfinite(self.x).all(axis=2)

    def moved_to(self, x: np.ndarray, views: Sequence[int]) -> Self:
        """The same rows with the robot at positions x (n, 3) mm, for the images of `views`."""
        positions = self.x.copy()
        positions[:, list(views)] = x[:, None]
        return replace(self, x=positions)

    def claimed_px(self, rows: np.ndarray | slice = slice(None)) -> float:
        """Median distance error of some rows, px, as the detector states it; 0 if it states none."""
        return float(np.nanmedian(np.append(self.stated_px[rows], 0.0)))

    def fit(
        self, columns: np.ndarray | Callable[[np.ndarray], np.ndarray] | None = None, *, start: np.ndarray | None = None,
        apart: np.ndarray | None = None, rounds: int = 40, worth: float = -np.inf,
    ) -> Robust:  # fmt: skip
        """Fit cameras, offsets and the coefficients of additional terms (maximum a posteriori).

        `columns` (n, 2, 2, k) are derivatives of the pixels by the coefficients, or a function of the cameras M that gives
        them; rows `apart` have noise of their own.  Without `start` (a `Robust.start`), least squares and the best sample of
        four rows are tried, and the better one is returned unfinished if its log likelihood is below `worth`.
        """
        apart = np.zeros(len(self), dtype=bool) if apart is None else apart
        if start is None:
            starts, rng = np.zeros((2, 26)), np.random.default_rng(0)
            cameras = starts[:, :16].reshape(2, 2, 2, 4)
            for view, rows in enumerate(self.used.T):
                if rows.sum() >= 4:
                    x, y = self.x[rows, view], self.y[rows, view]
                    cameras[0, view] = regress(x, y)
                    with suppress(ValueError):  # the positions lie in one plane
                        cameras[1, view] = tightest_sample(x, y, rng)
            best = max((self._descend(beta, columns, apart, 8) for beta in starts), key=lambda fit: fit.total)
            if best.total < worth:
                return best
            start = best.start
        return self._descend(start, columns, apart, rounds)

    def of_change(self, share: np.ndarray, views: tuple[int, ...] = (0, 1)) -> np.ndarray:
        """`columns` of `fit` (n, 2, 2, 8 per view) for a change of the cameras of `views`, scaled by `share` (n,) of rows."""
        return (share[:, None, None, None, None, None] * self.of_cameras[:, :, :, views]).reshape(len(self), 2, 2, -1)

    def of_motion(self, share: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """`columns` of `fit` for a turn and a shift of all landmarks together (6 numbers), scaled by `share` (n,) of rows."""
        turns, shifts = np.cross(np.eye(3), self.x[:, :, None]), np.broadcast_to(np.eye(3), (len(self), 2, 3, 3))
        return by_steps(share[:, None, None, None] * np.concatenate([turns, shifts], axis=2).mT)

    def other_cameras(self, fit: Robust) -> tuple[int, Robust]:
        """The frame at which a change of cameras explains the rows best, and the fit with that change.

        `fit` has no such change.  Weighted least squares over all cuts find a first guess; short fits then search around it.
        """
        z = np.nan_to_num(np.concatenate([self.x, np.ones((len(self), 2, 1)), fit.residuals], axis=2))
        frames, scale = int(self.frame.max()) + 1, fit.shapes[0].scale
        weight = np.where(self.used, 1.0 / (scale**2 + scale * np.linalg.norm(fit.residuals, axis=2)), 0.0)
        moments, remaining = np.zeros((frames, 2, 6, 6)), 0.0
        np.add.at(moments, self.frame, np.einsum("nc,nci,ncj->ncij", weight, z, z))
        early = np.cumsum(moments, axis=0)[1:-2]
        for part in (early, moments.sum(axis=0) - early):  # remaining squares, with cameras of each part's own
            G = part[..., :4, :4] + 1e-9 * np.trace(part, axis1=2, axis2=3)[..., None, None] * np.eye(4) + 1e-12 * np.eye(4)
            schur = part[..., 4:, 4:] - part[..., 4:, :4] @ np.linalg.solve(G, part[..., :4, 4:])
            remaining = remaining + np.trace(schur, axis1=2, axis2=3).sum(axis=1)

        @cache
        def cut_at(frame: int) -> Robust:
            return self.fit(self.of_change(self.frame >= frame), start=fit.start, rounds=_TRIAL_ROUNDS)

        cut, step = int(remaining.argmin()) + 2, max(frames // 5, 1)
        while step:
            best = max((cut, max(cut - step, 2), min(cut + step, frames - 2)), key=lambda frame: cut_at(frame).total)
            step, cut = step if best != cut else step // 2, best
        return cut, self.fit(self.of_change(self.frame >= cut), start=cut_at(cut).start)

    def similar_cuts(self, cut: int, best: Robust) -> tuple[int, int]:
        """First and last frame around the likeliest `cut` at which the change of cameras in `best` may have come."""

        def may_be(frame: int) -> bool:
            other = self.fit(self.of_change(self.frame >= frame), start=best.start, rounds=_TRIAL_ROUNDS)
            return best.total - other.total < _SURE_CUT

        earlier, later = range(cut - 1, 1, -1), range(cut + 1, int(self.frame.max()))
        return tuple([cut, *takewhile(may_be, frames)][-1] for frames in (earlier, later))

    def missed(self, fit: Robust, x: np.ndarray) -> np.ndarray:
        """(..., n, 2, 2) px: the residuals with the cameras of a fit, if the landmarks were at positions x (..., n, 2, 3)."""
        affine = np.einsum("cij,...cj->...ci", fit.M[:, :, :3], x) + fit.M[:, :, 3]
        return self.y - affine - fit.nearness[0] * _by_nearness(fit.M, x, affine - self.centre_px)

    @cached_property
    def of_cameras(self) -> np.ndarray:
        """(n, 2, 2, 2, 2, 4): derivatives of the pixels by the entries of the cameras (2, 2, 4); 0 in unused images."""
        H = np.where(self.used[:, :, None], np.concatenate([self.x, np.ones((len(self), 2, 1))], axis=2), 0.0)
        return np.einsum("nck,cv,ij->ncivjk", H, np.eye(2), np.eye(2))

    @cached_property
    def _of_offsets(self) -> np.ndarray:
        """(2, 3, n * 9): derivatives of the positions by the offsets; 0 in unused images."""
        own = self.used[:, :, None] & (self.landmark[:, None, None] == np.arange(3))  # (n, 2, 3)
        return np.einsum("nij,nck->cinkj", self.axes, own).reshape(2, 3, -1)

    def _design(self, M: np.ndarray, columns: np.ndarray | Callable | None) -> np.ndarray:
        """(n * 4, p): derivatives of the pixels by M (16), the offsets (9), 1/distance, `columns`; 0 in unused images."""
        of_offsets = (M[:, :, :3] @ self._of_offsets).reshape(2, 2, -1, 9).transpose(2, 0, 1, 3)
        of_cameras, used = self.of_cameras.reshape(-1, 16), self.used[:, :, None]
        of_nearness = _by_nearness(M, self.x, (of_cameras @ M.ravel()).reshape(self.y.shape) - self.centre_px)
        parts = [of_cameras.reshape(*self.y.shape, 16), of_offsets, np.where(used, of_nearness, 0.0)[..., None]]
        parts += [] if columns is None else [np.nan_to_num(columns(M) if callable(columns) else columns) * used[..., None]]
        return np.concatenate(parts, axis=3).reshape(self.y.size, -1)

    def _descend(self, beta: np.ndarray, columns: np.ndarray | Callable | None, apart: np.ndarray, rounds: int) -> Robust:
        used, y = self.used, np.where(self.used[:, :, None], self.y, 0.0)
        groups = [rows for rows in (used & ~apart[:, None], used & apart[:, None]) if rows.any()]
        M = beta[:16].reshape(2, 2, 4)
        D = self._design(M, columns)
        prior = np.diag(np.repeat([0.0, self.offset_sd**-2, self.nearness_sd**-2, 0.0], [16, 9, 1, D.shape[1] - 26]))
        r = y - (D[:, :26] @ beta).reshape(y.shape)
        r2 = (r**2).sum(axis=2) / self.noise**2
        # With few numbers per parameter, a density with a sharp peak would fit some rows exactly.
        numbers = 2 * used.sum() / (_PARAMETERS + D.shape[1] - 26)  # per parameter
        least = 0.0 if numbers > 10 else 2.0 if numbers > 5 else 10.0
        found = [Shape.of(r2[rows], least) for rows in groups]
        before, of_noise = -np.inf, -2.0 * np.log(self.noise[used]).sum()
        for done in range(rounds):
            D = self._design(M, columns) if done else D
            weight = np.zeros(used.shape)
            for rows, (shape, _) in zip(groups, found, strict=True):
                weight[rows] = (shape.freedom + 2.0) / (shape.freedom * shape.scale**2 + r2[rows])
            root = (np.sqrt(weight) / self.noise)[:, :, None]
            J = D * np.repeat(root, 2)[:, None]
            information = J.T @ J + prior
            np.fill_diagonal(information, np.diag(information) * (1.0 + 1e-10) + 1e-22)  # an undetermined term stays 0
            beta = dposv(information, J.T @ (y * root).reshape(-1))[1]
            M, r = beta[:16].reshape(2, 2, 4), y - (D @ beta).reshape(y.shape)
            r2 = (r**2).sum(axis=2) / self.noise**2
            found = [Shape.of(r2[rows], least, old) for rows, (old, _) in zip(groups, found, strict=True)]
            total = float(of_noise + sum(likelihood for _, likelihood in found) - 0.5 * beta @ prior @ beta)
            if abs(total - before) < 0.02:
                break
            before = total
        shapes, design = [shape for shape, _ in found], self._design_effect(r * root)
        excess = (shapes[0].freedom + 4.0) / (shapes[0].freedom + 2.0)  # ratio of `information` to the Fisher information
        inverse = np.linalg.inv(information) * design * excess
        terms = beta[26:], inverse[26:, 26:], (D[:, 26:] @ beta[26:]).reshape(y.shape)
        offsets = beta[16:25].reshape(3, 3), inverse[16:25, 16:25]
        nearness = float(beta[25]), float(np.sqrt(inverse[25, 25]))
        known = *terms, *offsets, nearness, inverse[:16, :16]
        return Robust(beta[:26], M, *known, r, apart, tuple(shapes), total, design)

    def _design_effect(self, z: np.ndarray) -> float:
        """Variance of the sums of weighted residuals z (n, 2, 2) over blocks of frames, relative to independent residuals."""
        block = self.frame // max(1, min(_BLOCK, (int(self.frame.max(initial=0)) + 1) // 6))
        sums = np.array([np.bincount(block, one) for one in z.sum(axis=1).T])  # (2, blocks)
        return float(max(1.0, ((sums**2).sum(axis=1) / np.maximum((z**2).sum(axis=(0, 1)), 1e-300)).mean()))


def by_steps(steps: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """`columns` of `Problem.fit` for motions of the landmarks along steps (n, 3, k) mm, or (n, 2, 3, k) in each image."""
    steps = steps if steps.ndim == 4 else steps[:, None]
    return lambda M: np.einsum("cij,ncjk->ncik", M[:, :, :3], steps)


def _by_nearness(M: np.ndarray, x: np.ndarray, from_centre: np.ndarray) -> np.ndarray:
    """(..., n, 2, 2) px mm: derivatives by 1/distance of pixels, given `from_centre`, of positions x (..., n, 2, 3)."""
    normal = np.cross(M[:, 0, :3], M[:, 1, :3])
    normal /= -np.maximum(np.sqrt((normal * normal).sum(axis=1, keepdims=True)), 1e-12)
    return np.einsum("...cj,cj->...c", x, normal)[..., None] * from_centre


@dataclass(frozen=True)
class Hypothesis:
    """A possible fault: its description, the setting or call that mends it, its size, and the images in which it is."""

    name: str
    text: str
    cure: str
    value: float
    sd: float
    unit: str
    explained: float  # share of the residuals' variance, 0 to 1; how sure or large the fault is where residuals hide it
    gain: float  # log likelihood above that of "nothing is wrong", minus the penalty for its parameters
    images: tuple[int, ...] = (0, 1)  # left and right
    evidence: tuple[float, float, float, float] | None = None  # arguments of `_gain`, if a fit gave the gain

    @property
    def is_named(self) -> bool:
        """True if it beats "nothing is wrong"."""
        return self.gain >= _LEAST_GAIN and self.explained >= _LEAST_EXPLAINED


class Case:
    """The rows, the fit `null` of "nothing is wrong", the best fit of each hypothesis, and data that the hypotheses share.

    `paths` are the landmarks' trajectories by the robot's log, or by the rows if frames follow each other closely, or None.
    `log` (m, k, 3) mm are the positions in the robot's log, or in the rows.  `size` is (width, height) px or None, `frames`
    the number of frames; `own_times` if frames.csv states theirs.  A robot that errs by more than `robot_mm` is at fault.
    """

    def __init__(
        self, problem: Problem, kinematics: Kinematics | None, offset_s: float, readout_s: float,
        size: tuple[int, int] | None, robot_accuracy_mm: float, own_times: bool,
    ) -> None:  # fmt: skip
        self.problem, self.kinematics, self.readout_s, self.size = problem, kinematics, readout_s, size
        self.robot_mm, self.own_times = max(_LEAST_ROBOT_MM, _TIMES * robot_accuracy_mm), own_times
        self.null, self.fits = problem.fit(), {}
        self.frames = int(problem.frame.max()) + 1
        self.paths, self._clock_s, self.at_s = None, offset_s, problem.time + offset_s
        time, landmark, x = problem.time, problem.landmark, problem.x[:, 0]
        self.log = self.by_frame(x) if kinematics is None else kinematics.x_mm
        if not np.isfinite(time).all():
            return
        if kinematics is not None and landmark.max() < kinematics.x_mm.shape[1]:
            self.paths = Paths((kinematics.time_s, own) for own in np.swapaxes(kinematics.x_mm, 0, 1) - problem.centre)
        if self.paths is None or np.isfinite(self.moved(0.0)).all(axis=1).sum() < 6:
            each = [np.flatnonzero(landmark == k) for k in range(int(landmark.max()) + 1)]
            each = [rows[np.unique(time[rows], return_index=True)[1]] for rows in each]
            steps = np.concatenate([np.diff(time[rows]) for rows in each])
            near = steps.size and np.median(steps) <= _LONGEST_S
            self.paths = Paths((time[rows], x[rows]) for rows in each) if near else None
            self._clock_s = 0.0

    def misfit(self, *fits: Robust) -> float:
        """Scale of the residuals, relative to the standard deviation of the pixels, in the best of some fits."""
        return min(fit.shapes[0].scale for fit in fits) / self.problem.y[self.problem.used].std(axis=0).max()

    def moved(self, shift_s: float | np.ndarray) -> np.ndarray:
        """(..., n, 3) mm: the positions of the rows `shift_s` later, a number or (..., n); NaN where they are unknown."""
        landmark, now = self.problem.landmark, self.problem.time + self._clock_s
        return self.problem.x[:, 0] + self.paths.at(landmark, now + shift_s) - self.paths.at(landmark, now)

    def velocity(self, shift_s: float | np.ndarray = 0.0) -> np.ndarray:
        """(n, 3) mm/s: the velocities of the rows' landmarks, `shift_s` later."""
        return self.paths.at(self.problem.landmark, self.problem.time + self._clock_s + shift_s, 1)

    def smooth_axes(self) -> np.ndarray:
        """The tool's axes (n, 3, 3) on its smoothed path: along a long lever noise, or a few ms, would move a point far."""
        axes, now = self.problem.axes, self.problem.time + self._clock_s
        if self.paths is None or len(self.paths.pieces) < 3:
            return axes
        own = tool_axes(np.stack([self.paths.at(np.full(len(now), k), now) for k in range(3)], axis=1))
        return np.where(np.isfinite(own), own, axes)

    def by_frame(self, values: np.ndarray) -> np.ndarray:
        """Values (n, ...) of the rows as a table (frames, 3, ...), NaN where a landmark is missing."""
        table, rows = np.full((self.frames, 3, *values.shape[1:]), np.nan), self.problem.landmark <= 2
        table[self.problem.frame[rows], self.problem.landmark[rows]] = values[rows]
        return table

    def chosen(self, x: np.ndarray, views: tuple[int, ...] = (0, 1)) -> tuple[Robust, Problem, np.ndarray]:
        """The fit with the best of positions x (t, n, 3) for each frame, in `views`; its rows; the choices (frames,).

        Of nearly equal ones the first is taken.  Rows whose position is unknown (NaN) keep their own.
        """
        problem, fit, own = self.problem, self.null, np.full(self.frames, -1)
        for _ in range(5):
            r2 = (problem.missed(fit, np.repeat(x[:, :, None], 2, axis=2)) ** 2).sum(axis=3)
            loss = np.where(problem.used, np.nan_to_num(np.log1p(r2 / fit.shapes[0].scale ** 2), nan=1e3), 0.0)
            loss = loss[:, :, views].sum(axis=2)
            loss = np.array([np.bincount(problem.frame, row, self.frames) for row in loss])
            before, own = own, (loss <= loss.min(axis=0) + _ALIKE).argmax(axis=0)
            if (own == before).all():
                break
            at = x[own[problem.frame], np.arange(len(problem))]
            moved = problem.moved_to(np.where(np.isfinite(at), at, problem.x[:, 0]), views)
            fit = moved.fit(start=fit.start, rounds=10)
        return fit, moved, own

    def linear(self, columns: np.ndarray | Callable[[np.ndarray], np.ndarray]) -> Robust:
        """The fit with additional `columns`, as `Problem.fit` takes them."""
        return self.problem.fit(columns, start=self.null.start)

    def multiple_of(self, step: np.ndarray) -> tuple[Robust, Problem, float, float]:
        """The fit with a multiple of steps (n, 1 or 2, 3) mm, its rows (whose step is known), the multiple, and its sd."""
        known = replace(self.problem, seen=self.problem.used & np.isfinite(step).all(axis=2))
        fit = known.fit(by_steps(step[..., None]), start=self.null.start)
        return fit, known, float(fit.theta[0]), float(np.sqrt(fit.covariance[0, 0]))

    def found(
        self, name: str, fit: Robust, extra: float, size: tuple[float, float, str], text: str, cure: str, *,
        on: Problem | None = None, raw: float | None = None, images: tuple[int, ...] = (0, 1),
    ) -> Hypothesis:  # fmt: skip
        """The hypothesis with its evidence.  `fit`, on the rows of `on`, has `extra` more parameters than `null`."""
        null = self.null
        if on is not None and (on.used != self.problem.used).any():
            null = replace(self.problem, seen=on.used).fit(start=null.start)
        raw = fit.total - null.total if raw is None else raw
        n = 2.0 * (on or self.problem).used.sum()
        evidence = raw, n, extra, fit.design
        if name not in self.fits or fit.total > self.fits[name].total:
            self.fits[name] = fit
        explained = float(1.0 - np.exp(-2.0 * max(raw, 0.0) / n))
        return Hypothesis(name, text, cure, *map(float, size[:2]), size[2], explained, _gain(*evidence), images, evidence)


def compared(found: list[Hypothesis], of_frames: tuple[str, ...]) -> list[Hypothesis]:
    """Make the gains comparable: all hypotheses that are named use the smallest design effect among them.

    So do causes of one or two parameters: where other faults remain, their own design effect is too large.  Causes named in
    `of_frames`, with parameters for each frame, leave white residuals whatever is wrong; they use the others' design effect.
    """
    designs = [h.evidence[3] for h in found if h.is_named and h.name not in of_frames]
    least, gains = min(designs, default=np.inf), []
    for h in found:
        design = h.evidence[3]
        if h.name in of_frames:
            design = least if designs else design
        elif h.is_named or h.evidence[2] <= 2:
            design = min(least, design)
        more = max(_gain(*h.evidence[:3], design), 0.0) - max(_gain(*h.evidence), 0.0)
        gains.append(max(h.gain, 0.0) + more if more else h.gain)
    return [replace(h, gain=gain) for h, gain in zip(found, gains, strict=True)]


def _gain(raw: float, n: float, extra: float, design: float) -> float:
    """Gain `raw` in log likelihood of n numbers, divided by `design`, minus the chance gain of `extra` parameters (BIC)."""
    freedom = n / design - _PARAMETERS
    left = freedom - extra
    return float(left * (raw / n - 0.5 * np.log(freedom / left)) - 0.5 * extra * np.log(freedom)) if left >= 4 else -np.inf
