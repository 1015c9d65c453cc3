"""The robot's log: the landmarks' positions over time, read from kinematics.csv and interpolated."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from lib.recordings.tables import columns, read_table, refuse

ORDER = "time_s must be a number, larger than in the row before; sort the rows, and delete repeated ones"
_BRIDGED_S = 0.1 + 1e-6  # the motion is smooth for so long (and rounding): samples dropped within it are interpolated
_GAP_S = 0.5  # a step between samples that is longer than this and than five usual steps is not interpolated
_FARTHEST_MM = 1e5  # coordinates beyond this cannot be in millimetres
#: A log shows its noise if the distances of its samples from a cubic through two neighbours on each side are usually this
#: many digits, and each is opposed to the next (-0.8 for white noise, 1 for motion); fewest samples and coordinates for that.
_DIGITS, _OPPOSED, _FEWEST, _COORDINATES = 5.0, -0.5, 100, 3
#: Filled samples are nearer to their cubic than this share of the usual distance, or than their rounding, in digits, allows;
#: on the way the tool moves by this many usual distances.  A robot that holds still has less noise, too.
_SMOOTH, _ROUNDING, _MOVES = 0.05, 1.34, 10.0


def kinematics_columns(landmarks: Sequence[str]) -> list[str]:
    """The columns of kinematics.csv."""
    return ["time_s", *columns(["x_mm", "y_mm", "z_mm"], landmarks)]


@dataclass(frozen=True, eq=False)
class Kinematics:
    """The robot's report of the landmarks.

    Attributes:
        time_s: (m,) robot clock, strictly increasing.
        x_mm: (m, k, 3) the landmarks in the robot frame; NaN where a sample was dropped, or a program filled a gap.
        filled: (m,) bool, the samples with which a program filled gaps; None is none.

    >>> report = Kinematics(np.array([0.0, 1.0]), np.zeros((2, 3, 3)) + np.array([[[0]], [[4]]]))
    >>> report.at([0.25, 2.0])[:, 0, 0].tolist()
    [1.0, nan]
    """

    time_s: np.ndarray
    x_mm: np.ndarray
    filled: np.ndarray | None = None

    def without_filled(self) -> Self:
        """A copy without the samples with which a program filled gaps of over 0.1 s.

        They lie on straight or smooth curves, to the last digits, in a log whose other samples show the robot's noise.
        """
        filled = _filled(self.time_s, self.x_mm.reshape(len(self.x_mm), -1))
        return replace(self, x_mm=np.where(filled[:, None, None], np.nan, self.x_mm), filled=filled)

    def at(self, time_s: ArrayLike) -> np.ndarray:
        """Landmarks (n, k, 3) mm at robot times (n,), or (n, k) for a time of each landmark; linear between samples.

        NaN before the first sample, after the last, in steps over 0.5 s and five usual steps, and where samples were dropped
        for longer than 0.1 s, as between the neighbours of one that was dropped from a slow log.
        """
        time, k = np.asarray(time_s, dtype=np.float64), self.x_mm.shape[1]
        time = np.repeat(time[:, None], k, axis=1) if time.ndim == 1 else time
        if time.ndim != 2 or time.shape[1] != k:
            raise ValueError(f"time_s: expected (n,) or (n, {k}), got {time.shape}.")
        x, known = np.full((*time.shape, 3), np.nan), time[np.isfinite(time)]
        # A log may have a million samples, of which a frame needs few.
        span_s = (known.min() - _BRIDGED_S, known.max() + _BRIDGED_S) if known.size else (0.0, 0.0)
        low, high = np.searchsorted(self.time_s, span_s)
        near_s, near_mm = (part[max(low - 2, 0) : high + 2] for part in (self.time_s, self.x_mm))
        for landmark, at_s in enumerate(time.T):  # exactly on a sample, a dropped neighbour has no effect
            there = np.flatnonzero(np.isfinite(near_mm[:, landmark]).all(axis=1))
            own_s, own_mm = near_s[there], near_mm[there, landmark]
            for axis in range(3 if there.size else 0):
                x[:, landmark, axis] = np.interp(at_s, own_s, own_mm[:, axis], np.nan, np.nan)
            if there.size > 1:
                before = np.clip(np.searchsorted(own_s, at_s, side="right") - 1, 0, there.size - 2)
                long = np.diff(own_s) > np.where(np.diff(there) > 1, _BRIDGED_S, self._longest_step_s)
                x[long[before] & (at_s != own_s[before]) & (at_s != own_s[before + 1]), landmark] = np.nan
        return x

    @cached_property
    def _longest_step_s(self) -> float:
        """The longest step between samples, in s, that is interpolated."""
        return max(_GAP_S, 5.0 * float(np.median(np.diff(self.time_s))))


def read_kinematics(path: Path, landmarks: Sequence[str]) -> Kinematics:
    """Read and validate kinematics.csv; a ValueError names the line and the cure."""
    if not len(table := read_table(path, kinematics_columns(landmarks))):
        raise ValueError(f"{path}: the table is empty; the robot's landmarks are needed.")
    time_s, x = table[:, 0], table[:, 1:].reshape(-1, len(landmarks), 3)
    empty, far = np.isnan(x), np.abs(np.nan_to_num(x)) > _FARTHEST_MM
    refuse(path, ~(np.diff(time_s, prepend=-np.inf) > 0), ORDER)
    refuse(path, far.any(axis=(1, 2)), f"beyond {_FARTHEST_MM:g} mm; leave the cells of a wrong sample empty")
    problem = "a landmark lacks some coordinates; leave all three cells of a dropped landmark empty"
    refuse(path, (empty.any(axis=2) & ~empty.all(axis=2)).any(axis=1), problem)
    reach = np.linalg.norm(x[:, 1:] - x[:, :1], axis=2)
    if not np.isfinite(reach).any():
        raise ValueError(f"{path}: no row holds {landmarks[0]} and one more; log {', '.join(landmarks)} in each row.")
    if not 0.25 <= np.nanmedian(reach) <= 100:  # a jaw or shaft in metres, inches or micrometres falls outside
        each = zip(landmarks[1:], np.ma.median(np.ma.masked_invalid(reach), axis=0).filled(np.nan), strict=True)
        told = ", ".join(f"{reach_mm:.4g} to {name}" for name, reach_mm in each)
        what = f"the median distances from {landmarks[0]} are {told}, not plausible in mm (0.25 to 100)"
        raise ValueError(f"{path}: {what}. Check the columns. Metres, inches or micrometres? Convert to mm.")
    return Kinematics(time_s, x).without_filled()


def _filled(time_s: np.ndarray, x: np.ndarray) -> np.ndarray:
    """(m,) bool: samples of x (m, c) mm that fill a gap, see `Kinematics.without_filled`."""
    found = np.zeros(len(x), dtype=bool)
    if len(x) < _FEWEST:
        return found
    near = (0, 1, 3, 4)  # around sample 2 of five
    s = np.stack([time_s[j : len(x) - 4 + j] - time_s[2:-2] for j in near])
    off = x[2:-2].copy()
    for j, own in zip(near, s, strict=True):
        others = s[s != own].reshape(3, -1)
        off -= (others / (others - own)).prod(axis=0)[:, None] * x[j : len(x) - 4 + j]
    rests = (np.diff(x, axis=0) == 0).all(axis=1)  # then samples are repeated, not measured
    off[rests[:-3] | rests[1:-2] | rests[2:-1] | rests[3:]] = np.nan
    known = np.isfinite(off).all(axis=1)
    if known.sum() < _FEWEST:
        return found
    usual, digit = np.median(np.abs(off[known]), axis=0), 10.0 ** -_decimals(x)
    noise = off[:, usual > _DIGITS * digit]
    if noise.shape[1] < _COORDINATES or np.nansum(noise[1:] * noise[:-1]) > _OPPOSED * np.nansum(noise**2):
        return found
    smooth = (np.abs(off) <= np.maximum(_SMOOTH * usual, _ROUNDING * digit)).all(axis=1)  # False where NaN
    edges = np.flatnonzero(np.diff(np.concatenate([[False], smooth, [False]]).astype(int)))
    for first, end in edges.reshape(-1, 2):  # the curve goes from a measured sample to the next one
        before, after = first, end + 3
        moved = np.abs(x[after] - x[before]).max() > _MOVES * usual.max()
        if end - first > 1 and moved and time_s[after] - time_s[before] > _BRIDGED_S:
            found[before + 1 : after] = True
    return found


def _decimals(x: np.ndarray) -> int:
    """Number of decimals with which coordinates in mm are written, at most 6, by a thousand of them."""
    known = x[np.isfinite(x)]
    known = known[:: max(1, len(known) // 1000)]
    return next((n for n in range(6) if np.allclose(known, known.round(n), rtol=0, atol=1e-9)), 6)
