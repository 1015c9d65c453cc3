"""Simulated recordings with ground truth: eye, forceps, microscope and motion of the reference rig.

Everything here is in the microscope frame (see `rig.py`).  Only written recordings are in the robot frame.
"""

from lib.simulator.eye import Eye
from lib.simulator.forceps import Forceps, Pose
from lib.simulator.motion import Motion
from lib.simulator.recording import Design, simulate
from lib.simulator.render import View, render_pair, render_view
from lib.simulator.rig import Microscope
from lib.simulator.window import Window

__all__ = ["Design", "Eye", "Forceps", "Microscope", "Motion", "Pose", "View", "Window"]
__all__ += ["render_pair", "render_view", "simulate"]
