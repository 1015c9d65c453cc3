"""Landmarks of a whole recording, as correspondences for calibration and registration."""

from __future__ import annotations

import numpy as np
from tqdm.auto import tqdm

from lib.correspondences import Correspondences, of_recording
from lib.landmarks.detector import Detector
from lib.recordings import Recording

__all__ = ["detect"]


def detect(
    recording: Recording,
    detector: Detector | None = None,
    *,
    frames: slice | np.ndarray | None = None,
    track: bool = False,
) -> Correspondences:
    """Run the detector over a recording, one stereo frame at a time (a full-HD pair takes 12 MB).

    Returns three rows a frame (base, tip_1, tip_2), each with the robot's position at its instant, and NaN where a landmark
    is missing.  `Correspondences.complete` keeps the rows that both cameras and the robot saw.

    Args:
        detector:
            None is the one that ships.
        frames:
            Which frames; None is all.
        track:
            Follow the landmarks from frame to frame (`Detector.track`): several times faster where frames follow each other.

        >>> from lib import paths
        >>> found = detect(Recording.open(paths.SHIPPED_RECORDING), frames=slice(0, 2))
        >>> len(found), found.x_mm.shape, found.covariance_px2.shape
        (6, (6, 3), (6, 2, 2, 2))
    """
    detector = detector or Detector.load()
    chosen = np.arange(len(recording.frames))[slice(None) if frames is None else frames]
    if not chosen.size:
        raise ValueError(f"frames: none of the {len(recording.frames)} frames of the recording; choose at least one.")
    found = []
    for i in tqdm(chosen, desc="landmarks", unit="pair", leave=False):
        frame = recording.frames[int(i)]
        pair = np.stack([frame.left, frame.right])
        found.append(detector.track(pair, found[-1]) if track and found else detector(pair))
    u, covariance, confidence = (
        np.stack([getattr(pair, name) for pair in found], axis=1) for name in ("u", "covariance", "confidence")
    )
    return of_recording(
        recording, *u, covariance_px2=np.moveaxis(covariance, 0, 2), confidence=np.moveaxis(confidence, 0, 2), frames=chosen
    )
