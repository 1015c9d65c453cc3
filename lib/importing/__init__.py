"""Recordings from the files of other programs: videos, robots' logs and labels, as a mapping file describes them.

This room lies above `lib.calibration`, which finds clock offsets and tools.
"""

from lib.importing.guess import guess_mapping
from lib.importing.importer import import_recording
from lib.importing.mapping import read_mapping

__all__ = ["guess_mapping", "import_recording", "read_mapping"]
