"""Landmarks of the forceps in an image: base, tip_1, tip_2, with covariance and confidence (paper Sec. III)."""

from lib.landmarks.detector import Detector, Landmarks
from lib.landmarks.recorded import SharedDetector, detect, with_ground

__all__ = ["Detector", "Landmarks", "SharedDetector", "detect", "with_ground"]
