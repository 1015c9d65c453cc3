"""Detection in a recording, and a cache through which notebooks of a run, or commands, share the detections of a pair."""

import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from tqdm.auto import tqdm

from lib import files, paths
from lib.correspondences import Correspondences, of_recording
from lib.landmarks.detector import Detector, Landmarks
from lib.recordings import Ground, GrowingGround, Recording

_ANY_GROUND = "any"  # in place of the ground's key, if the detector was sure and did not ask for it


def detect(
    recording: Recording, detector: Detector | None = None, *, frames: slice | np.ndarray | None = None, track: bool = False
) -> Correspondences:
    """Run the detector over a recording, one stereo frame at a time (a full-HD pair takes 12 MB).

    Returns three rows per frame (base, tip_1, tip_2), each with the robot's position at that time.  A missing landmark is
    NaN.  `Correspondences.complete` keeps the rows that both cameras and the robot have.

    Args:
        detector: None = the one that ships.
        frames: Which frames; None = all.
        track: Follow the landmarks from frame to frame (`Detector.track`), several times faster in consecutive frames.

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
    """Keyword arguments of a detector's call: the ground of the images, if known.  Empty for a function of images alone.

    `change` is the function that made the images from those of the recording; the ground is changed likewise.

    >>> with_ground(lambda images: Landmarks.none(len(images)), None)
    {}
    """
    if not isinstance(detector, Detector | SharedDetector) or recording.ground is None:
        return {}
    return {"ground": recording.ground.changed(change) if change else recording.ground}


class SharedDetector:
    """A detector for `detect` and `assess` that caches its results in a folder and reads them for images seen before.

    An environment variable set by `python3 -m lib` names the folder: `run` makes its own and removes it at its end, other
    commands use one in data/cache.  Without it nothing is cached.  A file's name is the digest of the images' pixels, the
    weights, the settings, the engine, and if the detector asked for the ground, its key.  To measure times, call the
    detector itself.

    Attributes:
        seconds: Time that the detections took, in s; for those read from the cache, the time when they were made.
        pairs, read: Number of calls, and of those answered from the cache.

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
        """Detect the landmarks of a stereo pair (2, h, w, 3), uint8 RGB; `ground` as in a `Detector`'s call."""
        self.pairs, pixels, asked = self.pairs + 1, images.tobytes() if self._folder else b"", []

        def file(of_ground: str) -> Path:
            content = f"{self._digest} {images.dtype} {images.shape} {of_ground}".encode() + pixels
            return Path(self._folder) / f"{files.digest(content, length=64)}.npz"

        key = str(ground and ground.key)
        for path in (file(_ANY_GROUND), file(key)) if self._folder else ():
            with suppress(OSError, ValueError, EOFError, KeyError, BadZipFile), np.load(path) as cached:  # else detect again
                found, seconds = Landmarks(cached["u"], cached["covariance"], cached["confidence"]), float(cached["seconds"])
                self.read, self.seconds = self.read + 1, self.seconds + seconds
                return found
        start = time.perf_counter()
        noted = ground and (lambda: asked.append(True) or ground())
        found = self.detector(images, **({"ground": noted} if isinstance(self.detector, Detector) else {}))
        seconds = time.perf_counter() - start
        self.seconds += seconds
        if self._folder:
            path = file(_ANY_GROUND if ground and not asked else key)
            with suppress(OSError), files.whole(path) as partial:  # a full disk must not stop a notebook
                np.savez(partial, **vars(found), seconds=seconds)
        return found

    def __str__(self) -> str:
        """One sentence on how many detections were computed or read, and their time."""
        if not self.read:
            return f"Detected in {self.pairs} stereo pairs, {self.seconds:.1f} s."
        seconds = f"finding them took {self.seconds:.1f} s"
        return f"Detections in {self.read} of {self.pairs} stereo pairs were read from the cache; {seconds}."
