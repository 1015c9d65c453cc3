"""The detector over a recording, and detections that notebooks of one run, or commands, share: no pair is looked at twice."""

import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
from tqdm.auto import tqdm

from lib import files, paths
from lib.correspondences import Correspondences, of_recording
from lib.landmarks.detector import Detector, Landmarks
from lib.recordings import Ground, GrowingGround, Recording


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
    found, known = [], with_ground(detector, recording)
    for i in tqdm(chosen, desc="landmarks", unit="pair", leave=False):
        frame = recording.frames[int(i)]
        pair = np.stack([frame.left, frame.right])
        found.append(detector.track(pair, found[-1], **known) if track and found else detector(pair, **known))
    u, covariance, confidence = (np.stack([part[::2], part[1::2]], axis=2) for part in vars(Landmarks.join(found)).values())
    return of_recording(recording, u[:, :, 0], u[:, :, 1], frames=chosen, covariance_px2=covariance, confidence=confidence)


def with_ground(detector: Callable, recording: Recording | GrowingGround, change: Callable | None = None) -> dict:
    """What a call of the detector takes beside a pair of images: their ground, unless it is a stand-in of images alone.

    `change` made the images of those of the recording.

    >>> with_ground(lambda images: Landmarks.none(len(images)), None)
    {}
    """
    if not isinstance(detector, Detector | SharedDetector):
        return {}
    return {"ground": recording.ground.changed(change) if change else recording.ground}


class SharedDetector:
    """A detector for `detect` and `assess` that reads what was found in the same images before.

    `python3 -m lib` names a folder for that in the environment: `run` one of its own, which it removes at its end, other
    commands one in data/cache.  Anywhere else this is the detector itself.  A file's name is the digest of the images'
    pixels, the ground's key, the weights, the settings and the engine.  Where a time is measured, call the detector itself.

    Attributes:
        seconds: What detecting took: here, and where it was read, there.
        pairs, read: How many calls there were, and how many of them were read.

        >>> detector = SharedDetector(lambda images: Landmarks.none(len(images)))
        >>> len(detector(np.zeros((2, 8, 8, 3), np.uint8))), detector.pairs, detector.read
        (2, 1, 0)
    """

    def __init__(self, detector: Detector | Callable[[np.ndarray], Landmarks] | None = None):
        self.detector = detector or Detector.load()
        self.seconds, self.pairs, self.read = 0.0, 0, 0
        self._digest = getattr(self.detector, "digest", "")
        self._folder = os.environ.get(paths.SHARED_VARIABLE) if self._digest else None

    def __call__(self, images: np.ndarray, *, ground: Ground | None = None) -> Landmarks:
        """Landmarks of a stereo pair (2, h, w, 3), uint8 RGB; `ground` as in a `Detector`'s call."""
        self.pairs, file = self.pairs + 1, None
        if self._folder:
            content = f"{self._digest} {images.dtype} {images.shape} {ground and ground.key}".encode() + images.tobytes()
            file = Path(self._folder) / f"{files.digest(content, length=64)}.npz"
            if file.is_file():
                with np.load(file) as kept:
                    self.read, self.seconds = self.read + 1, self.seconds + float(kept["seconds"])
                    return Landmarks(kept["u"], kept["covariance"], kept["confidence"])
        start = time.perf_counter()
        found = self.detector(images, **({"ground": ground} if isinstance(self.detector, Detector) else {}))
        seconds = time.perf_counter() - start
        self.seconds += seconds
        if file:
            with suppress(OSError), files.whole(file) as partial:  # a full disk costs time, not the notebook
                np.savez(partial, **vars(found), seconds=seconds)
        return found

    def __str__(self) -> str:
        """Where the detections come from, in one sentence."""
        if not self.read:
            return f"Detected in {self.pairs} stereo pairs, {self.seconds:.1f} s."
        seconds = f"finding them took {self.seconds:.1f} s"
        return f"Detections in {self.read} of {self.pairs} stereo pairs were read from the cache; {seconds}."
