"""Registration of moved cameras to the robot (paper Sec. IV-C), drift detection, and the paper's experiment.

The cameras were calibrated to the robot and then moved by an unknown rigid `motion` (robot frame), so what the stale
rig triangulates is ``motion.inverse().apply(x_robot)``.  Every estimate here is that motion: it takes points of the
stale rig to the robot frame, and ``perturb(rig, motion)`` is the rig as it is now.
"""

from lib.registration.drift import DriftMonitor
from lib.registration.images import MovedCameras, identify_motion, perturb, register_cameras, register_images
from lib.registration.rigid import Registration, register

__all__ = [
    "DriftMonitor",
    "MovedCameras",
    "Registration",
    "identify_motion",
    "perturb",
    "register",
    "register_cameras",
    "register_images",
]
