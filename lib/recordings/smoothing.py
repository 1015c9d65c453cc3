"""The robot's log without most of its noise: a tool moves smoothly from sample to sample, and noise does not."""

from dataclasses import replace

import numpy as np

from lib.recordings.recording import Kinematics

#: Degree of the local polynomials, and half the samples in their windows, of which each sample has its own.
_DEGREE, _HALVES = 4, (3, 4, 5, 7, 10, 14, 20)
#: So many samples on either side tell with it which window predicts best: few, since hands start and stop at once.
_BESIDE = 4
#: Fewest samples more than the polynomial has coefficients; samples that are looked at together.
_SPARE, _CHUNK = 2, 20000
#: What moves a landmark by more than the robot's noise times this (RMS) is no noise.
_MOST = 1.5


def smoothed(kinematics: Kinematics, noise_mm: float) -> tuple[Kinematics, float]:
    """The log with each sample moved to a local polynomial of the samples around it, in their own times, and the noise left.

    Each sample has the window whose polynomials best predict it and its neighbours when these are left out.  Where that would
    move a landmark by more than 1.5 times `noise_mm`, the robot's accuracy per coordinate (RMS of a few samples), they stay
    as they are: at jumps, and where the log is too slow for the motion.  A sample that lacks a landmark, or repeats its
    neighbour as a frozen log does, stays too, and no polynomial uses it.  The noise left is an RMS in mm per coordinate
    (Mallows, "Some comments on Cp", 1973).  What the polynomials do not take away counts as left, since an error that changes
    slowly looks like motion.  (Cleveland, "Robust locally weighted regression and smoothing scatterplots", 1979.)

    >>> rng, time_s = np.random.default_rng(0), np.arange(400) / 100
    >>> x_mm = np.stack([np.sin(3 * time_s), np.cos(2 * time_s), time_s], axis=1)[:, None]
    >>> found, left_mm = smoothed(Kinematics(time_s, x_mm + rng.normal(0, 0.01, x_mm.shape)), 0.01)
    >>> bool((found.x_mm - x_mm).std() < 0.005), round(left_mm, 3)
    (True, 0.006)
    """
    x = kinematics.x_mm.reshape(len(kinematics.x_mm), -1)
    repeats = np.append(False, (np.diff(x, axis=0) == 0).all(axis=1))  # the log stands still
    known = np.isfinite(x).all(axis=1) & ~(repeats | np.append(repeats[1:], False))
    best, least, share = x.copy(), np.full(len(x), np.inf), np.ones(len(x))
    if known.sum() <= 2 * _HALVES[-1]:
        return kinematics, noise_mm
    for half in _HALVES:
        fitted, own = _local_polynomials(kinematics.time_s, x, known, half)
        error = _thereabouts(((x - fitted) / (1 - own)[:, None]) ** 2)  # had the sample been left out
        better = (error < least) & np.isfinite(fitted).all(axis=1)
        best[better], least[better], share[better] = fitted[better], error[better], own[better]
    moves = np.max([_thereabouts(part) for part in np.split((x - best) ** 2, kinematics.x_mm.shape[1], axis=1)], axis=0)
    smooth = moves < (_MOST * noise_mm) ** 2
    best = np.where(smooth[:, None], best, x)
    moved, own = ((x - best)[known] ** 2).mean(), np.where(smooth, share, 1.0)[known].mean()
    left = max(moved + (2 * own - 1) * noise_mm**2, noise_mm**2 - moved)
    return replace(kinematics, x_mm=best.reshape(kinematics.x_mm.shape)), float(np.sqrt(left))


def _thereabouts(squares: np.ndarray) -> np.ndarray:
    """Means (n,) of squares (n, m) over the samples beside each one; infinite without any."""
    known = np.isfinite(squares).all(axis=1)
    kernel = np.ones(2 * _BESIDE + 1)
    count = np.convolve(known, kernel, "same")
    total = np.convolve(np.where(known[:, None], squares, 0).mean(axis=1), kernel, "same")
    return np.where(count > 0, total / np.maximum(count, 1), np.inf)


def _local_polynomials(time_s: np.ndarray, x: np.ndarray, known: np.ndarray, half: int) -> tuple[np.ndarray, np.ndarray]:
    """Values (n, m) at each sample of the polynomial through its window, NaN where too few samples are `known` (n,) bool.

    And the weight (n,) of the sample itself in its value.
    """
    n, reach_s = len(x), 1.01 * half * np.median(np.diff(time_s))
    fitted, own, x = np.full(x.shape, np.nan), np.zeros(n), np.where(known[:, None], x, 0.0)
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
        share = weight[enough] * (powers[:, :, order] @ coefficients)[:, :, 0]
        fitted[rows[enough]] = np.einsum("ni,nim->nm", share, x[at[enough]])
        own[rows[enough]] = share[:, half]
    return fitted, own
