"""A hypothesis about a recording's fault: affine cameras and additions, fitted under heavy-tailed noise, and its evidence.

Each image's residual of a row has a bivariate Student t density whose scale and degrees of freedom are fitted too, so that
30 % of wrong landmarks hide nothing.  Landmarks may have constant offsets in the tool's axes, and the cameras a finite
distance, both with a prior: whatever else is wrong, every microscope has these.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Self

import numpy as np
from scipy.linalg.lapack import dposv

from lib.calibration import LandmarkOffsets
from lib.calibration.affine import regress
from lib.calibration.offsets import rows_axes, tool_axes
from lib.calibration.robust import tightest_sample
from lib.calibration.timing import Paths
from lib.correspondences import Correspondences
from lib.geometry import cross
from lib.recordings import Kinematics

SIDES = ("left", "right")
#: Degrees of freedom tried; bivariate Cauchy to nearly Gaussian.
_FREEDOM = np.array([0.7, 1.0, 2.0, 4.0, 10.0, 100.0])
HOPELESS = 20.0  # a fit whose samples are so much less likely (log) than "nothing is wrong" never beats it
_LEAST_GAIN, _LEAST_EXPLAINED = 6.0, 0.02  # of a hypothesis that is named
FITS = 0.03  # the scale of the residuals over the spread of the pixels, below which cameras fit
_LEAST_ROBOT_MM, _TIMES = 0.03, 3.0  # a robot for eye surgery errs by less, and by less than so often what is stated
_NEARLY_SHUT, _OF_SHUT = 0.15, 3.0  # jaws that open less, of the tool's length, and by how much more noise these have
_LEAST_PX = 0.02  # smaller residuals are rounding
_TRIED = 6  # rounds of a fit that tells which frame is better
_BLOCK = 8  # frames over which residuals may be correlated
_LONGEST_S = 0.25  # between frames, whose own positions stand for the robot's log
_PARAMETERS = 21  # of two cameras with a distance, and about as many of the nine offsets as data tell


@dataclass(frozen=True)
class Shape:
    """A bivariate t: scale s in px and degrees of freedom."""

    scale: float
    freedom: float

    @classmethod
    def of(cls, r2: np.ndarray, least: float, before: Self | None = None) -> tuple[Self, float]:
        """Most probable for squared residuals (k,), of `least` freedom or more, near that `before`; its log likelihood."""
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
        """Of squared residuals.

        >>> bool(np.isclose(Shape(1.0, 4.0).log_density(np.zeros(1))[0], -np.log(2 * np.pi)))
        True
        """
        s2, freedom = self.scale**2, self.freedom
        return np.log1p(r2 / (freedom * s2)) * (-0.5 * (freedom + 2.0)) - np.log(2.0 * np.pi * s2)


@dataclass(frozen=True, eq=False)
class Robust:
    """The fit of a problem."""

    start: np.ndarray  # (26,) cameras, offsets and 1/distance, from which another fit may start
    M: np.ndarray  # (2, 2, 4) cameras on centred positions
    theta: np.ndarray  # (k,) additions, their covariance, and by how much they move the pixels, (n, 2, 2) px
    covariance: np.ndarray
    moved_px: np.ndarray
    offsets: np.ndarray  # (3, 3) mm of the landmarks, and (3,) their deviations
    offset_sd: np.ndarray
    nearness: tuple[float, float]  # 1/distance, per mm, and its deviation
    camera_covariance: np.ndarray
    residuals: np.ndarray  # (n, 2, 2) px
    apart: np.ndarray  # (n,) bool: rows of another noise
    shapes: tuple[Shape, ...]
    total: float  # log likelihood with the priors of offsets and distance
    design: float  # by how much correlated rows overstate what they tell


@dataclass(frozen=True, eq=False)
class Problem:
    """Rows of a recording as the fits take them."""

    x: np.ndarray  # (n, 2, 3) mm, the robot's position for the left and for the right image, about `centre`
    y: np.ndarray  # (n, 2, 2) px
    seen: np.ndarray  # (n, 2) bool
    noise: np.ndarray  # (n, 2) relative, from the detector's covariances; 1 on average
    stated_px: np.ndarray  # (n, 2) RMS distance by which the detector says that it errs; 0 where it says nothing
    axes: np.ndarray  # (n, 3, 3) of the tool, 0 where unknown
    frame: np.ndarray  # (n,) counted from 0 in their order
    number: np.ndarray  # (frames,) of these in the recording
    landmark: np.ndarray
    time: np.ndarray
    centre: np.ndarray
    centre_px: np.ndarray  # (2,) of the images
    offset_sd: float = 0.1  # mm, before the data: a robot's tool calibration errs, and a detector marks a place beside it
    nearness_sd: float = 0.006  # of 1/distance, per mm, before the data: a microscope stands 150 mm away and more

    @classmethod
    def of(
        cls, data: Correspondences, size: tuple[int, int] | None = None, offsets: LandmarkOffsets | None = None
    ) -> Self:  # fmt: skip
        """The rows that the robot reports and an image, of `size` (width, height) px, shows; `offsets` may turn the axes."""
        rows = np.isfinite(data.x_mm).all(axis=1) & data.seen.any(axis=1)
        axes = np.nan_to_num(rows_axes(data, offsets.offset if offsets and offsets.turns else None))[rows]
        data = data.subset(rows)
        variance = np.trace(data.covariance_px2, axis1=2, axis2=3)
        with np.errstate(all="ignore"):
            noise = np.sqrt(variance / np.nanmedian(variance)) if np.isfinite(variance).any() else variance
        noise = np.clip(np.where(np.isfinite(noise), noise, 1.0), 0.5, 4.0)
        number, frame = np.unique(data.frame, return_inverse=True)
        if axes.any():  # offsets turn those of jaws that are nearly shut
            tool = data.grid("x_mm")
            opening, length = tool[:, 2] - tool[:, 1], (tool[:, 1] + tool[:, 2]) / 2 - tool[:, 0]
            shut = np.linalg.norm(opening, axis=1) < _NEARLY_SHUT * np.linalg.norm(length, axis=1)
            noise *= np.where(shut, _OF_SHUT, 1.0)[frame, None]
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

    def claimed_px(self, rows: np.ndarray | slice = slice(None)) -> float:
        """The distance by which the detector says that it errs, the median of rows; 0 where it says nothing."""
        return float(np.nanmedian(np.append(self.stated_px[rows], 0.0)))

    def fit(
        self, columns: np.ndarray | Callable[[np.ndarray], np.ndarray] | None = None, *, start: np.ndarray | None = None,
        apart: np.ndarray | None = None, rounds: int = 40, worth: float = -np.inf,
    ) -> Robust:  # fmt: skip
        """Most probable cameras, offsets and additions, near a `Robust.start` or the best sample of four rows.

        `columns` (n, 2, 2, k) (or cameras M -> columns): what each addition does to pixels; rows `apart` have another noise.
        Samples whose log likelihood stays below `worth` are not followed to the end.
        """
        apart = np.zeros(len(self), dtype=bool) if apart is None else apart
        if start is None:  # of least squares, or of the samples of four rows that most rows are near to
            starts, rng = np.zeros((2, 26)), np.random.default_rng(0)
            cameras = starts[:, :16].reshape(2, 2, 2, 4)
            for view, rows in enumerate(self.used.T):
                if rows.sum() >= 4:
                    x, y = self.x[rows, view], self.y[rows, view]
                    cameras[0, view] = regress(x, y)
                    with suppress(ValueError):  # positions in one plane
                        cameras[1, view] = tightest_sample(x, y, rng)
            best = max((self._descend(beta, columns, apart, 8) for beta in starts), key=lambda fit: fit.total)
            if best.total < worth:
                return best
            start = best.start
        return self._descend(start, columns, apart, rounds)

    def of_later_cameras(self, frame: int, views: tuple[int, ...] = (0, 1)) -> np.ndarray:
        """(n, 2, 2, 8 a view): derivatives by what the entries of some cameras change by at a frame."""
        late = np.where((self.frame >= frame)[:, None, None, None, None, None], self.of_cameras[:, :, :, views], 0.0)
        return late.reshape(len(self), 2, 2, -1)

    def of_motion(self, share: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """`columns` of a turn about and a shift along x, y and z, by a `share` (n,) of them, of all landmarks together."""
        turns, shifts = cross(np.eye(3), self.x[:, :, None]), np.broadcast_to(np.eye(3), (len(self), 2, 3, 3))
        moves = share[:, None, None, None] * np.concatenate([turns, shifts], axis=2)
        return lambda M: np.einsum("cij,nckj->ncik", M[:, :, :3], moves)

    def other_cameras(self, fit: Robust) -> tuple[int, Robust]:
        """The frame from which on cameras of their own suit the rows best, and the fit with them, from a `fit` without.

        Weighted least squares of all cuts tell where to begin; fits of few rounds compare the frames around it.
        """
        z = np.nan_to_num(np.concatenate([self.x, np.ones((len(self), 2, 1)), fit.residuals], axis=2))
        frames, scale = int(self.frame.max()) + 1, fit.shapes[0].scale
        weight = np.where(self.used, 1.0 / (scale**2 + scale * np.linalg.norm(fit.residuals, axis=2)), 0.0)
        moments, left = np.zeros((frames, 2, 6, 6)), 0.0
        np.add.at(moments, self.frame, np.einsum("nc,nci,ncj->ncij", weight, z, z))
        early = np.cumsum(moments, axis=0)[1:-2]
        for part in (early, moments.sum(axis=0) - early):  # what cameras of its own leave of it
            G = part[..., :4, :4] + 1e-9 * np.trace(part, axis1=2, axis2=3)[..., None, None] * np.eye(4) + 1e-12 * np.eye(4)
            open_ = part[..., 4:, 4:] - part[..., 4:, :4] @ np.linalg.solve(G, part[..., :4, 4:])
            left = left + np.trace(open_, axis1=2, axis2=3).sum(axis=1)

        @cache
        def parted(frame: int) -> Robust:
            return self.fit(self.of_later_cameras(frame), start=fit.start, rounds=_TRIED)

        cut, step = int(left.argmin()) + 2, max(frames // 5, 1)
        while step:
            best = max((cut, max(cut - step, 2), min(cut + step, frames - 2)), key=lambda frame: parted(frame).total)
            step, cut = step if best != cut else step // 2, best
        return cut, self.fit(self.of_later_cameras(cut), start=parted(cut).start)

    def missed(self, fit: Robust, x: np.ndarray) -> np.ndarray:
        """(..., n, 2, 2) px: what the cameras of a fit leave of the pixels at other positions x (..., n, 2, 3)."""
        seen = np.einsum("cij,...cj->...ci", fit.M[:, :, :3], x) + fit.M[:, :, 3]
        return self.y - seen - fit.nearness[0] * _shrinking(fit.M, x, seen - self.centre_px)

    @cached_property
    def of_cameras(self) -> np.ndarray:
        """(n, 2, 2, 2, 2, 4): derivatives by the entries of the cameras (2, 2, 4), 0 in images that are not used."""
        H = np.where(self.used[:, :, None], np.concatenate([self.x, np.ones((len(self), 2, 1))], axis=2), 0.0)
        return np.einsum("nck,cv,ij->ncivjk", H, np.eye(2), np.eye(2))

    @cached_property
    def _of_offsets(self) -> np.ndarray:
        """(2, 3, n * 9): derivatives of the positions by the offsets, 0 in images that are not used."""
        own = self.used[:, :, None] & (self.landmark[:, None, None] == np.arange(3))  # (n, 2, 3)
        return np.einsum("nij,nck->cinkj", self.axes, own).reshape(2, 3, -1)

    def _design(self, M: np.ndarray, columns: np.ndarray | Callable | None) -> np.ndarray:
        """(n * 4, p): derivatives by the 16 entries of M, 9 offsets (mm), 1/distance, additions; 0 in images not used."""
        of_offsets = (M[:, :, :3] @ self._of_offsets).reshape(2, 2, -1, 9).transpose(2, 0, 1, 3)
        of_cameras, used = self.of_cameras.reshape(-1, 16), self.used[:, :, None]
        shrinking = _shrinking(M, self.x, (of_cameras @ M.ravel()).reshape(self.y.shape) - self.centre_px)
        parts = [of_cameras.reshape(*self.y.shape, 16), of_offsets, np.where(used, shrinking, 0.0)[..., None]]
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
        # Few rows a parameter: a density with a sharp peak would fit some of them exactly.
        rich = 2 * used.sum() / (_PARAMETERS + D.shape[1] - 26)
        least = 0.0 if rich > 10 else 2.0 if rich > 5 else 10.0
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
            np.fill_diagonal(information, np.diag(information) * (1.0 + 1e-10) + 1e-22)  # an unseen addition stays 0
            beta = dposv(information, J.T @ (y * root).reshape(-1))[1]
            M, r = beta[:16].reshape(2, 2, 4), y - (D @ beta).reshape(y.shape)
            r2 = (r**2).sum(axis=2) / self.noise**2
            found = [Shape.of(r2[rows], least, old) for rows, (old, _) in zip(groups, found, strict=True)]
            total = float(of_noise + sum(likelihood for _, likelihood in found) - 0.5 * beta @ prior @ beta)
            if abs(total - before) < 0.02:
                break
            before = total
        shapes, design = [shape for shape, _ in found], self._overcount(r * root)
        told = (shapes[0].freedom + 4.0) / (shapes[0].freedom + 2.0)  # by so much this exceeds Fisher's information
        inverse = np.linalg.inv(information) * design * told
        offset_sd = np.sqrt(np.diag(inverse)[16:25].reshape(3, 3).sum(axis=1))
        nearness = float(beta[25]), float(np.sqrt(inverse[25, 25]))
        found = beta[26:], inverse[26:, 26:], (D[:, 26:] @ beta[26:]).reshape(y.shape), beta[16:25].reshape(3, 3), offset_sd
        return Robust(beta[:26], M, *found, nearness, inverse[:16, :16], r, apart, tuple(shapes), total, design)

    def _overcount(self, z: np.ndarray) -> float:
        """Variance of the sums of weighted residuals z (n, 2, 2) over stretches of frames, over that of independent ones."""
        stretch = self.frame // max(1, min(_BLOCK, (int(self.frame.max(initial=0)) + 1) // 6))
        sums = np.array([np.bincount(stretch, one) for one in z.sum(axis=1).T])  # (2, stretches)
        return float(max(1.0, ((sums**2).sum(axis=1) / np.maximum((z**2).sum(axis=(0, 1)), 1e-300)).mean()))


def _shrinking(M: np.ndarray, x: np.ndarray, from_centre: np.ndarray) -> np.ndarray:
    """(..., n, 2, 2) px mm: derivatives by 1/distance of pixels `from_centre` of the image, of positions x (..., n, 2, 3)."""
    normal = cross(M[:, 0, :3], M[:, 1, :3])
    normal /= -np.maximum(np.sqrt((normal * normal).sum(axis=1, keepdims=True)), 1e-12)
    return np.einsum("...cj,cj->...c", x, normal)[..., None] * from_centre


@dataclass(frozen=True)
class Hypothesis:
    """A possible fault: what the residuals look like, the setting or call that mends it, its size, the images it is in."""

    name: str
    text: str
    cure: str
    value: float
    sd: float
    unit: str
    explained: float  # share of the residuals' variance, 0 to 1, by likelihood; how sure or large where they do not show it
    gain: float  # log likelihood above "nothing is wrong", less the penalty for its parameters
    images: tuple[int, ...] = (0, 1)  # left and right
    evidence: tuple[float, float, float, float] | None = None  # of the fit that the gain is of, as `_gain` takes it

    @property
    def is_named(self) -> bool:
        """Whether it beats "nothing is wrong"."""
        return self.gain >= _LEAST_GAIN and self.explained >= _LEAST_EXPLAINED


class Case:
    """The rows, the fit `null` of "nothing is wrong", the best fit of each hypothesis, and what the hypotheses share.

    `paths` are the landmarks' in time: of the robot's log, else of the rows where the frames follow each other closely, else
    None.  `log` (m, k, 3) has the robot's positions, else the rows'.  `size` is (width, height) or None; `frames` a number.
    A robot that errs by more than `robot_mm` is no good one.
    """

    def __init__(
        self, problem: Problem, kinematics: Kinematics | None, offset_s: float, readout_s: float,
        size: tuple[int, int] | None, robot_accuracy_mm: float,
    ) -> None:  # fmt: skip
        self.problem, self.kinematics, self.readout_s, self.size = problem, kinematics, readout_s, size
        self.robot_mm = max(_LEAST_ROBOT_MM, _TIMES * robot_accuracy_mm)
        self.null, self.fits = problem.fit(), {}
        self.frames = int(problem.frame.max()) + 1
        self.paths, self._clock_s, self.at_s = None, offset_s, problem.time + offset_s
        time, landmark, x = problem.time, problem.landmark, problem.x[:, 0]
        self.log = self.by_frame(x) if kinematics is None else kinematics.x_mm
        if not np.isfinite(time).all():
            return
        if kinematics is not None and landmark.max() < kinematics.x_mm.shape[1]:
            self.paths = Paths((kinematics.time_s, own) for own in np.swapaxes(kinematics.x_mm, 0, 1) - problem.centre)
        if self.paths is None or not all(self.paths.pieces):
            each = [np.flatnonzero(landmark == k) for k in range(int(landmark.max()) + 1)]
            each = [rows[np.unique(time[rows], return_index=True)[1]] for rows in each]
            steps = np.concatenate([np.diff(time[rows]) for rows in each])
            near = steps.size and np.median(steps) <= _LONGEST_S
            self.paths = Paths((time[rows], x[rows]) for rows in each) if near else None
            self._clock_s = 0.0

    def misfit(self, *fits: Robust) -> float:
        """The scale of the residuals over the spread of the pixels, of the best of some fits."""
        return min(fit.shapes[0].scale for fit in fits) / self.problem.y[self.problem.used].std(axis=0).max()

    def moved(self, shift_s: float | np.ndarray) -> np.ndarray:
        """(..., n, 3) mm: the positions of the rows `shift_s` later, a number or (..., n); NaN where nothing tells."""
        landmark, now = self.problem.landmark, self.problem.time + self._clock_s
        return self.problem.x[:, 0] + self.paths.at(landmark, now + shift_s) - self.paths.at(landmark, now)

    def velocity(self, shift_s: float | np.ndarray = 0.0) -> np.ndarray:
        """(n, 3) mm/s of the rows, `shift_s` later."""
        return self.paths.at(self.problem.landmark, self.problem.time + self._clock_s + shift_s, 1)

    def smooth_axes(self) -> np.ndarray:
        """The tool's axes (n, 3, 3) by its smoothed path, at each row's instant: noise and some ms turn a long lever far."""
        axes, now = self.problem.axes, self.problem.time + self._clock_s
        if self.paths is None or len(self.paths.pieces) < 3:
            return axes
        own = tool_axes(np.stack([self.paths.at(np.full(len(now), k), now) for k in range(3)], axis=1))
        return np.where(np.isfinite(own), own, axes)

    def by_frame(self, values: np.ndarray) -> np.ndarray:
        """Values (n, ...) of the rows as (frames, 3, ...), NaN where a landmark is missing."""
        table, rows = np.full((self.frames, 3, *values.shape[1:]), np.nan), self.problem.landmark <= 2
        table[self.problem.frame[rows], self.problem.landmark[rows]] = values[rows]
        return table

    def chosen(self, x: np.ndarray, views: tuple[int, ...] = (0, 1)) -> tuple[Robust, Problem, np.ndarray]:
        """Each frame, in some images, with its best of positions x (t, n, 3): the fit, its rows, the choices (frames,)."""
        problem, fit, own = self.problem, self.null, np.full(self.frames, -1)
        for _ in range(5):
            r2 = (problem.missed(fit, np.repeat(x[:, :, None], 2, axis=2)) ** 2).sum(axis=3)
            loss = np.where(problem.used, np.nan_to_num(np.log1p(r2 / fit.shapes[0].scale ** 2), nan=1e3), 0.0)
            loss = loss[:, :, views].sum(axis=2)
            before, own = own, np.array([np.bincount(problem.frame, row, self.frames) for row in loss]).argmin(axis=0)
            if (own == before).all():
                break
            positions = problem.x.copy()
            positions[:, views] = x[own[problem.frame], np.arange(len(problem))][:, None]
            moved = replace(problem, x=positions)
            fit = moved.fit(start=fit.start, rounds=10)
        return fit, moved, own

    def linear(self, columns: np.ndarray | Callable[[np.ndarray], np.ndarray], on: Problem | None = None) -> Robust:
        """The fit with `columns` (n, 2, 2, k) added to the pixels (or cameras -> columns)."""
        return (on or self.problem).fit(columns, start=self.null.start)

    def found(
        self, name: str, fit: Robust, extra: float, size: tuple[float, float, str], text: str, cure: str, *,
        on: Problem | None = None, raw: float | None = None, images: tuple[int, ...] = (0, 1),
    ) -> Hypothesis:  # fmt: skip
        """With the evidence of its fit, which has `extra` parameters more than "nothing is wrong" on the rows of `on`."""
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


def compared(found: list[Hypothesis], of_frames: tuple[str, ...] = ()) -> list[Hypothesis]:
    """Hypotheses whose gains can be compared: rows count by one design for all that are named, the least of theirs.

    So they do for causes of one or two numbers: what is left may be in stretches, by which its own rows hardly count.  Those
    named in `of_frames`, with numbers for each frame, leave no stretches whatever is wrong; they take the others' design.
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
    """Log likelihood `raw` of n numbers, overstated by `design`, less what `extra` parameters of few rows gain by chance."""
    freedom = n / design - _PARAMETERS
    left = freedom - extra
    return float(left * (raw / n - 0.5 * np.log(freedom / left)) - 0.5 * extra * np.log(freedom)) if left >= 4 else -np.inf
