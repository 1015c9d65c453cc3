"""A recording as its hypotheses see it: the rows, the tool's path in time, and how evidence is weighed."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from lib.recordings import Kinematics
from lib.trust.fitting import Problem, Robust

__all__ = ["SIDES", "Case", "Hypothesis"]

SIDES = ("left", "right")
_LONGEST_S = 0.25  # between samples, over which a path is interpolated
_HALF_S = 0.05  # half the time over which a velocity is measured
_PARAMETERS = 20  # of two affine cameras, and about as many of the nine offsets as data tell


@dataclass(frozen=True)
class Hypothesis:
    """A possible fault.

    Attributes:
        name: Such as "clock".
        text, cure: What the residuals look like, and the setting or call that mends it.
        value, sd, unit: Its size.
        explained: Share of the residuals' variance that it explains, 0 to 1 (robustly, from the likelihood).
        gain: Log likelihood above "nothing is wrong", less the penalty for its parameters.
    """

    name: str
    text: str
    cure: str
    value: float
    sd: float
    unit: str
    explained: float
    gain: float


@dataclass(frozen=True, eq=False)
class Track:
    """A path of each landmark: times (m,) s and positions (m, 3) mm; `start_s` (n,) is where on it the rows lie."""

    paths: list[tuple[np.ndarray, np.ndarray]]
    start_s: np.ndarray
    landmark: np.ndarray

    @classmethod
    def of(cls, problem: Problem, kinematics: Kinematics | None) -> Self | None:
        """From the robot's samples, else from the rows themselves; None where they are too far apart or have no time."""
        time, landmark, x = problem.time, problem.landmark, problem.x[:, 0]
        if not np.isfinite(time).all() or len(problem) == 0:
            return None
        if kinematics is not None and landmark.max() < kinematics.x_mm.shape[1]:
            log = np.swapaxes(kinematics.x_mm, 0, 1) - problem.centre
            known = np.isfinite(log).all(axis=2)
            paths = [(kinematics.time_s[rows], own[rows]) for own, rows in zip(log, known, strict=True)]
            if known.sum(axis=1).min() > 4:
                return cls([_smooth(*path) for path in paths], time + _shift(x, time, landmark, paths), landmark)
        each = [np.flatnonzero(landmark == k) for k in range(int(landmark.max()) + 1)]
        each = [rows[np.unique(time[rows], return_index=True)[1]] for rows in each]
        paths = [(time[rows], x[rows]) for rows in each]
        steps = np.concatenate([np.diff(t) for t, _ in paths])
        if not steps.size or np.median(steps) > _LONGEST_S:
            return None
        return cls([_smooth(*path) for path in paths], time, landmark)

    @property
    def span_s(self) -> float:
        """From the first to the last sample."""
        return float(max(t[-1] for t, _ in self.paths if len(t)) - min(t[0] for t, _ in self.paths if len(t)))

    def at(self, shift_s: float | np.ndarray) -> np.ndarray:
        """(n, 3) positions `shift_s` later than the rows; NaN outside the path and in its gaps."""
        time, x = self.start_s + shift_s, np.full((len(self.start_s), 3), np.nan)
        for k, (t, path) in enumerate(self.paths):
            rows = self.landmark == k
            if len(t) < 2 or not rows.any():
                continue
            gap = np.diff(t) > _LONGEST_S
            inside = ~gap[np.clip(np.searchsorted(t, time[rows]) - 1, 0, len(gap) - 1)]
            for axis in range(3):
                x[rows, axis] = np.interp(time[rows], t, path[:, axis], left=np.nan, right=np.nan)
            x[np.flatnonzero(rows)[~inside]] = np.nan
        return x

    def moved(self, x: np.ndarray, shift_s: float | np.ndarray) -> np.ndarray:
        """Positions x (n, 3) of the rows, as they were `shift_s` later."""
        return x + (self.at(shift_s) - self.at(0.0))

    def velocity(self, shift_s: float | np.ndarray = 0.0) -> np.ndarray:
        """(n, 3) mm/s."""
        here, after, before = self.at(shift_s), self.at(shift_s + _HALF_S), self.at(shift_s - _HALF_S)
        span = _HALF_S * (np.isfinite(after[:, :1]) * 1.0 + np.isfinite(before[:, :1]))
        step = np.where(np.isfinite(after), after, here) - np.where(np.isfinite(before), before, here)
        return step / np.where(span > 0, span, np.nan)


def _smooth(time: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A path averaged over some samples: between noisy ones it is less noisy than at them, which would favour some shifts."""
    if len(time) < 4:
        return time, x
    steps = max(0.03, 1.5 * np.median(np.diff(time))) * np.linspace(-1, 1, 7)
    at = time[:, None] + steps
    inside = (at[:, 0] >= time[0]) & (at[:, -1] <= time[-1])
    return time[inside], np.stack([np.interp(at[inside], time, axis).mean(axis=1) for axis in x.T], axis=1)


def _shift(x: np.ndarray, time: np.ndarray, landmark: np.ndarray, paths: list) -> float:
    """Time on the paths minus time of the rows: where the path comes nearest to a row's position, by the median."""
    found = []
    for i in np.unique(np.linspace(0, len(x) - 1, 40).astype(int)):
        t, path = paths[landmark[i]]
        a, b = path[:-1], path[1:]
        length2 = ((b - a) ** 2).sum(axis=1)
        part = np.clip(((x[i] - a) * (b - a)).sum(axis=1) / np.maximum(length2, 1e-18), 0.0, 1.0)
        j = ((a + part[:, None] * (b - a) - x[i]) ** 2).sum(axis=1).argmin()
        found.append(t[j] + part[j] * (t[j + 1] - t[j]) - time[i])
    return float(np.median(found))


class Case:
    """The rows, the fit `null` of "nothing is wrong", the best fit of each hypothesis, and what the hypotheses share."""

    def __init__(
        self, problem: Problem, kinematics: Kinematics | None, readout_s: float, size: tuple[int, int] | None, seed: int
    ) -> None:
        self.problem, self.kinematics, self.readout_s, self.size, self.seed = problem, kinematics, readout_s, size, seed
        self.null, self.fits = problem.fit(seed=seed), {}
        self.frames = int(problem.frame.max()) + 1

    @cached_property
    def track(self) -> Track | None:
        return Track.of(self.problem, self.kinematics)

    def by_frame(self, values: np.ndarray) -> np.ndarray:
        """Values (n, ...) of the rows as (frames, 3, ...), NaN where a landmark is missing."""
        table, rows = np.full((self.frames, 3, *values.shape[1:]), np.nan), self.problem.landmark <= 2
        table[self.problem.frame[rows], self.problem.landmark[rows]] = values[rows]
        return table

    def chosen(self, x: np.ndarray) -> tuple[Robust, Problem, np.ndarray]:
        """Each frame with the positions among x (t, n, 3) that suit it best: the fit, its rows, the choices (frames,)."""
        problem, fit = self.problem, self.null
        for _ in range(5):
            r2 = ((problem.y - np.einsum("cij,tnj->tnci", fit.M[:, :, :3], x) - fit.M[:, :, 3]) ** 2).sum(axis=3)
            loss = np.where(problem.used, np.nan_to_num(np.log1p(r2 / fit.shapes[0].scale ** 2), nan=1e3), 0.0).sum(axis=2)
            own = np.array([np.bincount(problem.frame, row, self.frames) for row in loss]).argmin(axis=0)
            moved = problem.moved(np.repeat(x[own[problem.frame], np.arange(len(problem))][:, None], 2, axis=1))
            fit = moved.fit(start=fit.M, rounds=10)
        return fit, moved, own

    def found(
        self, name: str, fit: Robust, extra: float, value: float, sd: float, unit: str, text: str, cure: str, *,
        on: Problem | None = None, raw: float | None = None,
    ) -> Hypothesis:  # fmt: skip
        """With the evidence of its fit, which has `extra` parameters more than "nothing is wrong" on the rows of `on`."""
        null = self.null
        if on is not None and (on.used != self.problem.used).any():
            null = replace(self.problem, seen=on.used).fit(start=null.M)
        raw = fit.total - null.total if raw is None else raw
        n = 2.0 * (fit.likelihood != 0).sum()
        # Of few rows any addition explains much: what chance gains, by the degrees of freedom, is taken off.
        freedom = n / fit.design - _PARAMETERS
        left, gain = freedom - extra, -np.inf
        if left >= 4:
            gain = left * (raw / n - 0.5 * np.log(freedom / left)) - 0.5 * extra * np.log(freedom)
        if name not in self.fits or fit.total > self.fits[name].total:
            self.fits[name] = fit
        explained = 1.0 - np.exp(-2.0 * max(raw, 0.0) / n)
        return Hypothesis(name, text, cure, float(value), float(sd), unit, float(explained), float(gain))
