"""The frames for judging, and how well detections agree there: with the robot, and left with right by epipolar lines."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from lib.adapt.looking import Seen
from lib.adapt.teacher import RefusalError, Teacher
from lib.landmarks.metrics import errors_px, nees, tool_length_px
from lib.recordings import Recording
from lib.trust.health import feature_matches

#: Distances count up to this share of the tool's length, and so does a landmark that is missing.
_CAP = 0.1
#: Matches that tell an epipolar geometry, of seven numbers, and how far from it right ones may lie.
_FEWEST, _NEAR_PX = 16, 1.5


def stretches(frames: np.ndarray, time_s: np.ndarray) -> dict[str, np.ndarray]:
    """Frames for learning, stopping and judging: three stretches of time with gaps of a frame and of 0.2 s between them.

    >>> parts = stretches(np.arange(40), np.arange(40) / 4)
    >>> [(int(part[0]), int(part[-1])) for part in parts.values()]
    [(0, 24), (26, 31), (33, 39)]
    """
    n = len(frames)
    if n < 17:  # fewer leave less than three to judge by
        raise RefusalError(f"recording: {n} frames are too few to learn from and to judge by; record 30 and more.")
    first, second = round(0.64 * n), round(0.79 * n)
    parts = {"learn": frames[: first - 1], "stop": frames[first:second], "judge": frames[second + 1 :]}
    for before, part in (("learn", "stop"), ("stop", "judge")):
        late = time_s[parts[part]] - time_s[parts[before][-1]] >= min(0.2, 0.02 * np.ptp(time_s[frames]))
        parts[part] = parts[part][late]
    return parts


@dataclass(frozen=True, eq=False)
class Agreement:
    """How far detections are from the robot's landmarks: infinitely where missing, NaN where these are not in the image."""

    distance_px: np.ndarray  # (m, 2, 3)
    sigmas: np.ndarray  # the same in units of their stated standard deviation
    length_px: np.ndarray  # (m, 2, 1) of the tool

    @property
    def relative(self) -> np.ndarray:
        """(m,) mean of a frame's distances as shares of the tool's length, each at most a tenth."""
        return frame_means(self.distance_px / self.length_px)

    def summary(self) -> dict[str, float]:
        """Numbers of the report; percent of the landmarks within a share of the tool's length."""
        known = ~np.isnan(self.distance_px)
        share, sigmas = (self.distance_px / self.length_px)[known], self.sigmas[np.isfinite(self.sigmas)]
        found = {"median_px": float(np.median(self.distance_px[known])), "mean_share": float(np.nanmean(self.relative))}
        found |= {"median_sigmas": float(np.median(sigmas)) if sigmas.size else np.nan}
        return found | {f"within_{100 * t:g}_percent": 100 * float((share <= t).mean()) for t in (0.01, 0.05, 0.1)}


def frame_means(share: np.ndarray) -> np.ndarray:
    """(m,) means over the landmarks of (m, ...) shares of the tool's length, each at most a tenth; NaN does not count."""
    return np.ma.masked_invalid(np.minimum(share, _CAP).reshape(len(share), -1)).mean(axis=1).filled(np.nan)


def agreement(teacher: Teacher, seen: Seen) -> Agreement:
    """Of some frames; those that the teacher refused do not count.  A `RefusalError` if it labels none."""
    u, covariance, shown = teacher.labels(seen.frame)
    there = np.isfinite(u).all(axis=-1) & (shown > 0)
    if not there.any():
        raise RefusalError(f"robot: it labels none of the {len(seen.frame)} frames that are kept for stopping or judging.")
    found, told = seen.u.reshape(-1, 3, 2), np.where(there[..., None], u, np.nan).reshape(-1, 3, 2)
    sigmas = np.sqrt(nees(found, told, (covariance + seen.covariance).reshape(-1, 3, 2, 2)) / 2)
    return Agreement(errors_px(found, told).reshape(there.shape), sigmas.reshape(there.shape), tool_length_px(u)[..., None])


def epipolar_px(recording: Recording, seen: Sequence[Seen], others: Seen) -> list[np.ndarray]:
    """Distances (m, 3) of left and right detections from an epipolar geometry, in px of one image; infinite where missing.

    Features of the eye that both images show tell it, with what most of `others`, of other frames, share: the tool is nearer
    than the eye, and where cameras have a finite distance the eye alone says little of the lines there.
    """
    matches = np.concatenate([feature_matches(recording, seen[0].frame), others.stacked_px.reshape(-1, 4)])
    left, right = np.split(matches[np.isfinite(matches).all(axis=1)], 2, axis=1)
    F, agree = None, np.zeros(0)
    if len(left) >= _FEWEST:
        F, agree = cv2.findFundamentalMat(left, right, cv2.USAC_MAGSAC, _NEAR_PX, 0.9999, 5000)
    if F is None or agree.sum() < max(_FEWEST, 0.25 * len(left)):
        raise RefusalError("images: left and right share too few features and landmarks, so nothing could judge a gain.")
    found = []
    for one in seen:
        u = np.concatenate([one.u, np.ones((*one.u.shape[:3], 1))], axis=3)
        lines, back = u[:, 0] @ F.T, u[:, 1] @ F
        slope = np.sqrt((lines[..., :2] ** 2 + back[..., :2] ** 2).sum(axis=-1))
        found.append(np.nan_to_num(np.sqrt(2) * np.abs((lines * u[:, 1]).sum(axis=-1)) / slope, nan=np.inf))
    return found


def better(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """Mean gain over frames (m,) and its standard deviation."""
    gain = (before - after)[np.isfinite(before - after)]
    return (float(gain.mean()), float(gain.std(ddof=1) / np.sqrt(len(gain)))) if len(gain) > 2 else (0.0, np.inf)
