"""Everything that decides whether a recording's calibration may be believed, in one call."""

from dataclasses import dataclass

from lib.calibration import Calibration, calibrate
from lib.correspondences import Correspondences
from lib.landmarks import Detector, detect
from lib.recordings import Recording
from lib.trust.diagnosis import diagnose
from lib.trust.verdict import Verdict, judge

__all__ = ["Assessment", "assess"]


@dataclass(frozen=True, eq=False)
class Assessment:
    """What `assess` found.

    Attributes:
        data: The correspondences assessed.
        calibration: None where it was refused; the verdict says why.
        verdict: With its reasons, the worst first.
        diagnosis, health: None where there was too little to look at.
    """

    data: Correspondences
    calibration: Calibration | None
    verdict: Verdict
    diagnosis: object = None
    health: object = None


def assess(recording: Recording, data: Correspondences | None = None, *, detector: Detector | None = None) -> Assessment:
    """Calibrate, diagnose, look at the detector's health, and judge.

    Never raises for what a recording shows: what is refused is a reason of the verdict.

    Args:
        data: Its correspondences (detected, labelled); None runs the detector.
        detector: The one that made `data`; None is the one that ships.
    """
    data = detect(recording, detector) if data is None else data
    calibration, error = None, None
    try:
        calibration = calibrate(data, image_size_px=recording.image_size_px)
    except ValueError as refused:
        error = refused
    diagnosis = diagnose(
        data, calibration, kinematics=recording.kinematics, readout_s=recording.readout_s,
        image_size_px=recording.image_size_px,
    )  # fmt: skip
    verdict = judge(data, calibration, diagnosis=diagnosis, robot_accuracy_mm=recording.robot_accuracy_mm, error=error)
    return Assessment(data, calibration, verdict, diagnosis)
