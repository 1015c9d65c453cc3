"""Recordings on disk: stereo frames, robot kinematics, annotations and, for simulated ones, the truth.

A recording is a folder of plain files that a lab can write from any program::

    recording/
      recording.toml     name, fps, image_size_px, units, skeleton, robot_accuracy_mm, readout_s, offset_s, bit_depth
      frames.csv         frame, time_s: only where frames are not uniform in time
      left/ right/       000000.jpg (or .png) ..., or left.mp4 and right.mp4
      kinematics.csv     time_s, base_x_mm, base_y_mm, base_z_mm, tip_1_x_mm, ...: robot clock, robot frame
      annotations.json   optional, COCO keypoints of both cameras
      truth/             simulated recordings only: rig.json (cameras, affine or near-affine), surface.npz, and
                         landmarks.csv (3D, pixels, visibility; in_glint is optional: saturated light on the landmark
                         or right beside it)

There are two clocks: t_robot = t_video + offset_s.  The time of a frame is the instant at which its middle row is read.
A rolling shutter reads row y at readout_s * (y / (height - 1) - 1/2) after that; `lib.correspondences` uses it.
"""

from lib.recordings.annotations import Annotations
from lib.recordings.doubts import Doubt
from lib.recordings.frames import Frames, StereoFrame, read_image, to_8_bits
from lib.recordings.importers import MonocularSequence, import_retinal_microsurgery
from lib.recordings.recording import Kinematics, Recording
from lib.recordings.truth import Truth
from lib.recordings.writer import RecordingWriter

__all__ = ["Annotations", "Doubt", "Frames", "Kinematics", "MonocularSequence", "Recording", "RecordingWriter", "StereoFrame"]
__all__ += ["Truth", "import_retinal_microsurgery", "read_image", "to_8_bits"]
