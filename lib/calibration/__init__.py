"""Calibration of affine and near-affine cameras from a robot's kinematics, with its uncertainty (paper Sec. IV-A)."""

from lib.calibration.affine import affine_minimum, dlt, paper_variances
from lib.calibration.calibration import Calibration, LandmarkOffsets, OnlineCalibration, Optics, optics
from lib.calibration.estimate import calibrate, calibrate_as_shown
from lib.calibration.export import write_opencv, write_ros
from lib.calibration.offsets import with_offsets
from lib.calibration.pivot import Pivot, Tool, ToolOffsets, pivot_calibration, tool_offsets
from lib.calibration.robust import CompetingCamerasError, NoConsensusError
from lib.calibration.timing import TimeOffset, estimate_time_offset

__all__ = [
    "Calibration", "CompetingCamerasError", "LandmarkOffsets", "NoConsensusError", "OnlineCalibration", "Optics", "Pivot",
    "TimeOffset", "Tool", "ToolOffsets", "affine_minimum", "calibrate", "calibrate_as_shown", "dlt", "estimate_time_offset",
    "optics", "paper_variances", "pivot_calibration", "tool_offsets", "with_offsets", "write_opencv", "write_ros",
]  # fmt: skip
