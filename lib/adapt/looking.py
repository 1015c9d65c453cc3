"""What detections in a recording reveal of their faults, and detection only where the image differs from the ground."""

from collections.abc import Callable

import numpy as np
from tqdm.auto import tqdm

from lib.calibration.offsets import OWN_BIAS
from lib.landmarks.contrast import levelled
from lib.landmarks.metrics import tool_length_px
from lib.landmarks.recorded import Seen
from lib.recordings import Recording

#: A detected tool stands still if it is in the same place, within this share of its length, in at least 4 frames.
_STILL, _STILL_FRAMES = 0.15, 4
_HELD_S = 0.12  # a log may repeat a sample for this long, until the robot renews it
_SURE, _FEWEST_IMAGES = 0.5, 5  # least confidence of tips, and number of images with two such, that show an exchange
#: The base has no edge that ends along the shaft.  A detector's constant error there is this multiple of its stated standard
#: deviation, if that exceeds `OWN_BIAS`.  Chosen by ten recordings of unfamiliar tools, also by two other renderers.
_BASE_BIAS = 2.0


def own_bias(seen: Seen) -> np.ndarray:
    """Standard deviations (3, 3) of the detector's constant errors: `OWN_BIAS`, and more if it is unsure of the base."""
    along = seen.u[:, :, 1:].mean(axis=2) - seen.u[:, :, 0]
    stated = np.sqrt(np.einsum("nci,ncij,ncj->nc", along, seen.covariance[:, :, 0], along)) / (along**2).sum(axis=2)
    own = OWN_BIAS.copy()
    own[0, 0] = max(own[0, 0], _BASE_BIAS * np.nanmedian(stated))
    return own


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
