"""A recording as its hypotheses see it: the rows, the tool's path in time, and how evidence is weighed."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lib.calibration.timing import Paths
from lib.recordings import Kinematics
from lib.trust.fitting import Problem, Robust

SIDES = ("left", "right")
_LONGEST_S = 0.25  # between frames, whose own positions stand for the robot's log
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


class Case:
    """The rows, the fit `null` of "nothing is wrong", the best fit of each hypothesis, and what the hypotheses share.

    Args:
        kinematics, offset_s: The robot's log, and its clock minus that of the rows; None takes the rows' own positions,
            where the frames follow each other closely enough.
        readout_s, size: Of the shutter, and (width, height) of the images, None if unknown.

    Attributes:
        paths: Of the landmarks in time, None where nothing tells them.
        frames: Their number.
    """

    def __init__(
        self, problem: Problem, kinematics: Kinematics | None, offset_s: float, readout_s: float, size: tuple[int, int] | None
    ) -> None:
        self.problem, self.readout_s, self.size = problem, readout_s, size
        self.null, self.fits = problem.fit(), {}
        self.frames = int(problem.frame.max()) + 1
        self.paths, self._clock_s = None, offset_s
        time, landmark, x = problem.time, problem.landmark, problem.x[:, 0]
        if not np.isfinite(time).all():
            return
        if kinematics is not None and landmark.max() < kinematics.x_mm.shape[1]:
            log = np.swapaxes(kinematics.x_mm, 0, 1) - problem.centre
            self.paths = Paths((kinematics.time_s, own) for own in log)
        if self.paths is None or not all(self.paths.pieces):
            each = [np.flatnonzero(landmark == k) for k in range(int(landmark.max()) + 1)]
            each = [rows[np.unique(time[rows], return_index=True)[1]] for rows in each]
            steps = np.concatenate([np.diff(time[rows]) for rows in each])
            near = steps.size and np.median(steps) <= _LONGEST_S
            self.paths, self._clock_s = Paths((time[rows], x[rows]) for rows in each) if near else None, 0.0

    def moved(self, shift_s: float | np.ndarray) -> np.ndarray:
        """(n, 3) mm: the positions of the rows as they were `shift_s` later; NaN where nothing tells."""
        now = self.problem.time + self._clock_s
        landmark = self.problem.landmark
        return self.problem.x[:, 0] + self.paths.at(landmark, now + shift_s) - self.paths.at(landmark, now)

    def velocity(self, shift_s: float | np.ndarray = 0.0) -> np.ndarray:
        """(n, 3) mm/s of the rows, `shift_s` later."""
        return self.paths.at(self.problem.landmark, self.problem.time + self._clock_s + shift_s, 1)

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
            moved = replace(problem, x=np.repeat(x[own[problem.frame], np.arange(len(problem))][:, None], 2, axis=1))
            fit = moved.fit(start=fit.M, rounds=10)
        return fit, moved, own

    def linear(
        self, columns: np.ndarray | Callable[[np.ndarray], np.ndarray], on: Problem | None = None
    ) -> tuple[Robust, float, float]:
        """The fit with `columns` (n, 2, 2, k) added to the pixels (or cameras -> columns): length and sd of the additions."""
        fit = (on or self.problem).fit(columns if callable(columns) else lambda M: columns, start=self.null.M)
        length = float(np.linalg.norm(fit.theta))
        return fit, float(fit.theta[0]) if fit.theta.size == 1 else length, float(np.sqrt(np.trace(fit.covariance)))

    def found(
        self, name: str, fit: Robust, extra: float, size: tuple[float, float, str], text: str, cure: str, *,
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
        value, sd, unit = size
        explained = 1.0 - np.exp(-2.0 * max(raw, 0.0) / n)
        return Hypothesis(name, text, cure, float(value), float(sd), unit, float(explained), float(gain))
