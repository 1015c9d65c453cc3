"""A recording as its hypotheses see it: the rows, "nothing is wrong", and how evidence is weighed."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lib.recordings import Kinematics
from lib.trust.fitting import Problem, Robust
from lib.trust.track import Track

__all__ = ["SIDES", "Case", "Hypothesis"]

SIDES = ("left", "right")
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
