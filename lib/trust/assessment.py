"""Everything that decides whether a recording's calibration may be believed, in one call."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lib.calibration import Calibration, calibrate
from lib.correspondences import Correspondences
from lib.landmarks import Detector, detect
from lib.recordings import Recording
from lib.trust.diagnosis import Diagnosis, diagnose
from lib.trust.epipolar import feature_epipolar_px
from lib.trust.health import Health, health
from lib.trust.verdict import Verdict, judge

__all__ = ["Assessment", "assess"]


@dataclass(frozen=True, eq=False)
class Assessment:
    """What `assess` found.

    Attributes:
        data: The correspondences assessed.
        calibration: None where it was refused; the verdict says why.
        verdict: With its reasons, the worst first.
        diagnosis, health: What is wrong, and each frame's score.
        epipolar_px: Median epipolar distance of features that both images share; NaN where too few are.
    """

    data: Correspondences
    calibration: Calibration | None
    verdict: Verdict
    diagnosis: Diagnosis
    health: Health
    epipolar_px: float = np.nan


def assess(
    recording: Recording, data: Correspondences | None = None, *, detector: Callable | None = None, looks: int = 12,
    **options: object,
) -> Assessment:  # fmt: skip
    """Calibrate, diagnose, look at the detector's health and at a witness, and judge.

    Never raises for what a recording shows: what is refused is a reason of the verdict.

    Args:
        data: Its correspondences (detected, labelled); None runs the detector, the one that ships if none is given.
        detector: The one that made `data`; with it `looks` frames are looked at again, mirrored and shifted.
        options: Of `lib.calibration.calibrate`, such as model="near_affine".
    """
    if data is None:
        detector = detector or Detector.load()
        data = detect(recording, detector)
    calibration, error, epipolar_px = None, None, np.nan
    try:
        calibration = calibrate(data, image_size_px=recording.image_size_px, **options)
    except ValueError as refused:
        error = refused
    if calibration is not None:
        epipolar_px = feature_epipolar_px(recording, calibration.pair)
    diagnosis = diagnose(
        data, calibration, kinematics=recording.kinematics, readout_s=recording.readout_s,
        image_size_px=recording.image_size_px,
    )  # fmt: skip
    found = health(recording, data, calibration, detector=detector, looks=looks)
    verdict = judge(
        data, calibration, diagnosis=diagnosis, health=found, epipolar_px=epipolar_px, error=error,
        robot_accuracy_mm=recording.robot_accuracy_mm, doubts=recording.doubts,
    )  # fmt: skip
    return Assessment(data, calibration, verdict, diagnosis, found, epipolar_px)
