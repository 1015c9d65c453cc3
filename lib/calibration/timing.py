"""The offset between the clocks of video and robot."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded
from scipy.stats import chi2

from lib.calibration.affine import camera_columns, estimate_noise, regress
from lib.calibration.calibration import Calibration
from lib.calibration.offsets import further_step
from lib.calibration.robust import NoConsensusError, consensus
from lib.calibration.scatter import sandwich
from lib.correspondences import Correspondences, DataError
from lib.geometry import precision
from lib.recordings import Kinematics

_GRID = 41  # number of trial offsets in the coarse search
#: Wider searches start with a scan, which needs few rows and leaves a search of the half width `_LEFT_S`.
_WIDE_S, _LEFT_S, _SCAN_S, _SCAN_ROWS = 1.0, 0.5, 0.02, 400
#: Knot spacings of `Paths`, coarsest first: a robot's motion is smooth within 0.1 s, unless the hand that guides it trembles.
_SMOOTH_S = (0.1, 0.05, 0.025)
_LOST = 1.2  # residuals of a coarser spline over those of the finest, above which it loses motion, not only the log's noise
#: A minimum of the misfit is clear if it is this far below the median trial in each camera; then landmarks may have constant
#: offsets.  The second number is the largest residual with such offsets, as a share of the pixels' extent.
_CLEAR, _NEAR = 0.4, 0.03
_MOTION = 1.3  # least ratio of the information in the velocities to that which the log's noise alone would seem to hold


@dataclass(frozen=True, eq=False)
class TimeOffset:
    """t_robot = t_video + offset_s, its standard deviation (with correlated errors), and the RMS there and at `trial_s`."""

    offset_s: float
    sd_s: float
    rms_px: float  # over the inliers
    trial_s: np.ndarray
    trial_rms_px: np.ndarray


@lru_cache
def _velocity_gain(every: int) -> float:
    """Noise of a least-squares spline's derivative, by that of samples at 0, 1, 2, ...; a knot for each `every` samples."""
    time = np.arange(20.0 * every + 1)
    knots = np.concatenate([np.zeros(4), time[every:-every:every], np.full(4, time[-1])])
    basis = BSpline(knots, np.eye(len(knots) - 4), 3)
    slopes = basis(time[8 * every : 12 * every], 1)
    return float(np.sqrt((slopes * np.linalg.solve(basis(time).T @ basis(time), slopes.T).T).sum(axis=1).mean()))


def _splines(parts: list[tuple[np.ndarray, np.ndarray]], every: int) -> tuple[list[BSpline], float]:
    """Least-squares splines of (times, positions) with a knot for each `every` samples, and the sd of a coordinate's noise.

    The sd follows from a quantile of the residuals, since a single spike of the log may outweigh all other samples.
    """
    pieces, sizes = [], [np.zeros(1)]
    for t, x in parts:
        knots = np.concatenate([np.full(4, t[0]), t[every : len(t) - every : every], np.full(4, t[-1])])
        basis = BSpline.design_matrix(t, knots, 3)  # sparse: `make_lsq_spline` takes a minute for a log of an hour
        normal = basis.T @ basis
        bands = np.array([np.pad(normal.diagonal(k), (0, k)) for k in range(4)])
        pieces.append(BSpline(knots, solveh_banded(bands, basis.T @ x, lower=True), 3))
        freedom = max(len(t) - len(pieces[-1].c), 1) / len(t)
        sizes.append(np.linalg.norm(x - pieces[-1](t), axis=1) / np.sqrt(freedom))
    return pieces, float(np.quantile(np.concatenate(sizes), 0.75) / np.sqrt(chi2.ppf(0.75, 3)))


class Paths:
    """The landmarks' motion as least-squares cubic splines, one for each stretch without a gap.

    At 100 Hz the derivative of an interpolating spline is mostly encoder noise, which would bias a regression on it.  So
    a landmark's splines have the widest spacing of knots in `_SMOOTH_S` that leaves hardly more residuals than the finest.
    `samples` has for each landmark the times (m,) s, and the positions (m, 3) mm, NaN where the robot reports none.
    `velocity_sd` are the standard deviations, mm/s, of a coordinate of the landmarks' velocities that the log's noise causes.

    >>> time = np.linspace(0, 1, 101)
    >>> paths = Paths([(time, np.outer(time, [1.0, 2.0, 3.0]))])
    >>> paths.at(np.zeros(2, int), np.array([0.5, 9.0])).round(6).tolist()
    [[0.5, 1.0, 1.5], [nan, nan, nan]]
    """

    def __init__(self, samples: Iterable[tuple[np.ndarray, np.ndarray]]) -> None:
        self.pieces: list[list[BSpline]] = []  # for each landmark
        self.velocity_sd = np.zeros(0)
        for time, x in samples:
            known = np.isfinite(x).all(axis=1)
            time, x = time[known], x[known]
            step = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
            # The motion is smooth within 0.1 s, so a dropped sample is bridged; a longer gap is not.
            gaps = np.flatnonzero(np.diff(time) > max(_SMOOTH_S[0], 2.5 * step)) + 1
            parts = [part for part in zip(np.split(time, gaps), np.split(x, gaps), strict=True) if len(part[0]) >= 4]
            # Where a log repeats positions, a fine spline would follow its steps.
            new = time[1:][(np.diff(x, axis=0) != 0).any(axis=1)]
            finest_s = min(2.0 * float(np.median(np.diff(new))) if len(new) > 1 else np.inf, _SMOOTH_S[0])
            spacings = [max(2, int(np.ceil(smooth_s / step))) for smooth_s in _SMOOTH_S if smooth_s >= finest_s]
            fits = [_splines(parts, every) for every in spacings]
            every, (pieces, noise) = next(f for f in zip(spacings, fits, strict=True) if f[1][1] <= _LOST * fits[-1][1])
            self.pieces.append(pieces)
            self.velocity_sd = np.append(self.velocity_sd, noise * _velocity_gain(every) / step)

    @property
    def span_s(self) -> float:
        """Time from the first to the last instant of the paths."""
        ends = np.array([[piece.t[0], piece.t[-1]] for pieces in self.pieces for piece in pieces])
        return float(np.ptp(ends)) if len(ends) else 0.0

    def at(self, landmark: np.ndarray, time: np.ndarray, derivative: int = 0, within_s: float = 0.0) -> np.ndarray:
        """(..., n, 3) mm or mm/s of landmarks (n,) at times (..., n); NaN where no spline covers the time +- `within_s`."""
        x = np.full((*time.shape, 3), np.nan)
        for k, pieces in enumerate(self.pieces):
            for piece in pieces:
                rows = (landmark == k) & (time - within_s >= piece.t[0]) & (time + within_s <= piece.t[-1])
                x[rows] = piece(time[rows], derivative)
        return x


def estimate_time_offset(
    data: Correspondences | tuple[ArrayLike, list[ArrayLike]], kinematics: Kinematics | tuple[ArrayLike, ArrayLike], *,
    start_s: float = 0.0, search_s: float = 0.2,
) -> TimeOffset:  # fmt: skip
    """Offset of the clocks: the time shift of the kinematics with which affine cameras explain the video best.

    A coarse search minimises a Cauchy misfit.  Then Gauss-Newton on the inliers: with the velocity v,
    y = A x(t) + o + (A v) offset is linear in the offset.

    Args:
        data: `Correspondences`, or (time_s (n,), u) with one array a camera, (n, 2) or (n, k, 2) px, NaN where missing.
        kinematics: `lib.recordings.Kinematics`, or (time_s (m,), x_mm (m, 3) or (m, k, 3)), sampled densely enough for
            the motion; their noise is averaged over up to 0.1 s.  NaN = no report; rows in longer gaps are dropped.
        start_s, search_s: Middle and half width of the search.  A wide one may lead beyond the ends of the kinematics.

    A `DataError` refuses fewer than eight instants inside the kinematics, a tool that hardly moves, rows that agree on no
    cameras (`NoConsensusError`), and an offset at the edge of the search.
    """
    if not 0 < search_s < np.inf:
        raise ValueError(f"search_s: half the width of the search must be positive and finite, got {search_s}.")
    time, frame, landmark, y = _rows(data)
    paths = _paths(kinematics)
    if landmark.max(initial=0) >= len(paths.pieces):
        raise ValueError(f"u: {landmark.max() + 1} landmarks, the kinematics have {len(paths.pieces)}.")
    known = np.isfinite(y).any(axis=1) & np.isfinite(time)
    if search_s > _WIDE_S and paths.span_s and known.any():
        seen = time[known], landmark[known], y[known]
        start_s, search_s = _scanned(paths, seen, start_s - search_s, start_s + search_s), _LEFT_S
    known &= np.isfinite(paths.at(landmark, time + start_s, within_s=search_s)).all(axis=1)
    time, frame, landmark, y = time[known], frame[known], landmark[known], y[known]
    n, m = len(np.unique(time)), y.shape[1]
    if n < 8:
        if isinstance(data, Correspondences):
            data.check_detections()
        raise DataError(f"data: {n} frames lie inside the kinematics by search_s = {search_s} s, away from gaps; give 8.")

    def at(offset: float | np.ndarray, derivative: int = 0) -> np.ndarray:
        return paths.at(landmark, time + offset, derivative)

    def linearised(offset: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Derivative of pixels by offset (n, m), weights (n, m, m), residuals (n, m), 0 in views not used; A (1, m, 3)."""
        x, v = at(offset), at(offset, 1)
        matrix = np.vstack([regress(x[rows], y[rows, 2 * c : 2 * c + 2]) for c, rows in enumerate(views.T)])
        A, r = matrix[:, :3], np.where(used, y - x @ matrix[:, :3].T - matrix[:, 3], 0.0)
        sigma_u, sigma_x = estimate_noise(r[views.any(axis=1)], A, 4 * m, views[views.any(axis=1)])
        W = np.broadcast_to(precision((sigma_u**2 * np.eye(m) + sigma_x**2 * A @ A.T)[None], views), (len(x), m, m))
        # The cameras are fitted together with the offset, so remove the part of v that is linear in [x, 1].
        derivative = np.zeros_like(y)
        for c, rows in enumerate(views.T):
            rest = v[rows] - np.column_stack([x[rows], np.ones(rows.sum())]) @ regress(x[rows], v[rows]).T
            derivative[rows, 2 * c : 2 * c + 2] = rest @ A[2 * c : 2 * c + 2].T
        return derivative, W, r, A[None]

    low, high, far_px = start_s - search_s, start_s + search_s, _NEAR * float(np.nanstd(y, axis=0).max() * np.sqrt(12))
    trial = np.linspace(low, high, _GRID)
    x_mm = at(trial[:, None])
    misfits = shift_misfits(x_mm, y)
    clear = (np.median(misfits, axis=0) > misfits.min(axis=0) + _CLEAR).all() and np.ptp(misfits.argmin(axis=0)) <= 2
    offset = float(trial[misfits.sum(axis=1).argmin()])
    for _ in range(2):
        try:
            views = consensus(at(offset), y, None, np.random.default_rng(0))[0]
        except NoConsensusError:
            if trial[2] <= offset <= trial[-3] and not clear:
                raise
            if not clear:
                offset = low if offset < start_s else high
                break
            views = consensus(at(offset), y, far_px, np.random.default_rng(0))[0]
        used = np.repeat(views, 2, axis=1)
        misfit = _rms_px(x_mm, y, views)  # without outliers, squares are more precise than absolute values
        offset = float(trial[misfit.argmin()])
        for _ in range(20):
            derivative, W, r, A = linearised(offset)
            information = np.einsum("ni,nij,nj->", derivative, W, derivative)
            # The log's noise adds to the velocities.  That part seems to determine the offset, but does not.
            noise = paths.velocity_sd[landmark] ** 2 @ np.broadcast_to(np.einsum("kia,nij,kja->n", A, W, A), len(time))
            if information <= _MOTION * noise:
                what = "within search_s the tool hardly moves, or at constant velocity, so no offset can be estimated"
                raise DataError(f"kinematics: {what}; widen search_s.")
            step = np.einsum("ni,nij,nj->", derivative, W, r) / information
            offset = float(np.clip(offset + step, low, high))
            if abs(step) < 1e-7:
                break
    if offset in (low, high):
        raise DataError(f"search_s: the search ends at its {'lower' if offset == low else 'upper'} edge; widen search_s.")
    rms_px = float(_rms_px(at(offset)[None], y, views)[0])
    if rms_px > far_px * (3 if clear else 1):  # a path that comes back to where it was has more minima
        raise DataError(f"search_s: the best offset has an error of {rms_px:.0f} px RMS; widen search_s.")
    x = at(offset)
    J = np.concatenate([derivative[:, :, None], used[:, :, None] * camera_columns(x - x.mean(axis=0), m)], axis=2)
    sd = np.sqrt(sandwich(J, W, r, A, frame, landmark)[0][0, 0]) / (1 - noise / information)
    return TimeOffset(offset, float(sd), rms_px, trial, misfit)


def _scanned(paths: Paths, rows: tuple[np.ndarray, ...], low: float, high: float) -> float:
    """The offset from `low` to `high` with the least misfit of rows (time, landmark, pixels)."""
    some = np.unique(np.linspace(0, len(rows[0]) - 1, _SCAN_ROWS).astype(int))
    time, landmark, y = (values[some] for values in rows)
    ends = np.array([[piece.t[0], piece.t[-1]] for pieces in paths.pieces for piece in pieces])
    low, high = max(low, ends.min() - time.max()), min(high, ends.max() - time.min())  # beyond that there is no overlap
    trial = np.arange(low, max(low, high) + _SCAN_S, _SCAN_S)
    parts = np.array_split(trial, len(trial) // 64 + 1)  # to save memory
    misfit = np.concatenate([shift_misfits(paths.at(landmark, time + part[:, None]), y).sum(axis=1) for part in parts])
    return float(trial[misfit.argmin()])


def clock_error(found: Calibration, data: Correspondences, kinematics: Kinematics, offset_s: float) -> tuple[float, float]:
    """The remaining error, s, of the clock offset `offset_s` with which `data` were paired, and its standard deviation.

    A `further_step` from the calibration `found` of `data`; 0 and infinity if the kinematics are too sparse for it.
    Unlike `estimate_time_offset` it allows for landmark offsets; in a turning tool these look like a clock offset.
    """
    rows = data.subset(found.inliers)
    v = np.nan_to_num(_paths(kinematics).at(rows.landmark, rows.time_s + offset_s, 1))
    if np.count_nonzero(v.any(axis=1)) < 8:
        return 0.0, np.inf
    return further_step(found, data, (found.system[0] @ v[:, :, None])[:, :, 0])[:2]


def _rms_px(x: np.ndarray, y: np.ndarray, views: np.ndarray) -> np.ndarray:
    """RMS residuals (t,) of pixels y (n, m) in `views` (n, cameras), for least-squares cameras of positions x (t, n, 3)."""
    squares = np.zeros(len(x))
    for c, rows in enumerate(views.T):
        own, u = (v - v.mean(axis=-2, keepdims=True) for v in (x[:, rows], y[rows, 2 * c : 2 * c + 2]))
        A = np.linalg.pinv(own.mT @ own, hermitian=True) @ (own.mT @ u)
        squares += ((u - own @ A) ** 2).sum(axis=(1, 2))
    return np.sqrt(squares / views.sum())


def shift_misfits(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Misfit (t, cameras) of pixels y (n, m), NaN = not seen, to the cameras fitted to each trial's positions x (t, n, 3).

    It is the mean negative log of a bivariate Cauchy density whose scale is the median residual, which is robust to outliers.
    It is infinite where fewer than eight rows, or fewer than 60 % of them, have a position.
    """
    if len(x) > 64:  # in parts that stay in the processor's cache: of many trials this takes half the time
        return np.concatenate([shift_misfits(part, y) for part in np.split(x, range(64, len(x), 64))])
    found = np.full((len(x), y.shape[1] // 2), np.inf)
    for c, u in enumerate(np.split(y, found.shape[1], axis=1)):
        seen = np.isfinite(u).all(axis=1)
        used = np.isfinite(x[:, seen]).all(axis=2)
        good = used.sum(axis=1) >= max(8, 0.6 * seen.sum())
        used, own, u = used[good], x[good][:, seen], u[seen]
        own = own - own[used].sum(axis=0) / max(used.sum(), 1)  # centred, else the normal equations lose digits
        H = np.where(used[:, :, None], np.concatenate([own, np.ones((*used.shape, 1))], axis=2), 0.0)
        weight, middle = used, (used.sum(axis=1, keepdims=True) - [1, 0]) // 2  # ranks of the median; nanmedian is slower
        for _ in range(10):
            G = (WH := (H * weight[:, :, None]).transpose(0, 2, 1)) @ H
            G += 1e-14 * np.trace(G, axis1=1, axis2=2)[:, None, None] * np.eye(4)  # for a tool at rest it would be singular
            r = u - H @ np.linalg.solve(G, WH @ u)
            r2 = r[..., 0] ** 2 + r[..., 1] ** 2  # a sum over an axis of two takes ten times as long
            ranked = np.take_along_axis(np.sort(np.where(used, r2, np.inf), axis=1), middle, axis=1)
            s2 = np.maximum(ranked.mean(axis=1, keepdims=True), 1e-4)
            weight = np.where(used, 1.0 / (s2 + r2), 0.0)
        found[good, c] = np.log(s2[:, 0]) + 1.5 * np.average(np.log1p(r2 / s2), axis=1, weights=used)
    return found


def _rows(data: Correspondences | tuple) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times (n,), frames (n,), landmarks (n,) and pixels (n, m), NaN = not seen; one row for each landmark of a frame."""
    if isinstance(data, Correspondences):
        return data.time_s, data.frame, data.landmark, data.stacked_px
    time, u = np.asarray(data[0], dtype=np.float64), [np.asarray(pixels, dtype=np.float64) for pixels in data[1]]
    u = [pixels[:, None] if pixels.ndim == 2 else pixels for pixels in u]
    if any(p.ndim != 3 or p.shape != (len(time), u[0].shape[1], 2) for p in u):
        raise ValueError(f"u: expected ({len(time)}, k, 2) pixels a camera, got {[p.shape for p in u]}.")
    k = u[0].shape[1]
    y = np.concatenate([np.where(np.isfinite(p).all(axis=2, keepdims=True), p, np.nan) for p in u], axis=2)
    frame, landmark = np.divmod(np.arange(len(time) * k), k)
    return np.repeat(time, k), frame, landmark, y.reshape(len(time) * k, -1)


def _paths(kinematics: Kinematics | tuple) -> Paths:
    given = kinematics if isinstance(kinematics, tuple) else (kinematics.time_s, kinematics.x_mm)
    time, x = (np.asarray(values, dtype=np.float64) for values in given)
    x = x[:, None] if x.ndim == 2 else x
    if time.ndim != 1 or x.ndim != 3 or x.shape[2] != 3 or len(x) != len(time):
        raise ValueError(f"kinematics: expected times (m,) and positions (m, k, 3) or (m, 3), got {time.shape}, {x.shape}.")
    if len(time) < 4 or not np.isfinite(time).all() or (np.diff(time) <= 0).any():
        raise ValueError("kinematics: times must be finite and increase, and at least four samples are needed.")
    return Paths([(time, x[:, k]) for k in range(x.shape[1])])
