"""Smooths the robot's log.  A tool moves smoothly from sample to sample, and noise does not."""

from dataclasses import replace

import numpy as np

from lib.recordings.kinematics import Kinematics

#: Degree of the local polynomials, and half-widths of their windows in samples; each sample gets the best of these windows.
_DEGREE, _HALF_WIDTHS = 4, (3, 4, 5, 7, 10, 14, 20)
#: Samples on either side whose errors are averaged to choose a window.  They are few, since hands start and stop at once.
_NEIGHBOURS = 4
#: Fewest samples in a window beyond the number of coefficients, and number of samples that are processed together.
_SPARE, _CHUNK = 2, 20000
#: Largest change (RMS) that can be noise, in units of the robot's noise.
_LARGEST_CHANGE = 1.5


def smoothed(kinematics: Kinematics, noise_mm: float) -> tuple[Kinematics, float]:
    """The log, each sample replaced by the value of a local polynomial in time; and an estimate of the remaining noise.

    Each sample gets the window whose polynomials have the smallest leave-one-out error at it and its neighbours.  Where that
    would move a landmark by more than 1.5 times `noise_mm`, the robot's accuracy per coordinate (RMS of a few samples), the
    samples stay as they are: at jumps, and where the log is too slow for the motion.  Samples that lack a landmark, or repeat
    a neighbour as in a frozen log, stay as well, and no polynomial uses them.  The remaining noise is an RMS in mm per
    coordinate; it is at least the part of `noise_mm` that was not removed, since slow errors look like motion.  (Cleveland,
    "Robust locally weighted regression and smoothing scatterplots", 1979; Mallows, "Some comments on Cp", 1973.)

    >>> rng, time_s = np.random.default_rng(0), np.arange(400) / 100
    >>> x_mm = np.stack([np.sin(3 * time_s), np.cos(2 * time_s), time_s], axis=1)[:, None]
    >>> found, left_mm = smoothed(Kinematics(time_s, x_mm + rng.normal(0, 0.01, x_mm.shape)), 0.01)
    >>> bool((found.x_mm - x_mm).std() < 0.005), round(left_mm, 3)
    (True, 0.006)
    """
    x = kinematics.x_mm.reshape(len(kinematics.x_mm), -1)
    repeats = np.append(False, (np.diff(x, axis=0) == 0).all(axis=1))  # as in a frozen log
    known = np.isfinite(x).all(axis=1) & ~(repeats | np.append(repeats[1:], False))
    best, least, kept_leverage = x.copy(), np.full(len(x), np.inf), np.ones(len(x))
    if known.sum() <= 2 * _HALF_WIDTHS[-1]:
        return kinematics, noise_mm
    for half in _HALF_WIDTHS:
        fitted, leverage = _local_polynomials(kinematics.time_s, x, known, half)
        error = _local_means(((x - fitted) / (1 - leverage)[:, None]) ** 2)  # leave-one-out
        better = (error < least) & np.isfinite(fitted).all(axis=1)
        best[better], least[better], kept_leverage[better] = fitted[better], error[better], leverage[better]
    moves = np.max([_local_means(part) for part in np.split((x - best) ** 2, kinematics.x_mm.shape[1], axis=1)], axis=0)
    smooth = moves < (_LARGEST_CHANGE * noise_mm) ** 2
    best = np.where(smooth[:, None], best, x)
    moved, mean_leverage = ((x - best)[known] ** 2).mean(), np.where(smooth, kept_leverage, 1.0)[known].mean()
    left = max(moved + (2 * mean_leverage - 1) * noise_mm**2, noise_mm**2 - moved)
    return replace(kinematics, x_mm=best.reshape(kinematics.x_mm.shape)), float(np.sqrt(left))


def _local_means(squares: np.ndarray) -> np.ndarray:
    """Means (n,) of squares (n, m) over each sample and its neighbours; infinite where all are NaN."""
    known = np.isfinite(squares).all(axis=1)
    kernel = np.ones(2 * _NEIGHBOURS + 1)
    count = np.convolve(known, kernel, "same")
    total = np.convolve(np.where(known[:, None], squares, 0).mean(axis=1), kernel, "same")
    return np.where(count > 0, total / np.maximum(count, 1), np.inf)


def _local_polynomials(time_s: np.ndarray, x: np.ndarray, known: np.ndarray, half: int) -> tuple[np.ndarray, np.ndarray]:
    """Values (n, m) at each sample of the polynomial fitted in its window, NaN where too few samples are `known` (n,) bool.

    Also returns the leverage (n,): the weight of the sample itself in its fitted value.
    """
    n, reach_s = len(x), 1.01 * half * np.median(np.diff(time_s))
    fitted, leverage, x = np.full(x.shape, np.nan), np.zeros(n), np.where(known[:, None], x, 0.0)
    for first in range(0, n, _CHUNK):
        rows = np.arange(first, min(first + _CHUNK, n))
        window = rows[:, None] + np.arange(-half, half + 1)
        at = window.clip(0, n - 1)
        when = (time_s[at] - time_s[rows, None]) / reach_s
        weight = (known[at] & (window == at) & (np.abs(when) <= 2)).astype(float)
        enough = known[rows] & (weight.sum(axis=1) >= _DEGREE + 1 + _SPARE)
        order = np.arange(_DEGREE + 1)
        powers = np.vander(when[enough].ravel(), 2 * _DEGREE + 1, increasing=True).reshape(-1, 2 * half + 1, 2 * _DEGREE + 1)
        G = (weight[enough, None] @ powers)[:, 0, order[:, None] + order]  # sums of the products of two powers
        coefficients = np.linalg.solve(G + 1e-12 * np.eye(len(order)), np.eye(len(order))[:, :1])
        weights_in_fit = weight[enough] * (powers[:, :, order] @ coefficients)[:, :, 0]
        fitted[rows[enough]] = np.einsum("ni,nim->nm", weights_in_fit, x[at[enough]])
        leverage[rows[enough]] = weights_in_fit[:, half]
    return fitted, leverage
