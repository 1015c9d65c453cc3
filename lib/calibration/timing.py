"""Clocks: the offset between video and robot, and the rows of a rolling shutter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline, CubicSpline, make_lsq_spline

from lib.calibration.affine import Moments, affine_minimum, dlt, estimate_noise
from lib.calibration.robust import consensus

__all__ = ["TimeOffset", "estimate_time_offset", "rolling_shutter"]


@dataclass(frozen=True)
class TimeOffset:
    """t_robot = t_video + offset_s, its standard deviation, and the reprojection RMS (px, distance in an image) there."""

    offset_s: float
    sd_s: float
    rms_px: float

    @property
    def significant(self) -> bool:
        """True where the offset differs from zero by more than three standard deviations."""
        return abs(self.offset_s) > 3.0 * self.sd_s

    def __str__(self) -> str:
        return f"video to robot: {1e3 * self.offset_s:.2f} +- {1e3 * self.sd_s:.2f} ms"


def _spline(time_s: ArrayLike, x_mm: ArrayLike, smooth_s: float) -> tuple[CubicSpline, BSpline, np.ndarray]:
    """Interpolating and smoothing splines of the kinematics (values (n, k, 3)), and the checked times.

    The derivative of an interpolating spline is mostly encoder noise at 100 Hz, and noise in the velocity biases whatever is
    regressed on it.  The smoothing one is a least-squares cubic with a knot every `smooth_s`.
    """
    time, x = np.asarray(time_s, dtype=np.float64), np.asarray(x_mm, dtype=np.float64)
    if x.ndim == 2:
        x = x[:, None]
    if time.ndim != 1 or x.ndim != 3 or x.shape[2] != 3 or len(x) != len(time):
        raise ValueError(
            f"kinematics: expected times (m,) and positions (m, k, 3) or (m, 3), got {time.shape}, {x.shape}."
        )
    if len(time) < 4 or not np.isfinite(time).all() or not np.isfinite(x).all() or (np.diff(time) <= 0).any():
        raise ValueError("kinematics: times must increase, and at least four samples, all finite, are needed.")
    every = max(4, int(np.ceil(smooth_s / np.median(np.diff(time)))))
    inner = time[every : len(time) - every : every]
    knots = np.concatenate([np.full(4, time[0]), inner, np.full(4, time[-1])])
    return CubicSpline(time, x), make_lsq_spline(time, x, knots, k=3), time


def _images(u: Sequence[ArrayLike], frames: int, landmarks: int) -> np.ndarray:
    arrays = []
    for pixels in u:
        pixels = np.asarray(pixels, dtype=np.float64)
        if pixels.ndim == 2:
            pixels = pixels[:, None]
        if pixels.shape != (frames, landmarks, 2):
            raise ValueError(f"u: expected ({frames}, {landmarks}, 2) pixels a camera, got {pixels.shape}.")
        arrays.append(pixels)
    return np.concatenate(arrays, axis=2)


def estimate_time_offset(
    video_time_s: ArrayLike,
    u: Sequence[ArrayLike],
    robot_time_s: ArrayLike,
    robot_x_mm: ArrayLike,
    *,
    start_s: float = 0.0,
    search_s: float = 0.2,
    smooth_s: float = 0.1,
) -> TimeOffset:
    """Offset of the clocks: the shift of the kinematics that lets affine cameras explain the video best.

    A coarse search, then Gauss-Newton: with v the velocity, y = A x(t) + o + (A v) offset is linear in the offset.

    Parameters
    ----------
    video_time_s:
        (n,) of the frames.
    u:
        One array a camera, (n, 2) or (n, k, 2) px; NaN = missing.
    robot_time_s, robot_x_mm:
        (m,) and (m, 3) or (m, k, 3), denser than the motion is fast.
    start_s, search_s:
        Middle and half width of the search.
    smooth_s:
        Time within which the motion is smooth: the kinematics' noise is averaged over it.

    Raises
    ------
    ValueError
        For wrong shapes, or fewer than eight frames inside the kinematics, or a tool that stands still.
    """
    _, spline, robot_time = _spline(robot_time_s, robot_x_mm, smooth_s)
    time = np.asarray(video_time_s, dtype=np.float64)
    y = _images(u, len(time), spline.c.shape[1])
    m = y.shape[2]
    inside = (time + start_s - search_s >= robot_time[0]) & (time + start_s + search_s <= robot_time[-1])
    if inside.sum() < 8:
        raise ValueError(
            f"video_time_s: {int(inside.sum())} frames lie inside the kinematics by search_s = {search_s} s; 8 are needed."
        )
    time, y = time[inside], y[inside].reshape(-1, m)
    known = np.isfinite(y).all(axis=1)
    y = y[known]

    def misfit(offset: float) -> float:
        x = spline(time + offset).reshape(-1, 3)[known]
        return affine_minimum(Moments.of(x, y), 1.0, 0.0).cost

    def step_and_sd(offset: float) -> tuple[float, float]:
        x = spline(time + offset).reshape(-1, 3)[known]
        v = spline(time + offset, 1).reshape(-1, 3)[known]
        matrix = affine_minimum(Moments.of(x, y), 1.0, 0.0).matrix
        r = y - x @ matrix[:, :3].T - matrix[:, 3]
        sigma_u, sigma_x = estimate_noise(r, matrix[:, :3], 4 * m)
        W = np.linalg.inv(sigma_u**2 * np.eye(m) + sigma_x**2 * matrix[:, :3] @ matrix[:, :3].T)
        # Sweep [x, 1] out of the velocity's image: the cameras are fitted along with the offset.
        H = np.column_stack([x - x.mean(axis=0), np.ones(len(x))])
        image = (v - H @ np.linalg.lstsq(H, v, rcond=None)[0]) @ matrix[:, :3].T
        information = np.einsum("ni,ij,nj->", image, W, image)
        if information <= 0:
            raise ValueError("robot_x_mm: the tool moves at no varying speed; the offset cannot be seen.")
        return float(np.einsum("ni,ij,nj->", image, W, r) / information), float(information**-0.5)

    offset = min(np.linspace(start_s - search_s, start_s + search_s, 41), key=misfit)
    for _ in range(20):
        step, sd = step_and_sd(offset)
        offset = float(np.clip(offset + step, start_s - search_s, start_s + search_s))
        if abs(step) < 1e-7:
            break
    return TimeOffset(offset, sd, float(np.sqrt(4.0 * misfit(offset) / y.size)))


def rolling_shutter(
    frame_time_s: ArrayLike,
    u: Sequence[ArrayLike],
    robot_time_s: ArrayLike,
    robot_x_mm: ArrayLike,
    *,
    readout_s: float,
    height_px: int,
    offset_s: float = 0.0,
    smooth_s: float = 0.1,
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Correspondences of a rolling shutter: kinematics at the time when the landmark's own row was read.

    The middle row is read at the frame's time, the last row half `readout_s` later.  The two cameras see a landmark
    on different rows; x is taken at the mean of their times, and each camera's pixel is moved to it by the
    landmark's velocity.

    Parameters
    ----------
    frame_time_s:
        (n,) video clock.
    u:
        One array a camera, (n, 2) or (n, k, 2) px; NaN = missing.
    robot_time_s, robot_x_mm:
        (m,) robot clock and (m, 3) or (m, k, 3) mm.
    readout_s:
        First to last row; 0 is a global shutter.
    height_px:
        Image height.
    offset_s:
        t_robot = t_video + offset_s.
    smooth_s:
        As in `estimate_time_offset`, for the velocity.

    Returns
    -------
    x_mm:
        (n, 3) or (n, k, 3), as `robot_x_mm` is; NaN outside the kinematics or where a pixel is missing.
    u:
        One array a camera, shaped as given.

    Raises
    ------
    ValueError
        For wrong shapes or a negative read-out time.
    """
    if readout_s < 0 or height_px < 2:
        raise ValueError(f"readout_s, height_px: {readout_s} and {height_px} make no shutter.")
    spline, smooth, robot_time = _spline(robot_time_s, robot_x_mm, smooth_s)
    time, landmarks = np.asarray(frame_time_s, dtype=np.float64), smooth.c.shape[1]
    y = _images(u, len(time), landmarks).reshape(len(time), landmarks, -1, 2)
    row_time = readout_s * (y[..., 1] / (height_px - 1) - 0.5)  # (n, k, cameras)
    mean_time = time[:, None] + offset_s + row_time.mean(axis=2)
    known = np.isfinite(mean_time) & (mean_time >= robot_time[0]) & (mean_time <= robot_time[-1])
    x, v = np.full((*mean_time.shape, 3), np.nan), np.full((*mean_time.shape, 3), np.nan)
    for k in range(landmarks):
        use = known[:, k]
        x[use, k] = spline(mean_time[use, k])[:, k]
        v[use, k] = smooth(mean_time[use, k], 1)[:, k]
    corrected = []
    agree = known.copy()  # a gross outlier must not spoil the cameras that turn velocity into pixels
    agree[known] = consensus(x[known], y[known].reshape(known.sum(), -1), None, np.random.default_rng(0))
    for c, given in enumerate(u):
        pixels = y[:, :, c]
        A = dlt(x[agree], pixels[agree]).linear
        moved = pixels - (v @ A.T) * (row_time[..., c] - row_time.mean(axis=2))[..., None]
        corrected.append(moved.reshape(np.shape(given)))
    return (x[:, 0] if np.ndim(robot_x_mm) == 2 else x), corrected
