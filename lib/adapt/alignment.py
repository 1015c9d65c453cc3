"""From half-wrong detections to the robot's clock and the cameras, and the robot's faults that the detections show."""

import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from lib.calibration import Calibration, CompetingCamerasError, LandmarkOffsets, calibrate, calibrate_as_shown
from lib.calibration.offsets import Unsettled
from lib.calibration.timing import clock_error, estimate_time_offset
from lib.correspondences import MIN_CONFIDENCE, TRAIN_FURTHER, Correspondences, DataError
from lib.landmarks.detector import NEAR
from lib.landmarks.metrics import tool_length_px
from lib.landmarks.recorded import Seen
from lib.recordings import Recording
from lib.trust import LEVELS, Hypothesis, diagnose, judge
from lib.trust.diagnosis import stated
from lib.trust.fitting import Problem
from lib.trust.footage import with_footage
from lib.trust.verdict import with_scene

#: Least confidences of the detections from which cameras are searched.
_CONFIDENCES = (MIN_CONFIDENCE, 0.5, 0.8)
#: Number of random parts of the detections that start a fit of all, their size, the rounds of each fit, the largest residual
#: of a detection that agrees, in scales of the Student t density (or `NEAR`), and the share of inliers that may disagree.
_PARTS, _PART, _ROUNDS, _AGREES, _OTHERS = 8, 0.35, 12, 3.0, 0.1
_NEARLY_ALL = 0.8  # share of inliers among the detections, above which no other cameras are searched
#: Least share of inliers (also the least rate of detection of one landmark relative to the others); their least number; and
#: the share from which no other threshold is tried.
LEAST_RIGHT, _FEWEST_RIGHT, _CLEAR = 0.1, 30, 0.3
#: Faults that disqualify the robot as a teacher, each with the least share of the residuals that it must explain.  A
#: detector's error that depends on the tool's pose looks like a slow drift of the robot; it explained up to 0.28 of them.
#: It can look like an axis of a wrong scale, too: that explained 0.75 of the oddness of pixels; errors of 3 to 6 %, 0.91.
#: Errors from frame to frame were never the likeliest cause in 15 recordings of good robots by unfamiliar renderers.
_FAULTS = dict.fromkeys((
    "clock", "camera_clock", "clock_rate", "frame_order", "tip_order", "tool_bends", "frozen_kinematics", "frozen_video",
    "rigid_tips", "jaw_opening", "scaled_axis", "mirrored_axis", "exchanged_eyes", "drift", "smoothed_log", "image_sways",
    "zoom_varies", "time_stamps", "backlash", "odd_pixels", "mixed_units", "same_images", "same_tips",
    "interlaced", "frozen_orientation", "robot_wanders",
), 0.15) | {"robot_drifts": 0.3, "robot_noise": 0.3, "scaled_axis": 0.8}  # fmt: skip
#: Residuals below this share of the tool's length are harmless, whatever fault explains them.
_HARMLESS = 0.01
#: Largest correction of the clock in a joint step with cameras and offsets, which assumes straight motion.
_LARGEST_STEP_S = 0.03
#: Fewest labelled pairs that determine outliers and offsets; with fewer, the standard deviation of a robot's usual offsets.
_FEW_PAIRS, _ROBOTS_OFFSET_MM = 8, 0.15
POOR = (DataError, np.linalg.LinAlgError)  # errors caused by poor data; any other error is a bug
LABEL = (
    "Label 10 pairs of frames (5 at least), far apart in place and depth (`python3 -m lib annotate RECORDING`), and give "
    "annotations.json with --labels."
)


class RefusalError(DataError):
    """The recording cannot teach; the message states why, and what to do."""


def aligned(
    recording: Recording, seen: Seen, *, by_hand: bool
) -> tuple[Recording, Calibration, Hypothesis | None, float, float]:
    """The recording with its clock corrected, the cameras, a fault or None, the clock's sd in s, the share of inliers.

    The fault is a wrong opening of the jaws, which may also be the detector's.  A `RefusalError` if no cameras of a stereo
    microscope explain the detections (or labels, if `by_hand`), or if another fault explains them.  Detections are judged
    twice if cameras and offsets together agree with others than cameras alone do (`_agreeing`).
    """
    calibrated = partial(_by_labels if by_hand else _by_detections, seen=seen)
    recording, clock_sd_s = clock(recording, seen, by_hand=by_hand)
    try:
        calibration = calibrated(recording)
    except RefusalError as error:  # perhaps the clock is so far off that too few inliers are left to estimate it
        if error.__cause__ is not None:
            raise
        recording = _scanned_clock(recording, lambda one: _fitted(one, seen).view_inliers.sum())
        clock_sd_s = 0.01
        calibration = calibrated(recording)
    for _ in range(2):
        step_s, sd_s = clock_error(calibration, seen.rows(recording), recording.kinematics, recording.offset_s)
        surer = sd_s <= 1.1 * clock_sd_s or len(seen.frame) < _FEW_PAIRS  # a scan with few pairs gives no sd
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
        recording = replace(recording, offset_s=recording.offset_s + 1e-3 * fault.value)
        clock_sd_s = 1e-3 * fault.sd
        calibration = calibrated(recording)
    if fault is not None and fault.name != "jaw_opening":
        cure = fault.cure.replace(TRAIN_FURTHER, "give labels")  # training has just been refused
        raise RefusalError(f"robot: {fault.text} {cure} {LABEL if cure != fault.cure else ''}".rstrip())
    if fault is None and not by_hand and (agreed := _agreeing(recording, seen, calibration)) is not seen:
        return aligned(recording, agreed, by_hand=by_hand)
    right = float(calibration.view_inliers.sum() / max(_reported(recording, seen), 1))
    return recording, calibration, fault, clock_sd_s, right


def clock(recording: Recording, seen: Seen, *, by_hand: bool = False) -> tuple[Recording, float]:
    """The recording with the clocks' offset as estimated from the images, if possible, and its standard deviation in s."""
    rows = seen.rows(recording)
    if len(seen.frame) < _FEW_PAIRS:  # too few for that: take the offset with the smallest residuals
        fit = _by_labels if by_hand else _fitted
        return _scanned_clock(recording, lambda one: -fit(one, seen).reprojection_rms_px), 0.01
    for reach_s in (0.2, 1.0):
        try:
            found = estimate_time_offset(rows, recording.kinematics, start_s=recording.offset_s, search_s=reach_s)
        except POOR:
            continue
        if abs(found.offset_s - recording.offset_s) > 3 * found.sd_s and found.sd_s < 0.02:
            return replace(recording, offset_s=found.offset_s), found.sd_s
        return recording, min(found.sd_s, 0.01)
    return recording, 0.005


def _scanned_clock(recording: Recording, merit: Callable[[Recording], float]) -> Recording:
    """The recording with the clock offset of highest merit among 21 within +-0.2 s; `clock_error` refines it later.

    Equal merits prefer the smallest change.  Nothing changes if no offset gives cameras.
    """
    def merit_at(change_s: float) -> float:
        with suppress(*POOR):
            return merit(replace(recording, offset_s=recording.offset_s + change_s))
        return -np.inf

    changes_s = sorted(np.linspace(-0.2, 0.2, 21).round(9).tolist(), key=abs)
    return replace(recording, offset_s=recording.offset_s + max(changes_s, key=merit_at))


def _fitted(recording: Recording, seen: Seen, **more: float | bool) -> Calibration:
    """Calibrate affine cameras with square pixels, which leave the landmarks' offsets the least freedom."""
    return calibrate(seen.rows(recording), model="square", image_size_px=recording.image_size_px, **more)


def placed(recording: Recording, seen: Seen, least: float = 0.0, ransac_px: float | None = None) -> Calibration:
    """As `_fitted`, with a finite working distance if the detections show one."""
    how = {"models": ("square", "square+distance"), "image_size_px": recording.image_size_px, "ransac_px": ransac_px}
    return calibrate_as_shown(seen.rows(recording, least), **how)


def _by_labels(recording: Recording, seen: Seen) -> Calibration:
    """As `placed`, from labels set by hand.  If they are few, all are inliers, and offsets have a robot's usual prior."""
    try:
        if len(seen.frame) >= _FEW_PAIRS:
            return placed(recording, seen)
        with warnings.catch_warnings(action="ignore", category=Unsettled):  # expected if the clock is off
            try:
                return _fitted(recording, seen, ransac_px=np.inf, offsets=True, offset_prior_sd=_ROBOTS_OFFSET_MM)
            except POOR:  # shut jaws have no axes
                return _fitted(recording, seen, ransac_px=np.inf)
    except POOR as error:
        reason = str(error).partition(". ")[0]  # without the cure, which is to adapt
        raise RefusalError(f"labels: no cameras agree with them ({reason}). {LABEL}") from error


def _by_detections(recording: Recording, seen: Seen) -> Calibration:
    """Calibrate with the detections, or if they do not agree on cameras, with the confident ones."""
    reported, length = _reported(recording, seen), tool_length_px(seen.u)
    reason, best, poor, competing = "none was found", None, None, None
    near_px = NEAR * float(np.quantile(length[np.isfinite(length)], 0.25)) if np.isfinite(length).any() else 0.0
    # An unknown tool's offsets widen the errors of inliers, so that outliers may not stand apart: hence a last, wide gate.
    rows_kept = {int((seen.confidence >= least).sum()): least for least in _CONFIDENCES[::-1]}  # equal counts are equal rows
    for least, ransac_px in (*((least, None) for least in sorted(rows_kept.values())), (MIN_CONFIDENCE, near_px)):
        if ransac_px is not None and competing:
            break  # it is unknown which of two cameras is right
        try:
            found = placed(recording, seen, least, ransac_px)
        except POOR as error:
            if ransac_px is None and (not competing or isinstance(error, CompetingCamerasError)):
                reason = str(error).partition(". ")[0].partition("; ")[0]  # without the cure, which is to adapt
            competing = error if isinstance(error, CompetingCamerasError) else competing
            continue
        right = float(found.view_inliers.sum() / max(reported, 1))
        if found.view_inliers.sum() < max(LEAST_RIGHT * reported, min(_FEWEST_RIGHT, 0.5 * reported)):
            reason = f"only {100 * right:.0f} % of the landmarks agree on cameras, {found.view_inliers.sum()} in number"
        elif found.reprojection_rms_px < near_px:
            best = best if best and right < 1.5 * best[1] else (found, right)
            if right > _CLEAR:
                break
        else:
            poor = poor or (found, right)
    if best or poor:
        return (best or poor)[0]
    raise RefusalError(f"detector: too few landmarks are right to start from ({reason}). {LABEL}") from competing


def _agreeing(recording: Recording, seen: Seen, found: Calibration) -> Seen:
    """A copy in which detections lose their confidence if a fit of cameras and offsets to all of them disagrees.

    The robot's offsets can exceed the errors of wrong detections.  Then cameras alone do not separate wrong from right.  The
    fit with offsets has several minima: fits to parts of the detections start it, and the likeliest result counts.  `seen`
    itself is returned if this agrees with nearly all inliers of `found`, or if nearly all detections are such inliers.
    """
    rows = seen.rows(recording)
    if found.view_inliers.sum() > _NEARLY_ALL * rows.seen.sum():
        return seen
    usable = np.isfinite(rows.x_mm).all(axis=1) & rows.seen.any(axis=1)
    rows, inliers = rows.subset(usable), found.view_inliers[usable]
    problem = Problem.of(rows, recording.image_size_px)
    random = np.random.default_rng(0).random((_PARTS, *inliers.shape)) < _PART
    parts = (replace(problem, seen=problem.seen & part) for part in (*(rows.confidence >= c for c in _CONFIDENCES), *random))
    starts = [part.fit(rounds=_ROUNDS).start for part in parts if part.used.sum() >= _FEWEST_RIGHT]
    if not starts:
        return seen
    fit = max((problem.fit(start=start, rounds=_ROUNDS) for start in starts), key=lambda fit: fit.total)
    near_px = np.maximum(_AGREES * problem.noise * fit.shapes[0].scale, NEAR * np.nanmedian(tool_length_px(seen.u)))
    agrees = np.linalg.norm(fit.residuals, axis=2) < near_px
    if (inliers & ~agrees).sum() <= _OTHERS * inliers.sum():
        return seen
    confidence = seen.confidence.copy()
    confidence[np.searchsorted(seen.frame, rows.frame), :, rows.landmark] *= agrees
    return seen._replace(confidence=confidence)


def _reported(recording: Recording, seen: Seen) -> int:
    """The number of landmarks that the robot reports in the frames of `seen`, counted in both images."""
    return 6 * int(np.isfinite(recording.landmarks_mm()[seen.frame]).all(axis=(1, 2)).sum())


def _fault(recording: Recording, seen: Seen, calibration: Calibration, *, by_hand: bool) -> Hypothesis | None:
    """The robot's fault that explains the detections, or None.  A `RefusalError` if no stereo microscope has such cameras."""
    red = [r for r in judge(None, calibration).reasons if r.level == LEVELS[2] and r.name in ("implausible_optics", "thin")]
    if red:
        raise RefusalError(f"cameras: {red[0].text} {red[0].cure}")
    if by_hand or calibration.reprojection_rms_px < _HARMLESS * np.nanmedian(tool_length_px(seen.u)):
        return None
    rows = seen.rows(recording)
    rows = replace(rows, confidence=np.where(calibration.view_inliers, rows.confidence, 0.0))
    return likeliest_fault(recording, rows, calibration.offsets)


def likeliest_fault(recording: Recording, rows: Correspondences, offsets: LandmarkOffsets | None) -> Hypothesis | None:
    """The fault that explains the rows best if it disqualifies the robot as a teacher, else None."""
    found = diagnose(rows, near=True, offsets=offsets, **stated(recording))
    best = with_footage(with_scene(found, recording, rows.frame), recording, rows).best
    return best if best is not None and best.explained >= _FAULTS.get(best.name, np.inf) else None
