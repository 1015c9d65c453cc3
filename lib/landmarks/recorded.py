"""The detector over a recording: correspondences of the robot's and the images' landmarks."""

import numpy as np
from tqdm.auto import tqdm

from lib.correspondences import Correspondences, of_recording
from lib.landmarks.detector import Detector, Landmarks
from lib.recordings import Recording


def detect(
    recording: Recording, detector: Detector | None = None, *, frames: slice | np.ndarray | None = None, track: bool = False
) -> Correspondences:
    """Run the detector over a recording, one stereo frame at a time (a full-HD pair takes 12 MB).

    Returns three rows a frame (base, tip_1, tip_2), each with the robot's position at its instant, and NaN where a landmark
    is missing.  `Correspondences.complete` keeps the rows that both cameras and the robot saw.

    Args:
        detector: None is the one that ships.
        frames: Which frames; None is all.
        track: Follow the landmarks from frame to frame (`Detector.track`): several times faster if frames follow each other.

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
    every, n = Landmarks.join(found), len(chosen)
    known = {"covariance_px2": every.covariance.reshape(n, 2, 3, 2, 2), "confidence": every.confidence.reshape(n, 2, 3)}
    known = {name: part.swapaxes(1, 2) for name, part in known.items()}
    return of_recording(recording, every.u[::2], every.u[1::2], frames=chosen, **known)
