"""The tool's path in time: where the robot says it was earlier or later, and how fast it moves."""

from dataclasses import dataclass

import numpy as np

from lib.recordings import Kinematics
from lib.trust.fitting import Problem

__all__ = ["Track"]

_LONGEST_S = 0.25  # between samples, over which a path is interpolated
_HALF_S = 0.05  # half the time over which a velocity is measured


@dataclass(frozen=True, eq=False)
class Track:
    """A path of each landmark: times (m,) s and positions (m, 3) mm; `start_s` (n,) is where on it the rows lie."""

    paths: list[tuple[np.ndarray, np.ndarray]]
    start_s: np.ndarray
    landmark: np.ndarray

    @classmethod
    def of(cls, problem: Problem, kinematics: Kinematics | None) -> "Track | None":
        """From the robot's samples, else from the rows themselves; None where they are too far apart or have no time."""
        time, landmark, x = problem.time, problem.landmark, problem.x[:, 0]
        if not np.isfinite(time).all() or len(problem) == 0:
            return None
        if kinematics is not None and landmark.max() < kinematics.x_mm.shape[1]:
            paths = []
            for k in range(kinematics.x_mm.shape[1]):
                known = np.isfinite(kinematics.x_mm[:, k]).all(axis=1)
                paths.append((kinematics.time_s[known], kinematics.x_mm[known, k] - problem.centre))
            if min(len(t) for t, _ in paths) > 4:
                return cls([_smooth(*path) for path in paths], time + _shift(x, time, landmark, paths), landmark)
        paths = []
        for k in range(int(landmark.max()) + 1):
            rows = np.flatnonzero(landmark == k)
            rows = rows[np.unique(time[rows], return_index=True)[1]]
            paths.append((time[rows], x[rows]))
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
