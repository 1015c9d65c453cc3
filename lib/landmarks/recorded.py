"""Detection in a recording, and a cache through which notebooks of a run, or commands, share the detections of a pair."""

import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, Self
from zipfile import BadZipFile

import numpy as np
from tqdm.auto import tqdm

from lib import files, paths
from lib.correspondences import Correspondences, of_recording
from lib.landmarks.detector import NEAR, Detector, Landmarks
from lib.recordings import Ground, GrowingGround, Recording
from lib.recordings.annotations import CLICK_SD_PX

_ANY_GROUND = "any"  # in place of the ground's key, if the detector was sure and did not ask for it


class Seen(NamedTuple):
    """Detections in m stereo frames: frame (m,), u (m, 2, 3, 2) px, covariance (m, 2, 3, 2, 2) px^2, confidence (m, 2, 3)."""

    frame: np.ndarray
    u: np.ndarray
    covariance: np.ndarray
    confidence: np.ndarray

    @classmethod
    def by_hand(cls, u: np.ndarray) -> Self:
        """Labels set by hand as detections: u (all frames, 2, 3, 2) px, NaN where there is none."""
        frames = np.flatnonzero(np.isfinite(u).any(axis=(1, 2, 3)))
        nothing = np.full((len(frames), 2, 3, 2), np.nan)
        return cls(frames, nothing, nothing[..., None] * np.eye(2), np.zeros((len(frames), 2, 3))).labelled(u)

    @property
    def stacked_px(self) -> np.ndarray:
        """(m, 3, 4) px: left x, y, right x, y."""
        return np.concatenate([self.u[:, 0], self.u[:, 1]], axis=-1)

    def rows(self, recording: Recording, least: float = 0.0) -> Correspondences:
        """The detections paired with the robot's positions; those with a confidence below `least` do not count."""
        known = {"covariance_px2": self.covariance, "confidence": np.where(self.confidence >= least, self.confidence, 0.0)}
        known = {name: np.moveaxis(value, 1, 2) for name, value in known.items()}
        return of_recording(recording, self.u[:, 0], self.u[:, 1], frames=self.frame, **known)

    def of(self, frames: np.ndarray) -> Self:
        """The detections of the given frames."""
        return Seen(*(part[np.isin(self.frame, frames)] for part in self))

    def labelled(self, u: np.ndarray) -> Self:
        """A copy in which labels set by hand, u (all frames, 2, 3, 2) px or NaN, replace detections of their landmarks."""
        u = u[self.frame]
        known = np.isfinite(u).all(axis=-1)
        covariance = np.where(known[..., None, None], CLICK_SD_PX**2 * np.eye(2), self.covariance)
        return Seen(self.frame, np.where(known[..., None], u, self.u), covariance, np.where(known, 1.0, self.confidence))

    def with_base(self, other: Self) -> Self:
        """A copy with the bases of other detections in the same frames."""
        parts = zip(self[1:], other[1:], strict=True)
        return Seen(self.frame, *(np.concatenate([base[:, :, :1], tips[:, :, 1:]], axis=2) for tips, base in parts))


def look(
    recording: Recording, detector: Callable, frames: np.ndarray, *, near: np.ndarray | None = None, track: bool = False,
    title: str = "", leave: bool = True,
) -> Seen:  # fmt: skip
    """Detect in some frames, one after the other.

    With `near` (m, 2, 3, 2) px only the detector's later stages run, which search only there; `track` as in `detect`.
    A progress bar is shown if it has a `title`; with `leave` it stays when all is done.
    """
    found, known = [], with_ground(detector, recording)
    for i, number in enumerate(tqdm(frames, desc=title, unit="pair", disable=not title, leave=leave)):
        frame = recording.frames[int(number)]
        pair = np.stack([frame.left, frame.right])
        if near is not None:
            found.append(detector.near(pair, near[i], reach=NEAR, **known))
        elif track and found:
            found.append(detector.track(pair, found[-1], **known))
        else:
            found.append(detector(pair, **known))
    return Seen(np.asarray(frames), *(np.stack([getattr(p, n) for p in found]) for n in ("u", "covariance", "confidence")))


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
    return look(recording, detector, chosen, track=track, title="landmarks", leave=False).rows(recording)


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
