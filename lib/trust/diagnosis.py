"""What is wrong with a recording: hypotheses fitted to its correspondences, and compared with "nothing is wrong".

The hypotheses are in `lib.trust.hypotheses`; each is fitted under heavy-tailed noise (`lib.trust.fitting`).  Its gain in log
likelihood, less a penalty for its parameters (BIC), is its evidence.
"""

from dataclasses import dataclass

import numpy as np

from lib.calibration import Calibration
from lib.correspondences import TRAIN_FURTHER, Correspondences
from lib.recordings import Kinematics
from lib.trust.case import Case, Hypothesis
from lib.trust.clocks import TIME_TESTS
from lib.trust.fitting import Problem
from lib.trust.hypotheses import TESTS, unexplained

__all__ = ["Diagnosis", "diagnose"]

#: Least gain and least share explained of a hypothesis that is named.
LEAST_GAIN = 6.0
LEAST_EXPLAINED = 0.02
_MOST_ROWS = 1200


@dataclass(frozen=True)
class Diagnosis:
    """The hypotheses, most likely first."""

    hypotheses: tuple[Hypothesis, ...] = ()

    @property
    def best(self) -> Hypothesis | None:
        """The fault that the data show; None where nothing beats "nothing is wrong"."""
        return next((h for h in self.hypotheses if h.gain >= LEAST_GAIN and h.explained >= LEAST_EXPLAINED), None)

    def __str__(self) -> str:
        return "no fault found" if self.best is None else f"{self.best.name}: {self.best.text} {self.best.cure}"


def diagnose(
    data: Correspondences, calibration: Calibration | None = None, *, kinematics: Kinematics | None = None,
    offset_s: float = 0.0, readout_s: float = 0.0, image_size_px: tuple[int, int] | None = None, seed: int = 0,
) -> Diagnosis:  # fmt: skip
    """Fit every hypothesis about what could be wrong, and rank them.

    Args:
        data: The rows that were, or could not be, calibrated with.
        calibration: Where there is one: its image size is used if none is given.
        kinematics: The robot's log, which tells where the tool was a little earlier or later.  Without it the rows' own
            positions do, where the frames follow each other within 0.25 s.
        offset_s, readout_s, image_size_px: As the recording states them; without a size nothing is said of the read-out time.
        seed: Of the random samples.

    >>> from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig
    >>> rng = np.random.default_rng(0)
    >>> x = ROBOT_FROM_MICROSCOPE.apply(rng.uniform(-4, 4, (60, 3)))
    >>> u = [pixels + rng.normal(0, 1.5, pixels.shape) for pixels in reference_rig().project(x)]
    >>> print(diagnose(Correspondences.of_points(x, *u)).best)
    None
    """
    if image_size_px is None and calibration is not None:
        image_size_px = calibration.image_size_px
    frames = np.unique(data.frame)
    if len(data) > _MOST_ROWS:  # a part of the time: neighbours tell of clocks, and which part hardly matters
        data = data.of_frames(frames[np.linspace(0, len(frames) - 1, int(len(frames) * _MOST_ROWS / len(data))).astype(int)])
    problem = Problem.of(data)
    if problem.used.all(axis=1).sum() < 6:
        if len(data) < 12:
            return Diagnosis()
        text = f"Only {problem.used.all(axis=1).sum()} of {len(data)} rows have both images and the robot's report."
        cure = f"The detector does not fit these pictures: look at its overlays, {TRAIN_FURTHER}."
        return Diagnosis((Hypothesis("detector_unfit", text, cure, 100.0, 0.0, "%", 1.0, float(len(data))),))
    case = Case(problem, kinematics, offset_s, readout_s, image_size_px, seed)
    found = [h for test in (*(TIME_TESTS if case.paths else ()), *TESTS) for h in test(case)]
    found = sorted((h for h in found if np.isfinite(h.gain)), key=lambda h: -h.gain)
    best = Diagnosis(tuple(found)).best
    found += unexplained(case, case.null if best is None else case.fits.get(best.name, case.null))
    return Diagnosis(tuple(sorted(found, key=lambda h: -h.gain)))
