"""Recordings on disk: stereo frames, robot kinematics, annotations and, for simulated ones, the truth.

A recording is a folder of plain files that a lab can write from any program; data/README.md states their format.

There are two clocks: t_robot = t_video + offset_s.  The time of a frame is the instant at which its middle row is read.
A rolling shutter reads row y at readout_s * (y / (height - 1) - 1/2) after that; `lib.correspondences` uses it.
"""

from lib.recordings.annotations import Annotations
from lib.recordings.annotator import Annotator
from lib.recordings.frames import Frames, StereoFrame, encoded, read_image, to_8_bits
from lib.recordings.ground import Ground, GrowingGround
from lib.recordings.kinematics import Kinematics
from lib.recordings.recording import Doubt, Recording, RecordingWriter
from lib.recordings.scene import Scene
from lib.recordings.smoothing import smoothed
from lib.recordings.truth import Truth

__all__ = ["Annotations", "Annotator", "Doubt", "Frames", "Ground", "GrowingGround", "Kinematics", "Recording"]
__all__ += ["RecordingWriter", "Scene", "StereoFrame", "Truth", "encoded", "read_image", "smoothed", "to_8_bits"]
