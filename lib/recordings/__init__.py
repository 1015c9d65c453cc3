"""Recordings on disk: stereo frames, robot kinematics, annotations and, for simulated ones, the truth.

A recording is a folder of plain files that a lab can write from any program::

    recording/
      recording.toml     name, fps, image_size_px, units, skeleton, robot_accuracy_mm, readout_s, offset_s
      frames.csv         frame, time_s: only where frames are not uniform in time
      left/ right/       000000.jpg (or .png) ..., or left.mp4 and right.mp4
      kinematics.csv     time_s, base_x_mm, base_y_mm, base_z_mm, tip_1_x_mm, ...: robot clock, robot frame
      annotations.json   optional, COCO keypoints of both cameras
      truth/             simulated recordings only: rig.json (cameras), surface.npz, and landmarks.csv (3D, pixels,
                         visibility and, in newer ones, in_glint: saturated light on or right beside a landmark)

Two clocks: t_robot = t_video + offset_s.  A frame's time is the instant its middle row is read; with a rolling shutter
row y is read readout_s * (y / (height - 1) - 1/2) later.
"""

from lib.recordings.annotations import Annotations
from lib.recordings.frames import Frames, StereoFrame
from lib.recordings.importers import MonocularSequence, import_retinal_microsurgery
from lib.recordings.recording import Kinematics, Recording, Truth
from lib.recordings.tables import LANDMARKS
from lib.recordings.writer import RecordingWriter

__all__ = [
    "LANDMARKS",
    "Annotations",
    "Frames",
    "Kinematics",
    "MonocularSequence",
    "Recording",
    "RecordingWriter",
    "StereoFrame",
    "Truth",
    "import_retinal_microsurgery",
]
