"""microstereo: stereo vision for robot-assisted eye surgery.

Import the modules, not this package: ``from lib import cameras``.  Nothing is imported here, so that the
launcher (`lib.__main__`) runs on a bare Python before the environment exists.
"""
