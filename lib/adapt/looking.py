"""Detections in some frames: anywhere, near the robot's report, or only where the image differs from the ground."""

from collections.abc import Callable
from typing import NamedTuple, Self

import numpy as np
from tqdm.auto import tqdm

from lib.calibration.offsets import OWN_BIAS
from lib.correspondences import Correspondences, of_recording
from lib.landmarks import with_ground
from lib.landmarks.contrast import levelled
from lib.landmarks.detector import NEAR
from lib.landmarks.metrics import tool_length_px
from lib.recordings import Recording
from lib.recordings.annotations import CLICK_SD_PX

#: A detected tool stands still if it is in the same place, within this share of its length, in at least 4 frames.
_STILL, _STILL_FRAMES = 0.15, 4
_HELD_S = 0.12  # a log may repeat a sample for this long, until the robot renews it
_SURE, _FEWEST_IMAGES = 0.5, 5  # least confidence of tips, and number of images with two such, that show an exchange
#: The base has no edge that ends along the shaft.  A detector's constant error there is this multiple of its stated standard
#: deviation, if that exceeds `OWN_BIAS`.  Chosen by ten recordings of unfamiliar tools, also by two other renderers.
_BASE_BIAS = 2.0


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

    @property
    def own_bias(self) -> np.ndarray:
        """Standard deviations (3, 3) of the detector's constant errors: `OWN_BIAS`, and more if it is unsure of the base."""
        along = self.u[:, :, 1:].mean(axis=2) - self.u[:, :, 0]
        stated = np.sqrt(np.einsum("nci,ncij,ncj->nc", along, self.covariance[:, :, 0], along)) / (along**2).sum(axis=2)
        own = OWN_BIAS.copy()
        own[0, 0] = max(own[0, 0], _BASE_BIAS * np.nanmedian(stated))
        return own

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
    recording: Recording, detector: Callable, frames: np.ndarray, *, near: np.ndarray | None = None, title: str = ""
) -> Seen:
    """Detect in some frames; with `near` (m, 2, 3, 2) px only the detector's later stages run, which search only there.

    A progress bar is shown if it has a `title`.
    """
    found, known = [], with_ground(detector, recording)
    for i, number in enumerate(tqdm(frames, desc=title, unit="pair", disable=not title)):
        frame = recording.frames[int(number)]
        pair = np.stack([frame.left, frame.right])
        found.append(detector(pair, **known) if near is None else detector.near(pair, near[i], reach=NEAR, **known))
    return Seen(np.asarray(frames), *(np.stack([getattr(p, n) for p in found]) for n in ("u", "covariance", "confidence")))


def at_rest(seen: Seen, x_mm: np.ndarray) -> np.ndarray:
    """(m, 2) bool: the detected tool stands where it stands in other frames, although the robot's x_mm (m, 3, 3) moves.

    The robot must move in more than one direction, since a tool that moves along the view stands still in the image.
    """
    centre, length_mm = x_mm.mean(axis=1), np.linalg.norm(x_mm[:, 1:].mean(axis=1) - x_mm[:, 0], axis=-1)
    known, found = np.isfinite(centre).all(axis=1), np.zeros((len(x_mm), 2), bool)
    least_mm = 2 * _STILL * np.median(length_mm[known]) if known.any() else 0.0
    for i, side in np.argwhere(np.isfinite(seen.u).all(axis=(2, 3)) & known[:, None]):
        u = seen.u[:, side]
        near = np.linalg.norm(u - u[i], axis=2).mean(axis=1) < _STILL * tool_length_px(u[i : i + 1])
        at = centre[near & known]
        if len(at) >= _STILL_FRAMES:
            spread = np.linalg.svd(at - at.mean(axis=0), compute_uv=False) / np.sqrt(len(at))
            found[i, side] = spread[1] > least_mm
    return found


def frozen(recording: Recording, frames: np.ndarray) -> np.ndarray:
    """The frames in which the robot's log repeats one sample to the last digit for longer than `_HELD_S`, or is silent."""
    k = recording.kinematics
    same = np.append(False, (np.diff(np.nan_to_num(k.x_mm.reshape(len(k.x_mm), -1)), axis=0) == 0).all(axis=1))
    first = np.append(np.flatnonzero(~same), len(same))  # samples that differ from the one before
    held_s = k.time_s[first[1:] - 1] - k.time_s[first[:-1]]
    nearest = np.interp(recording.frames.time_s[frames] + recording.offset_s, k.time_s, np.arange(len(same))).round()
    return np.asarray(frames)[held_s[np.searchsorted(first, nearest, side="right") - 1] > _HELD_S]


def exchanged_tips(seen: Seen, labels: Seen) -> bool:
    """True if in most labelled images the detected tips lie at the labels with tip_1 and tip_2 exchanged."""
    seen = seen.of(labels.frame)
    off = (seen.u[:, :, 1:] - labels.u[:, :, tips] for tips in ([1, 2], [2, 1]))
    straight, crossed = (np.linalg.norm(one, axis=-1).mean(axis=2) for one in off)
    sure = (seen.confidence[:, :, 1:] >= _SURE).all(axis=2) & np.isfinite(straight)
    return bool(sure.sum() >= _FEWEST_IMAGES and (crossed < 0.5 * straight)[sure].mean() > 0.8)


def look_elsewhere(recording: Recording, detector: Callable, seen: Seen, still: np.ndarray, *, title: str = "") -> Seen:
    """A copy of `seen`; tools that are `still` (m, 2) are detected again, only where images differ from the ground."""
    images = np.argwhere(still if recording.ground is not None else np.zeros_like(still))
    found = Seen(*(part.copy() for part in seen))
    for i, side in tqdm(images, desc=title, unit="image", disable=not title):
        frame = recording.frames[int(seen.frame[i])]
        other = detector(levelled((frame.left, frame.right)[side], recording.ground()[side])[None])
        for part, one in zip(found[1:], (other.u, other.covariance, other.confidence), strict=True):
            part[i, side] = one[0]
    return found
