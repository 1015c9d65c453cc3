"""Registration of moved cameras to the robot (paper Sec. IV-C), and the detection of drift.

Calibrated cameras moved by an unknown rigid `motion`, so the old rig triangulates ``motion.inverse().apply(x_robot)``.
Every estimate is that motion: it maps points of the old rig to the robot frame; ``rig.moved(motion)`` is the current rig.
"""

from lib.registration.drift import DriftMonitor
from lib.registration.images import MovedCameras, identify_motion, register_images
from lib.registration.rigid import Registration, register

__all__ = ["DriftMonitor", "MovedCameras", "Registration", "identify_motion", "register", "register_images"]
