"""Calibration of affine and near-affine cameras from a robot's kinematics, and how good it is (paper Sec. IV-A)."""

from lib.calibration.affine import AffineMinimum, Moments, affine_minimum, dlt, estimate_noise, paper_variances
from lib.calibration.estimate import Calibration, calibrate

__all__ = [
    "AffineMinimum",
    "Calibration",
    "Moments",
    "affine_minimum",
    "calibrate",
    "dlt",
    "estimate_noise",
    "paper_variances",
]
