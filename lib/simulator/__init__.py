"""Recordings with known truth: eye, forceps, microscope and motion of the reference rig.

Everything here is in the microscope frame (`rig.py`) until a recording is written, which is in the robot's.
"""

from lib.simulator.eye import Eye
from lib.simulator.forceps import Forceps, Pose
from lib.simulator.microscope import Microscope
from lib.simulator.motion import Motion
from lib.simulator.recording import simulate
from lib.simulator.render import View, render_pair
from lib.simulator.scenes import Checkerboard, Relief

__all__ = [
    "Checkerboard",
    "Eye",
    "Forceps",
    "Microscope",
    "Motion",
    "Pose",
    "Relief",
    "View",
    "render_pair",
    "simulate",
]
