"""Verdicts: may a number of this recording be believed, why not, and what to do (all thresholds stand here)."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np

from lib.calibration import Calibration, optics
from lib.correspondences import Correspondences

__all__ = ["LEVELS", "Reason", "Verdict", "judge"]

#: From best to worst.
LEVELS = ("trustworthy", "doubtful", "not trustworthy")
DOUBTFUL, RED = LEVELS[1:]


@dataclass(frozen=True)
class Reason:
    """One finding against a calibration.

    Attributes:
        name: Snake case, such as ``"residuals"``.
        level: What it makes of the verdict, ``LEVELS[1]`` or ``LEVELS[2]``.
        text: Plain words with the number and its limit.
        cure: What to do, with the call.
    """

    name: str
    level: str
    text: str
    cure: str

    def __post_init__(self) -> None:
        if self.level not in LEVELS[1:]:
            raise ValueError(f"level: expected one of {LEVELS[1:]}, got {self.level!r}.")


@dataclass(frozen=True)
class Verdict:
    """The worst of its reasons; trustworthy without any.

    >>> verdict = Verdict((Reason("few_frames", "doubtful", "5 frames; 6 or more are needed.", "Record more."),))
    >>> verdict.level, Verdict.join([verdict, Verdict()]).level, Verdict().level
    ('doubtful', 'doubtful', 'trustworthy')
    """

    reasons: tuple[Reason, ...] = ()

    @property
    def level(self) -> str:
        """One of `LEVELS`."""
        return max((reason.level for reason in self.reasons), key=LEVELS.index, default=LEVELS[0])

    @property
    def is_red(self) -> bool:
        """True where no number that follows from the calibration should be stated."""
        return self.level == RED

    @classmethod
    def join(cls, parts: Iterable[Self]) -> Self:
        """The reasons of several verdicts, the worst first; of two with one name and level, the first."""
        found = {(reason.name, reason.level): reason for part in reversed(list(parts)) for reason in reversed(part.reasons)}
        return cls(tuple(sorted(reversed(found.values()), key=lambda reason: -LEVELS.index(reason.level))))

    def to_json(self) -> dict:
        """As it stands in check.json and metrics.json."""
        return {"verdict": self.level, "reasons": [vars(reason).copy() for reason in self.reasons]}

    def __str__(self) -> str:
        return "\n".join([f"Verdict: {self.level}", *(f"  {r.level}: {r.text} {r.cure}" for r in self.reasons)])


def judge(
    data: Correspondences | None, calibration: Calibration | None, *, diagnosis: object = None, health: object = None,
    epipolar_px: float | None = None, robot_accuracy_mm: float | None = None, error: Exception | None = None,
) -> Verdict:  # fmt: skip
    """The verdict on a calibration from its own numbers and from witnesses.

    Args:
        data: What was calibrated with; None leaves out what only its frames can tell.
        calibration: None where it was refused; then `error` is the exception.
        diagnosis, health: Of `lib.trust.diagnose` and `lib.trust.health`, where made.
        epipolar_px: Median epipolar distance of matches between the two images, which know nothing of the tool.
        robot_accuracy_mm: As its maker states it.
    """
    if calibration is None:
        return Verdict((Reason("refused", RED, str(error), "See the reasons of the detector and of the recording."),))
    c, found = calibration, []
    rows, used = c.view_inliers.sum(), np.isfinite(c.residuals_px).sum() // 2
    if used and rows < 0.5 * used:
        text = f"{rows} of {used} detections agree on the cameras; at least half should."
        found.append(Reason("minority", RED, text, "Look at the overlays: the detector may not know this tool."))
    claim = _claimed_px(c)
    if np.isfinite(claim) and c.reprojection_rms_px > 3.0 * claim:
        text = f"The residuals are {c.reprojection_rms_px:.1f} px RMS; detector and robot claim {claim:.1f} px."
        found.append(Reason("residuals", RED, text, "Read the diagnosis: `lib.trust.diagnose(data, calibration)`."))
    if c.rig is not None and not np.deg2rad(0.5) < optics(c).convergence_rad < np.deg2rad(45):
        text = f"The cameras converge by {np.rad2deg(optics(c).convergence_rad):.1f} degrees; a stereo microscope by 2 to 20."
        found.append(Reason("convergence", RED, text, "Check that x_mm and u belong together."))
    return Verdict.join([Verdict(tuple(found))])


def _claimed_px(c: Calibration) -> float:
    """Reprojection RMS that the detector's covariances claim, the robot at 10 um."""
    if c.covariance_px2 is None:
        return np.nan
    rows = c.covariance_px2 if len(c.covariance_px2) == 1 else c.covariance_px2[c.inliers]
    variance = np.trace(rows, axis1=1, axis2=2).mean() / len(c.cameras)
    zoom2 = np.mean([(camera.linear**2).sum() for camera in c.cameras])
    return float(np.sqrt(variance / c.detector_scale**2 + zoom2 * 0.01**2))
