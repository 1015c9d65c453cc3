"""The offset between the clocks of video and robot."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline, make_lsq_spline

from lib.calibration.affine import Moments, affine_minimum, estimate_noise
from lib.correspondences import Correspondences
from lib.recordings import Kinematics

__all__ = ["TimeOffset", "estimate_time_offset"]

_GRID = 41  # trial offsets of the coarse search


@dataclass(frozen=True, eq=False)
class TimeOffset:
    """t_robot = t_video + offset_s, its sd, and the reprojection RMS there and at the offsets `trial_s` tried first."""

    offset_s: float
    sd_s: float
    rms_px: float
    trial_s: np.ndarray
    trial_rms_px: np.ndarray


class _Path:
    """One landmark's motion as least-squares cubic splines with a knot every `smooth_s`, a piece a stretch without a gap.

    The derivative of an interpolating spline is mostly encoder noise at 100 Hz, which biases what is regressed on it.
    """

    def __init__(self, time: np.ndarray, x: np.ndarray, smooth_s: float) -> None:
        known = np.isfinite(x).all(axis=1)
        time, x = time[known], x[known]
        step = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
        every = max(4, int(np.ceil(smooth_s / step)))
        # The motion is smooth within `smooth_s`, so a dropped sample is bridged; a longer silence is not.
        gaps = np.flatnonzero(np.diff(time) > max(smooth_s, 2.5 * step))
        self.pieces: list[BSpline] = []
        for t, part in zip(np.split(time, gaps + 1), np.split(x, gaps + 1), strict=True):
            if len(t) >= 4:
                knots = np.concatenate([np.full(4, t[0]), t[every : len(t) - every : every], np.full(4, t[-1])])
                self.pieces.append(make_lsq_spline(t, part, knots, k=3))

    def covers(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """(n,) bool: one piece holds the whole interval."""
        inside = [(low >= piece.t[0]) & (high <= piece.t[-1]) for piece in self.pieces]
        return np.any([np.zeros(len(low), dtype=bool), *inside], axis=0)

    def at(self, time: np.ndarray, derivative: int = 0) -> np.ndarray:
        """(n, 3) mm, or mm/s, at times that the pieces cover."""
        x = np.full((len(time), 3), np.nan)
        for piece in self.pieces:
            rows = (time >= piece.t[0]) & (time <= piece.t[-1])
            x[rows] = piece(time[rows], derivative)
        return x


def estimate_time_offset(
    data: Correspondences | tuple[ArrayLike, list[ArrayLike]], kinematics: Kinematics | tuple[ArrayLike, ArrayLike], *,
    start_s: float = 0.0, search_s: float = 0.2, smooth_s: float = 0.1,
) -> TimeOffset:  # fmt: skip
    """Offset of the clocks: the shift of the kinematics that lets affine cameras explain the video best.

    A coarse search, then Gauss-Newton: with v the velocity, y = A x(t) + o + (A v) offset is linear in the offset.

    Args:
        data: `Correspondences`, or (time_s (n,), u) with one array a camera, (n, 2) or (n, k, 2) px, NaN where missing.
        kinematics: `lib.recordings.Kinematics`, or (time_s (m,), x_mm (m, 3) or (m, k, 3)), denser than the motion is
            fast.  NaN where the robot is silent: rows that fall into a gap of more than `smooth_s` are left out.
        start_s, search_s: Middle and half width of the search.
        smooth_s: Time within which the motion is smooth: the kinematics' noise is averaged over it.

    Raises:
        ValueError: For wrong shapes, fewer than eight instants inside the kinematics, a tool at rest, or an offset at the
            end of the search.
    """
    time, landmark, y = _rows(data)
    paths = _paths(kinematics, smooth_s)
    if landmark.max(initial=0) >= len(paths):
        raise ValueError(f"u: {landmark.max() + 1} landmarks, the kinematics have {len(paths)}.")
    known = np.isfinite(y).all(axis=1) & np.isfinite(time)
    for k, path in enumerate(paths):
        rows = known & (landmark == k)
        known[rows] = path.covers(time[rows] + start_s - search_s, time[rows] + start_s + search_s)
    time, landmark, y = time[known], landmark[known], y[known]
    n, m = len(np.unique(time)), y.shape[1]
    if n < 8:
        if isinstance(data, Correspondences):
            data.check_detections()
        raise ValueError(f"data: {n} frames lie inside the kinematics by search_s = {search_s} s, away from gaps; give 8.")

    def at(offset: float, derivative: int = 0) -> np.ndarray:
        x = np.empty((len(time), 3))
        for k, path in enumerate(paths):
            x[landmark == k] = path.at(time[landmark == k] + offset, derivative)
        return x

    def rms(offset: float) -> float:
        return float(np.sqrt(4.0 * affine_minimum(Moments.of(at(offset), y), 1.0, 0.0).cost / y.size))

    def step_and_sd(offset: float) -> tuple[float, float]:
        x, v = at(offset), at(offset, 1)
        matrix = affine_minimum(Moments.of(x, y), 1.0, 0.0).matrix
        A, r = matrix[:, :3], y - x @ matrix[:, :3].T - matrix[:, 3]
        sigma_u, sigma_x = estimate_noise(r, A, 4 * m)
        W = np.linalg.inv(sigma_u**2 * np.eye(m) + sigma_x**2 * A @ A.T)
        # Sweep [x, 1] out of the velocity's image: the cameras are fitted along with the offset.
        H = np.column_stack([x - x.mean(axis=0), np.ones(len(x))])
        image = (v - H @ np.linalg.lstsq(H, v, rcond=None)[0]) @ A.T
        information = np.einsum("ni,ij,nj->", image, W, image)
        if information <= 0:
            raise ValueError("kinematics: the tool moves at no varying speed; the offset cannot be seen.")
        return float(np.einsum("ni,ij,nj->", image, W, r) / information), float(information**-0.5)

    low, high = start_s - search_s, start_s + search_s
    trial = np.linspace(low, high, _GRID)
    misfit = np.array([rms(offset) for offset in trial])
    offset = float(trial[misfit.argmin()])
    for _ in range(20):
        step, sd = step_and_sd(offset)
        offset = float(np.clip(offset + step, low, high))
        if abs(step) < 1e-7:
            break
    if offset in (low, high):
        raise ValueError(f"search_s: {offset:.3f} s, lies at the end of the search; widen search_s or move start_s.")
    return TimeOffset(offset, sd, rms(offset), trial, misfit)


def _rows(data: Correspondences | tuple) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (n,), landmarks (n,) and pixels (n, m), a row a landmark."""
    if isinstance(data, Correspondences):
        seen = data.seen.all(axis=1)[:, None]
        return data.time_s, data.landmark, np.where(seen, np.hstack([data.u_left, data.u_right]), np.nan)
    time, u = np.asarray(data[0], dtype=np.float64), [np.asarray(pixels, dtype=np.float64) for pixels in data[1]]
    u = [pixels[:, None] if pixels.ndim == 2 else pixels for pixels in u]
    if any(p.ndim != 3 or p.shape != (len(time), u[0].shape[1], 2) for p in u):
        raise ValueError(f"u: expected ({len(time)}, k, 2) pixels a camera, got {[p.shape for p in u]}.")
    k = u[0].shape[1]
    return np.repeat(time, k), np.tile(np.arange(k), len(time)), np.concatenate(u, axis=2).reshape(len(time) * k, -1)


def _paths(kinematics: Kinematics | tuple, smooth_s: float) -> list[_Path]:
    given = kinematics if isinstance(kinematics, tuple) else (kinematics.time_s, kinematics.x_mm)
    time, x = (np.asarray(values, dtype=np.float64) for values in given)
    x = x[:, None] if x.ndim == 2 else x
    if time.ndim != 1 or x.ndim != 3 or x.shape[2] != 3 or len(x) != len(time):
        raise ValueError(f"kinematics: expected times (m,) and positions (m, k, 3) or (m, 3), got {time.shape}, {x.shape}.")
    if len(time) < 4 or not np.isfinite(time).all() or (np.diff(time) <= 0).any():
        raise ValueError("kinematics: times must be finite and increase, and at least four samples are needed.")
    return [_Path(time, x[:, k], smooth_s) for k in range(x.shape[1])]
