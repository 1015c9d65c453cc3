"""From half-wrong detections, or labels set by hand, to the robot's clock and cameras that the right ones agree on.

What the robot says is refused where its log stands still, and altogether where a fault of clock, axes or tool explains what
the images show.
"""

import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from typing import NamedTuple

import numpy as np

from lib.adapt.looking import NEAR, Seen
from lib.calibration import Calibration, CompetingCamerasError, calibrate, estimate_time_offset
from lib.calibration.timing import clock_error
from lib.correspondences import MIN_CONFIDENCE
from lib.landmarks.metrics import tool_length_px
from lib.recordings import Recording
from lib.trust import LEVELS, Hypothesis, diagnose, judge
from lib.trust.fitting import Problem

#: Least share of the landmarks that must agree on the cameras, and of the views of one that show it where the robot says;
#: fewest landmarks in number, and the share that needs no other try.
LEAST_RIGHT, _FEWEST_RIGHT, _CLEAR = 0.1, 30, 0.3
#: Faults after which the robot is no teacher, and the least share of the residuals that they must explain.
FAULTS = {
    "clock", "camera_clock", "clock_rate", "frame_order", "tip_order", "tool_bends", "frozen_kinematics", "frozen_video",
    "rigid_tips", "scaled_axis", "mirrored_axis", "exchanged_eyes", "drift",
}  # fmt: skip
_EXPLAINED = 0.15
#: Residuals below this share of the tool's length hold no fault that matters, however well one explains them.
_HARMLESS = 0.01
#: Gain in log likelihood of a detection, by which cameras of their own for a part of the time must explain it better.
#: A smaller gain narrows the residuals by less than a quarter, which unknown offsets of the landmarks do, too.
_SURE_MOVE = 0.5
#: Largest correction of the clock along with cameras and offsets: one step takes motions for straight.
_LARGEST_STEP_S = 0.03
_FINITE = 3.0  # the inverse distance of cameras, in its standard deviations, from which it is taken for finite
_CONFIDENCES = (MIN_CONFIDENCE, 0.5, 0.8)
#: Fewer labelled pairs tell neither outliers nor how large the offsets are; the usual ones of a robot, standard deviation.
_FEW_PAIRS, _ROBOTS_OFFSET_MM = 8, 0.15
#: The cure where detections do not do.
LABEL = (
    "Label 10 pairs of frames (5 at least), far apart in place and depth (`python3 -m lib annotate RECORDING`), and give "
    "annotations.json with --labels."
)


class RefusalError(ValueError):
    """The recording cannot teach; the text says why, and what to do."""


def longest_still(recording: Recording, seen: Seen) -> tuple[np.ndarray, str]:
    """The frames before or after the cameras moved, whichever are more, and what to say of it; all if they did not."""
    rows, frames = seen.rows(_clock(recording, seen)[0]), seen.frame
    problem = Problem.of(rows)
    if problem.used.sum() < 60 or len(frames) < 24:
        return frames, ""
    count = len(frames)

    @cache
    def gain(cut: int) -> float:
        parts = [Problem.of(rows.of_frames(part)) for part in (frames[:cut], frames[cut:])]
        return sum(part.fit().total for part in parts) if min(part.used.sum() for part in parts) >= 16 else -np.inf

    cut = max(np.unique(np.linspace(0.15, 0.85, 8) * count).astype(int), key=gain)
    for step in (max(count // 16, 1), 1, 1):
        cut = max((cut, cut - step, cut + step), key=gain)
    # Cameras of their own have 16 numbers more, and the cut could lie anywhere.
    if gain(cut) - problem.fit().total < 16 * np.log(problem.used.sum()) / 2 + 12 + _SURE_MOVE * problem.used.sum():
        return frames, ""
    kept = frames[:cut] if cut >= count - cut else frames[cut:]
    return kept, f"The cameras moved at about frame {frames[cut]}: only frames {kept[0]} to {kept[-1]} are used."


def frozen(recording: Recording, frames: np.ndarray) -> np.ndarray:
    """Frames at which the robot's log repeats itself to the last digit, or is silent."""
    k = recording.kinematics
    same = np.append(False, (np.diff(np.nan_to_num(k.x_mm.reshape(len(k.x_mm), -1)), axis=0) == 0).all(axis=1))
    same = np.convolve(same, np.ones(3), "same") >= 2  # two in a row
    nearest = np.abs(k.time_s[None] - (recording.frames.time_s[frames] + recording.offset_s)[:, None]).argmin(axis=1)
    return np.asarray(frames)[same[nearest]]


class Aligned(NamedTuple):
    """The recording with the clock's offset as the images show it, that offset's deviation, and the cameras."""

    recording: Recording
    calibration: Calibration
    clock_sd_s: float
    right: float  # share of the landmarks that agree on the cameras


def align(recording: Recording, seen: Seen, *, by_hand: bool = False) -> Aligned:
    """Clock and cameras, each by the other; `by_hand` says that `seen` are labels set by hand.

    A `RefusalError` where too few agree on cameras, these are no stereo microscope's, or a fault of the robot explains more.
    """
    calibrated = partial(_by_labels if by_hand else _by_detections, seen=seen)
    recording, clock_sd_s = _clock(recording, seen, by_hand=by_hand)
    try:
        calibration = calibrated(recording)
    except RefusalError as error:  # few right ones agree on cameras by a clock that is off, and do not tell its offset
        if error.__cause__ is not None:
            raise
        recording, clock_sd_s = _scanned_clock(recording, lambda one: _fitted(one, seen).view_inliers.sum()), 0.01
        calibration = calibrated(recording)
    for _ in range(2):
        step_s, sd_s = clock_error(calibration, seen.rows(recording), recording.kinematics, recording.offset_s)
        surer = sd_s <= 1.1 * clock_sd_s or len(seen.frame) < _FEW_PAIRS  # a scan of few pairs states no deviation
        if np.isinf(sd_s) or not surer:
            break
        clock_sd_s = max(sd_s, abs(step_s)) if abs(step_s) >= _LARGEST_STEP_S else sd_s
        if not 0.1 * sd_s < abs(step_s) < _LARGEST_STEP_S:
            break
        recording = replace(recording, offset_s=recording.offset_s + step_s)
        calibration = calibrated(recording)
    for _ in range(3):
        fault = _fault(recording, seen, calibration, by_hand=by_hand)
        if fault is None or fault.name != "clock":
            break
        recording, clock_sd_s = replace(recording, offset_s=recording.offset_s + 1e-3 * fault.value), 1e-3 * fault.sd
        calibration = calibrated(recording)
    if fault is not None:
        raise RefusalError(f"robot: {fault.text} {fault.cure}")
    return Aligned(recording, calibration, clock_sd_s, _right(calibration, recording, seen))


def _clock(recording: Recording, seen: Seen, *, by_hand: bool = False) -> tuple[Recording, float]:
    """The recording with the offset of the clocks that the images show, if they do, and its standard deviation."""
    rows = seen.rows(recording)
    if len(seen.frame) < _FEW_PAIRS:  # too few for that: the offset at which cameras explain the labels best
        fit = _by_labels if by_hand else _fitted
        return _scanned_clock(recording, lambda one: -fit(one, seen).reprojection_rms_px), 0.01
    for reach_s in (0.2, 1.0):
        try:
            found = estimate_time_offset(rows, recording.kinematics, start_s=recording.offset_s, search_s=reach_s)
        except ValueError:
            continue
        if abs(found.offset_s - recording.offset_s) > 3 * found.sd_s and found.sd_s < 0.02:
            return replace(recording, offset_s=found.offset_s), found.sd_s
        return recording, min(found.sd_s, 0.01)
    return recording, 0.005


def _scanned_clock(recording: Recording, merit: Callable[[Recording], float]) -> Recording:
    """The recording with the clock offset of the highest merit, of 21 within 0.2 s; `clock_error` tells the rest.

    Of equal ones the smallest change; none where no offset gives cameras.
    """
    def merit_at(change_s: float) -> float:
        try:
            return merit(replace(recording, offset_s=recording.offset_s + change_s))
        except ValueError:
            return -np.inf

    changes_s = sorted(np.linspace(-0.2, 0.2, 21).round(9).tolist(), key=abs)
    return replace(recording, offset_s=recording.offset_s + max(changes_s, key=merit_at))


def _fitted(
    recording: Recording, seen: Seen, least: float = 0.0, ransac_px: float | None = None, **more: float | str
) -> Calibration:
    """Affine cameras of square pixels, which leave the landmarks' offsets the least room."""
    how = {"model": "square", "image_size_px": recording.image_size_px, "ransac_px": ransac_px} | more
    return calibrate(seen.rows(recording, least), **how)


def placed(recording: Recording, seen: Seen, least: float = 0.0, ransac_px: float | None = None) -> Calibration:
    """As `_fitted`, of a finite distance where the detections show one."""
    affine = _fitted(recording, seen, least, ransac_px)
    with suppress(ValueError):
        near = _fitted(recording, seen, least, ransac_px, model="square+distance")
        value, sd = near.inverse_distance_per_mm
        return near if value > _FINITE * sd else affine
    return affine


def _by_labels(recording: Recording, seen: Seen) -> Calibration:
    """As `placed`, from labels set by hand.  If they are few, all count as right, with a robot's usual offsets."""
    try:
        if len(seen.frame) >= _FEW_PAIRS:
            return placed(recording, seen)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "offsets:", RuntimeWarning)  # by a clock that is off they find no end
            try:
                return _fitted(recording, seen, ransac_px=np.inf, offsets=True, offset_prior_sd=_ROBOTS_OFFSET_MM)
            except ValueError:  # jaws that are shut have no axes
                return _fitted(recording, seen, ransac_px=np.inf)
    except ValueError as error:
        raise RefusalError(f"labels: no cameras agree with them ({error}). {LABEL}") from error


def _by_detections(recording: Recording, seen: Seen) -> Calibration:
    """Cameras that the detections agree on, the confident ones if all do not."""
    told, length = _told(recording, seen), tool_length_px(seen.u)
    reason, best, poor, competing = "none was found", None, None, None
    near_px = NEAR * float(np.quantile(length[np.isfinite(length)], 0.25)) if np.isfinite(length).any() else 0.0
    # Offsets of an unknown tool widen the errors of the right ones, until the wrong ones do not stand apart.
    for least, ransac_px in (*((least, None) for least in _CONFIDENCES), (MIN_CONFIDENCE, near_px)):
        if ransac_px is not None and competing:
            break  # nothing tells which is the robot's
        try:
            found = placed(recording, seen, least, ransac_px)
        except ValueError as error:
            if ransac_px is None and (not competing or isinstance(error, CompetingCamerasError)):
                reason = str(error).partition(". ")[0].partition("; ")[0]  # their cures lead here
            competing = error if isinstance(error, CompetingCamerasError) else competing
            continue
        right = _right(found, recording, seen)
        if found.view_inliers.sum() < max(LEAST_RIGHT * told, min(_FEWEST_RIGHT, 0.5 * told)):
            reason = f"only {100 * right:.0f} % of the landmarks agree on cameras, {found.view_inliers.sum()} in number"
        elif found.reprojection_rms_px < near_px:
            best = best if best and right < 1.5 * _right(best, recording, seen) else found
            if right > _CLEAR:
                break
        else:
            poor = poor or found
    if best or poor:
        return best or poor
    raise RefusalError(f"detector: too few landmarks are right to start from ({reason}). {LABEL}") from competing


def _told(recording: Recording, seen: Seen) -> int:
    """How many landmarks, two views each, the robot reports in the frames of `seen`."""
    return 6 * int(np.isfinite(recording.landmarks_mm()[seen.frame]).all(axis=(1, 2)).sum())


def _right(found: Calibration, recording: Recording, seen: Seen) -> float:
    """The share of these landmarks that agree on the cameras."""
    return float(found.view_inliers.sum() / max(_told(recording, seen), 1))


def _fault(recording: Recording, seen: Seen, calibration: Calibration, *, by_hand: bool) -> Hypothesis | None:
    """The robot's fault that explains what the images show, if there is one; cameras of no stereo microscope are refused."""
    red = [r for r in judge(None, calibration).reasons if r.level == LEVELS[2] and r.name in ("implausible_optics", "thin")]
    if red:
        raise RefusalError(f"cameras: {red[0].text} {red[0].cure}")
    length = np.nanmedian(tool_length_px(seen.u))
    if by_hand or calibration.reprojection_rms_px < _HARMLESS * length:
        return None
    rows = seen.rows(recording)
    rows = replace(rows, confidence=np.where(calibration.view_inliers, rows.confidence, 0.0))
    how = {"kinematics": recording.kinematics, "readout_s": recording.readout_s, "image_size_px": recording.image_size_px}
    best = diagnose(rows, **how).best
    return best if best is not None and best.name in FAULTS and best.explained >= _EXPLAINED else None
