"""The robot labels the frames: a detector learns a new microscope, eye and tool from a recording, without a click."""

from lib.adapt.loop import Adaptation, adapt
from lib.adapt.teacher import RefusalError, Teacher, teach

__all__ = ["Adaptation", "RefusalError", "Teacher", "adapt", "teach"]
