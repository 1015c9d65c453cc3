"""The frames for judging, and how well detections agree there: with the robot, and left with right by epipolar distance."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from lib.adapt.alignment import LABEL, RefusalError
from lib.adapt.teacher import Teacher
from lib.correspondences import FEWEST_TO_TRAIN, MIN_CONFIDENCE
from lib.landmarks.metrics import errors_px, nees, tool_length_px
from lib.landmarks.recorded import Seen
from lib.landmarks.shaft import ShaftEnd
from lib.recordings import Recording
from lib.trust.health import feature_matches

#: Largest distance that counts, as a share of the tool's length; a missing landmark counts as this far away.
_CAP = 0.1
#: Fewest matches for a fundamental matrix (seven numbers), and largest distance of inliers from it.
_FEWEST, _NEAR_PX = 16, 1.5
#: Distances from a base that was taught, as shares of the tool's length.  `CONFIRMED`: the measured end of the shaft is at
#: most so far away.  `_APART`: the base in whole images is farther away (median); that was up to 0.06 in 24 recordings of
#: unfamiliar tools, with robots that erred by up to 0.3 mm.  `_SAME`: a detected base is there.
CONFIRMED, _APART, _SAME = 0.03, 0.1, 0.05


def stretches(frames: np.ndarray, time_s: np.ndarray, labelled: int = 0) -> dict[str, np.ndarray]:
    """Split frames into training, validation and test set ("learn", "stop", "judge"): stretches of time with gaps of 0.2 s.

    `labelled` is the number of other frames, which are labelled by hand and belong to the training set.

    >>> parts = stretches(np.arange(40), np.arange(40) / 4)
    >>> [(int(part[0]), int(part[-1])) for part in parts.values()]
    [(0, 24), (26, 31), (33, 39)]
    """
    n = len(frames)
    if n + labelled < FEWEST_TO_TRAIN or n < 10:
        raise RefusalError(f"recording: {n + labelled} frames are too few to learn from and to judge by; record 30 or more.")
    first, second = min(round(0.64 * n), n - 7), min(round(0.79 * n), n - 4)  # three are left for judging
    parts = {"learn": frames[: first - 1], "stop": frames[first:second], "judge": frames[second + 1 :]}
    for before, part in (("learn", "stop"), ("stop", "judge")):
        late = time_s[parts[part]] - time_s[parts[before][-1]] >= min(0.2, 0.02 * np.ptp(time_s[frames]))
        parts[part] = parts[part][late]
    return parts


@dataclass(frozen=True, eq=False)
class Agreement:
    """Distances of detections from the robot's landmarks: infinite if not detected, NaN if a landmark is off the image."""

    distance_px: np.ndarray  # (m, 2, 3)
    sigmas: np.ndarray  # (m, 2, 3) the same in stated standard deviations
    length_px: np.ndarray  # (m, 2, 1) of the tool

    @property
    def relative(self) -> np.ndarray:
        """(m,) mean distance in each frame, as a share of the tool's length; each distance counts up to a tenth."""
        return frame_means(self.distance_px / self.length_px)

    def summary(self) -> dict[str, float]:
        """Numbers for the report; `within_..._percent` of the landmarks lie within that share of the tool's length."""
        known = ~np.isnan(self.distance_px)
        share, sigmas = (self.distance_px / self.length_px)[known], self.sigmas[np.isfinite(self.sigmas)]
        found = {"median_px": float(np.median(self.distance_px[known])), "mean_share": float(np.nanmean(self.relative))}
        found |= {"median_sigmas": float(np.median(sigmas)) if sigmas.size else np.nan}
        return found | {f"within_{100 * t:g}_percent": 100 * float((share <= t).mean()) for t in (0.01, 0.05, 0.1)}


def sd_share(teacher: Teacher, frames: np.ndarray) -> np.ndarray:
    """Median standard deviation (3,) of a teacher's labels of each landmark, as a share of the tool's length."""
    u, covariance = teacher.project(frames)
    sd_px = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1) / 2)
    return np.nanmedian(sd_px / tool_length_px(u)[..., None], axis=(0, 1))


def check_base(teacher: Teacher, seen: Seen, end: ShaftEnd | None) -> None:
    """A `RefusalError` if the base as `seen` in whole images is elsewhere than a teacher's, and no shaft's `end` is there.

    A detector that looks near the robot's base may follow the robot, whatever is there.  Only shifts along the tool count;
    detections farther than half its length are of other objects, and fewer than 16 tell nothing.
    """
    shift, aside = _from_base(teacher, seen.frame, seen.u[:, :, 0])
    shift = shift[(np.hypot(shift, aside) < 0.5) & (seen.confidence[:, :, 0] >= MIN_CONFIDENCE)]
    ends = np.nan if end is None else float(np.nanmedian(_from_base(teacher, end.frame, end.u)[0]))
    if len(shift) < _FEWEST or abs(ends) <= CONFIRMED:
        return
    apart, also = float(np.median(shift)), ""
    if (np.abs(shift - ends) < _SAME).sum() > (np.abs(shift) < _SAME).sum():
        apart, also = ends, ", and there the aligned images show the end of the shaft"
    elif abs(apart) <= _APART:
        return
    what = f"in whole images it sees the base {100 * abs(apart):.0f} % of the tool's length"
    what += f" from where robot and images place it{also}"
    raise RefusalError(f"detector: {what}. It marks another point there, or the robot's tool has other dimensions. {LABEL}")


def _from_base(teacher: Teacher, frames: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shifts (m, 2) of points (m, 2, 2) px from a teacher's base, along and across the tool, as shares of its length."""
    u = teacher.project(frames)[0]
    along, off = u[:, :, 1:].mean(axis=2) - u[:, :, 0], points - u[:, :, 0]
    square = (along**2).sum(axis=-1)
    return (off * along).sum(axis=-1) / square, (off[..., 0] * along[..., 1] - off[..., 1] * along[..., 0]) / square


def frame_means(share: np.ndarray) -> np.ndarray:
    """(m,) means over the landmarks of shares (m, ...) of the tool's length, each limited to a tenth; NaN is ignored."""
    return np.ma.masked_invalid(np.minimum(share, _CAP).reshape(len(share), -1)).mean(axis=1).filled(np.nan)


def agreement(teacher: Teacher, seen: Seen, fewest: int = 1) -> Agreement:
    """The agreement of detections with a teacher, in frames that it labels; a `RefusalError` if these are too few."""
    u, covariance, shown = teacher.labels(seen.frame)
    is_labelled = np.isfinite(u).all(axis=-1) & (shown > 0)
    if (n := is_labelled.any(axis=(1, 2)).sum()) < fewest:
        raise RefusalError(
            f"robot: it labels {n} of the {len(seen.frame)} frames that are kept for stopping or judging; in the others the "
            "log stands still or is silent, or the tool is out of view. Record longer, or end while the tool moves in view."
        )
    found, labels = seen.u.reshape(-1, 3, 2), np.where(is_labelled[..., None], u, np.nan).reshape(-1, 3, 2)
    sigmas = np.sqrt(nees(found, labels, (covariance + seen.covariance).reshape(-1, 3, 2, 2)) / 2).reshape(is_labelled.shape)
    return Agreement(errors_px(found, labels).reshape(is_labelled.shape), sigmas, tool_length_px(u)[..., None])


def epipolar_px(recording: Recording, seen: Sequence[Seen], others: Seen) -> list[np.ndarray]:
    """Epipolar distances (m, 3) between left and right detections, in px of one image; infinite where missing.

    The epipolar geometry is fitted to features of the eye that both images show, and to `others`, detections in other frames.
    Features alone do not suffice: the tool is nearer than the eye, and with a perspective the lines differ there.
    """
    matches = np.concatenate([feature_matches(recording, seen[0].frame), others.stacked_px.reshape(-1, 4)])
    left, right = np.split(matches[np.isfinite(matches).all(axis=1)], 2, axis=1)
    F, agree = None, np.zeros(0)
    if len(left) >= _FEWEST:
        F, agree = cv2.findFundamentalMat(left, right, cv2.USAC_MAGSAC, _NEAR_PX, 0.9999, 5000)
    if F is None or agree.sum() < max(_FEWEST, 0.25 * len(left)):
        raise RefusalError("images: left and right share too few features and landmarks to judge an improvement.")
    found = []
    for one in seen:
        u = np.concatenate([one.u, np.ones((*one.u.shape[:3], 1))], axis=3)
        lines, back = u[:, 0] @ F.T, u[:, 1] @ F
        slope = np.sqrt((lines[..., :2] ** 2 + back[..., :2] ** 2).sum(axis=-1))
        found.append(np.nan_to_num(np.sqrt(2) * np.abs((lines * u[:, 1]).sum(axis=-1)) / slope, nan=np.inf))
    return found


def better(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """Mean over the frames of the gain `before` - `after` (m,), and its standard error."""
    gain = (before - after)[np.isfinite(before - after)]
    return (float(gain.mean()), float(gain.std(ddof=1) / np.sqrt(len(gain)))) if len(gain) > 2 else (0.0, np.inf)
