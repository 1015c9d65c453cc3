"""From half-wrong detections to labels: calibrate cameras with the inliers, and project the robot's landmarks through them.

The robot's report is refused in frames in which its log stands still or the image shows the whole tool elsewhere.  It is
refused altogether if a fault of clock, axes or tool explains what the images show.
"""

import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.optimize import least_squares

from lib.adapt.looking import Seen, frozen
from lib.calibration import Calibration, CompetingCamerasError, LandmarkOffsets, calibrate, calibrate_as_shown
from lib.calibration.offsets import OWN_BIAS, Unsettled, carried, robots_part, shown_axes, tool_axes
from lib.calibration.timing import clock_error, estimate_time_offset
from lib.cameras import NearAffineCamera
from lib.correspondences import LANDMARKS, MIN_CONFIDENCE, DataError
from lib.landmarks.detector import NEAR
from lib.landmarks.metrics import tool_length_px
from lib.landmarks.shaft import ShaftEnd
from lib.recordings import Recording
from lib.recordings.annotations import CLICK_SD_PX, inside
from lib.trust import LEVELS, Hypothesis, diagnose, judge
from lib.trust.diagnosis import stated
from lib.trust.fitting import SIDES, Problem
from lib.trust.verdict import with_scene

#: Least share of inliers (also the least rate of detection of one landmark relative to the others); their least number; and
#: the share from which no other threshold is tried.
LEAST_RIGHT, _FEWEST_RIGHT, _CLEAR = 0.1, 30, 0.3
#: Least mean confidence of the inliers of a tip.  If the detector expects most of those that agree with each other to be
#: wrong, they agree on another point, such as the elbow of a jaw.
_LEAST_SURE = 0.5
#: Faults that disqualify the robot as a teacher, each with the least share of the residuals that it must explain.  A
#: detector's error that depends on the tool's pose looks like a slow drift of the robot; it explained up to 0.28 of them.
FAULTS = dict.fromkeys((
    "clock", "camera_clock", "clock_rate", "frame_order", "tip_order", "tool_bends", "frozen_kinematics", "frozen_video",
    "rigid_tips", "jaw_opening", "scaled_axis", "mirrored_axis", "exchanged_eyes", "drift", "smoothed_log", "image_sways",
    "zoom_varies", "time_stamps", "backlash", "odd_pixels", "mixed_units", "same_images", "same_tips",
), 0.15) | {"robot_drifts": 0.3}  # fmt: skip
#: Residuals below this share of the tool's length are harmless, whatever fault explains them.
_HARMLESS = 0.01
#: Largest share of the frames in which the images may contradict the robot.
_CONTRADICTED = 0.2
#: Largest offset of a landmark: a share of the tool's length or a length in mm, whichever is larger.  An offset larger by two
#: standard deviations is another point of the tool.  A robot's tool calibration errs by tenths of a mm even for short tools.
_LARGEST_OFFSET, _LARGEST_OFFSET_MM = 0.15, 0.25
#: Relative error of an offset if the tool's axes of shut jaws are taken from a time farther away than this.
_TURNED, _BORROWED_S = 0.3, 0.1
_TURNS_S = 0.02  # between the samples of the log from which axes are taken; shorter steps are not worth their time
#: Least gain in log likelihood per detection by separate cameras for two parts of the time, if the cameras moved.  A smaller
#: gain narrows the residuals by less than a quarter, which unknown offsets of the landmarks can do, too.
_SURE_MOVE = 0.5
#: Largest correction of the clock in a joint step with cameras and offsets, which assumes straight motion.
_LARGEST_STEP_S = 0.03
_BEHIND = 0.1  # least distance from the camera of a visible point, as a share of the working distance
_CONFIDENCES = (MIN_CONFIDENCE, 0.5, 0.8)
#: Fewest labelled pairs that determine outliers and offsets; with fewer, the standard deviation of a robot's usual offsets.
_FEW_PAIRS, _ROBOTS_OFFSET_MM = 8, 0.15
_POOR = (DataError, np.linalg.LinAlgError)  # errors caused by poor data; any other error is a bug
#: Largest distance of the measured end of the shaft from the label, in standard deviations; a farther one is another edge.
_ANOTHER_EDGE = 3.0
#: Error of the base's label along a tool that the detector knows, as a share of its length: 0.004 RMS on twelve recordings,
#: 0.014 in eleven cases: four others, each with two or three robots that err by 0.2 mm.
_KNOWN_BASE = 0.01
#: Prior standard deviations, as shares of the tool's length: of the offset from a detector's point to the labelled one, and
#: of the shift of an image that errors cause which all landmarks share.
_OTHER_POINT, _SHARED = 0.3, 0.02
LABEL = (
    "Label 10 pairs of frames (5 at least), far apart in place and depth (`python3 -m lib annotate RECORDING`), and give "
    "annotations.json with --labels."
)


class RefusalError(DataError):
    """The recording cannot teach; the message states why, and what to do."""


class OtherBaseError(RefusalError):
    """The detector marks another point than the robot for the base, but for no other landmark."""


def longest_still(recording: Recording, seen: Seen) -> tuple[np.ndarray, str]:
    """The frames before or after the cameras moved, whichever are more, and a note; all frames and "" if they did not."""
    rows, frames = seen.rows(_clock(recording, seen)[0]), seen.frame
    rows = rows.subset(np.isfinite(rows.x_mm).all(axis=1) & rows.seen.any(axis=1))
    problem = Problem.of(rows, recording.image_size_px)
    used = int(problem.used.sum())
    if used < 60 or len(frames) < 24:
        return frames, ""
    fit = problem.fit()
    first = np.unique(rows.frame)[problem.other_cameras(fit)[0]]
    parts = frames[frames < first], frames[frames >= first]
    own = sum(Problem.of(rows.of_frames(part), recording.image_size_px).fit().total for part in parts)
    # Separate cameras have 16 parameters more, and 12 allows for the choice of the cut.  Few frames may fit by chance.
    if min(map(len, parts)) < 0.15 * len(frames) or own - fit.total < 16 * np.log(used) / 2 + 12 + _SURE_MOVE * used:
        return frames, ""
    kept = max(parts, key=len)
    return kept, f"The cameras moved or the tool slipped at frame {first}: only frames {kept[0]} to {kept[-1]} are used."


@dataclass(frozen=True, eq=False)
class Teacher:
    """The robot's landmarks, projected through calibrated cameras.

    `offset_mm` (3, 3), in the tool's axes, leads from the robot's report of each landmark to the landmark;
    `offset_covariance_mm2` (3, 3, 3) is the covariance of each landmark's offset.
    """

    recording: Recording  # with the clock's offset as estimated from the images
    calibration: Calibration
    clock_sd_s: float
    offset_mm: np.ndarray
    offset_covariance_mm2: np.ndarray
    refused: np.ndarray  # frames in which the robot is not believed
    right: float  # share of inliers among the landmarks
    turns: bool = False  # as `LandmarkOffsets.turns`

    def project(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (m, 2, 3, 2) of the robot's landmarks at the instants of their image rows, and covariances (m, 2, 3, 2, 2).

        NaN where the robot is silent.  The covariance includes calibration, robot, clock and offset.
        """
        r, c, offset = self.recording, self.calibration, self.offset_mm
        time = np.repeat(r.frames.time_s[frames][:, None], 3, axis=1) + r.offset_s
        log_s = r.kinematics.time_s
        log = slice(None, None, max(1, int(_TURNS_S * (len(log_s) - 1) / max(np.ptp(log_s), _TURNS_S))))
        u, covariance = np.full((len(frames), 2, 3, 2), np.nan), np.full((len(frames), 2, 3, 2, 2), np.nan)
        for side, camera in enumerate(c.cameras):
            at = time
            for _ in range(3 if r.readout_s else 1):
                if side == 0 or r.readout_s:  # else both images belong to the same instants
                    x = r.kinematics.at(at)
                    when_s = np.append(log_s[log], at[:, 0])  # shut jaws take their axes from other samples of the log
                    order = np.argsort(when_s)
                    path = np.concatenate([r.kinematics.x_mm[log], x])[order]
                    known = tool_axes(path, offset if self.turns else None)
                    axes = np.nan_to_num(carried(known, path, when_s[order])[np.argsort(order)[len(when_s) - len(at) :]])
                    apart_s = np.abs(when_s[order][np.isfinite(known).all(axis=(1, 2))] - at[:, :1])
                    shut = apart_s.min(axis=1, initial=np.inf) > _BORROWED_S
                    moved_mm = x + np.einsum("mij,kj->mki", axes, offset)
                x = moved_mm.copy()
                if isinstance(camera, NearAffineCamera):  # points behind a camera are not visible
                    x[camera.depth_ratio(x.reshape(-1, 3)).reshape(x.shape[:2]) < _BEHIND] = np.nan
                u[:, side] = camera.project(x.reshape(-1, 3)).reshape(x.shape[:2] + (2,))
                at = time + r.readout_s * np.nan_to_num(u[:, side, :, 1] / (r.image_size_px[1] - 1) - 0.5).clip(-0.5, 0.5)
            flat, view = np.nan_to_num(x).reshape(-1, 3), slice(2 * side, 2 * side + 2)
            J = c.derivatives(flat)[0][:, view]
            velocity = (r.kinematics.at(at + 0.02) - r.kinematics.at(at - 0.02)).reshape(-1, 3) / 0.04
            moved = self.clock_sd_s * np.einsum("nij,nj->ni", J, np.nan_to_num(velocity))
            spread = np.einsum("mij,kjn,mln->mkil", axes, self.offset_covariance_mm2, axes).reshape(-1, 3, 3)
            spread += (_TURNED * shut[:, None] * np.linalg.norm(offset, axis=1)).reshape(-1, 1, 1) ** 2 * np.eye(3)
            spread = spread + max(r.robot_accuracy_mm, c.sigma_x_mm) ** 2 * np.eye(3)
            S = c.projection_covariance(flat)[:, view, view] + J @ spread @ J.mT + moved[:, :, None] * moved[:, None]
            covariance[:, side] = S.reshape(len(frames), 3, 2, 2)
        return u, np.where(np.isfinite(u)[..., None], covariance, np.nan)

    def axes_px(self, frames: np.ndarray) -> np.ndarray:
        """The images (m, 2, 2, 3) px of the tool's axes in some frames, each axis as long as the tool."""
        return shown_axes(self.recording.landmarks_mm()[frames], self.calibration.cameras)

    def with_base(self, end: ShaftEnd | None) -> "Teacher":
        """The teacher whose base is moved along the shaft to its measured end; itself if the two disagree.

        If the detector knows the tool, its label is better than the end; if not, the label errs as it states.  Both are
        equally likely beforehand.  The size of the shift changes the odds, which weigh the corrections of the two cases.
        A detector that does not know the tool marks the base too far back.  So the first case holds if the end lies behind.
        """
        if end is None:
            return self
        u, covariance = self.project(end.frame)
        along = end.along / (end.along**2).sum(axis=-1, keepdims=True)  # so that shifts are shares of the tool's length
        shift = np.nanmedian(((end.u - u[:, :, 0]) * along).sum(axis=-1))
        unknown = np.nanmedian(np.einsum("msi,msij,msj->ms", along, covariance[:, :, 0], along))
        variance = np.array([_KNOWN_BASE**2, unknown] if shift > 0 else [_KNOWN_BASE**2])
        total = variance + end.sd**2
        if not abs(shift) < _ANOTHER_EDGE * np.sqrt(total[-1]):
            return self
        gain, odds = variance / total, np.exp(-(shift**2) / (2 * total)) / np.sqrt(total)
        mean, square = (np.average(value, weights=odds) for value in (gain, gain**2))
        length_mm, offset, own = _length_mm(self.recording), self.offset_mm.copy(), self.offset_covariance_mm2.copy()
        offset[0] += mean * shift * length_mm * end.axis
        variance = (mean * end.sd**2 + (square - mean**2) * shift**2) * length_mm**2
        own_along = own[0] @ end.axis
        if (before := own_along @ end.axis) > variance:  # then it falls, as by a measurement
            own[0] -= (before - variance) / before**2 * np.outer(own_along, own_along)
        return replace(self, offset_mm=offset, offset_covariance_mm2=own)

    def labels(self, frames: np.ndarray, seen: Seen | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """u, covariance (as `project`) and visibility (m, 2, 3) of some frames; NaN where the robot is silent or refused.

        Visibility is 0 outside the image.  It is 1 (hidden) if `seen`, by a detector that knows the tool, has the two other
        landmarks in the right place but not this one.  Otherwise it is 2.
        """
        u, covariance = self.project(frames)
        u = np.where(np.isin(frames, self.refused)[:, None, None, None], np.nan, u)
        shown = np.where(inside(u, self.recording.image_size_px) | np.isnan(u[..., 0]), 2, 0)
        if seen is not None:
            part, length = seen.of(frames), tool_length_px(u)[..., None]
            right = (np.linalg.norm(part.u - u, axis=-1) < 0.05 * length) & (part.confidence >= MIN_CONFIDENCE)
            shown = np.where(~right & (right.sum(axis=2, keepdims=True) == 2) & (shown == 2), 1, shown)
        return u, covariance, shown


def teach(
    recording: Recording, seen: Seen | None, *, opinion: Seen | None = None, before: Teacher | None = None,
    by_hand: Seen | None = None,
) -> Teacher:  # fmt: skip
    """The teacher by a robot and by the detections `seen` in the frames for learning.

    Args:
        seen: None uses only the labels `by_hand`, of few frames.
        opinion: Detections by later stages that this robot never taught, which give the landmarks' offsets; else `seen` does.
        before: The teacher of the round before: its clock is the start, and frames that it refused stay refused.
        by_hand: Labels set by hand.  They determine the offsets, since detections may show other points of the tool.

    Raises:
        RefusalError: If fewer than a tenth of the landmarks, or than 30, are inliers; the inliers of a tip have a mean
            confidence below 0.5; the cameras are not those of a stereo microscope; a landmark is seen more than 15 % of the
            tool's length and 0.25 mm off; the standard deviation of its label exceeds `NEAR` of the tool's length; or the
            robot contradicts the images.
    """
    alone, seen = seen is None, by_hand if seen is None else seen
    refused = frozen(recording, np.arange(len(recording)))
    if before is not None:
        recording, refused = before.recording, np.union1d(refused, before.refused)
    in_both = np.isfinite(seen.u).all(axis=3).any(axis=2).all(axis=1)
    used = seen.of(np.setdiff1d(seen.frame[in_both] if alone else seen.frame, refused))
    if len(used.frame) < 5:
        few = f"in only {len(used.frame)} of {len(seen.frame)} frames the robot moves"
        few = f"labels: {few} and both images are labelled. {LABEL}" if alone else f"kinematics: {few}; check the log."
        raise RefusalError(few)
    recording, calibration, fault, clock_sd_s, right = _aligned(recording, used, by_hand=alone)
    clicks = None if by_hand is None else by_hand.of(np.setdiff1d(by_hand.frame, refused))
    clicked = not alone and clicks is not None and len(clicks.frame) > 0
    if opinion is None and before is None and by_hand is None:
        rows, inliers = used.rows(recording), calibration.view_inliers
        for k, tip in enumerate(LANDMARKS[1:], 1):  # the base has an end of its own, `with_base`
            sure = rows.confidence[inliers & (rows.landmark == k)[:, None]]
            if len(sure) and sure.mean() < _LEAST_SURE:
                raise RefusalError(
                    f"detector: it does not know this tool. What it takes for {tip} agrees with the robot, but its mean "
                    f"confidence in that is {sure.mean():.2f}: it may be another point. {LABEL}"
                )
    offsets, turns = calibration.offsets, False
    offset, covariance = np.zeros((3, 3)), np.tile(0.1**2 * np.eye(3), (3, 1, 1))
    if opinion is not None and not clicked:
        offsets = _opinion(recording, opinion, used.frame)
    if offsets is not None and offsets.offset.shape == (3, 3):
        length = _length_mm(recording)
        size_mm = np.linalg.norm(offsets.offset, axis=1)
        sd_mm = np.linalg.norm(offsets.standard_deviation * offsets.offset, axis=1) / np.maximum(size_mm, 1e-9)
        if (low := size_mm - 2 * sd_mm).max() > max(_LARGEST_OFFSET * length, _LARGEST_OFFSET_MM) and not (alone or clicked):
            k = int(low.argmax())
            raise (RefusalError if k else OtherBaseError)(
                f"detector: it sees {LANDMARKS[k]} {size_mm[k]:.2f} mm from where the robot reports it, "
                f"{100 * size_mm[k] / length:.0f} % of the tool's length. It marks another point, or the robot's tool has "
                f"other dimensions. {LABEL}"
            )
        if fault is not None and not (alone or clicked):
            raise RefusalError(f"robot: {fault.text} {fault.cure} Or the detector marks other points than the tips. {LABEL}")
        turns = offsets.turns
        own = 0.2 * OWN_BIAS if alone else (opinion or seen).own_bias
        offset, covariance = robots_part(offsets, own * length)
    elif before is not None:
        offset, covariance, turns = before.offset_mm, before.offset_covariance_mm2, before.turns
    teacher = Teacher(recording, calibration, clock_sd_s, offset, covariance, refused, right, turns)
    if clicked:
        teacher = _as_labelled(teacher, clicks)
    u, covariance = teacher.project(np.unique(np.linspace(0, len(recording) - 1, 200).astype(int)))
    share = np.nanmedian(np.sqrt(np.trace(covariance, axis1=-2, axis2=-1) / 2) / tool_length_px(u)[..., None])
    if share > NEAR:
        what = "labels" if alone else "detections"
        raise RefusalError(f"{what}: they leave an error of {100 * share:.0f} % of the tool's length (sd). {LABEL}")
    against = _contradicted(teacher, used)
    if len(against) > max(_CONTRADICTED * len(used.frame), 2):
        raise RefusalError(
            f"robot: in {len(against)} of {len(used.frame)} frames the images show the whole tool elsewhere than the robot "
            f"reports: a frozen log, another clock, a moved microscope, or a tool that the robot does not hold."
        )
    return replace(teacher, refused=np.union1d(refused, against))


def _opinion(recording: Recording, opinion: Seen, frames: np.ndarray) -> LandmarkOffsets | None:
    """The offsets by later stages; a `RefusalError` if these hardly detect a landmark near where the robot reports it."""
    shares = (opinion.confidence >= MIN_CONFIDENCE).mean(axis=(0, 1))
    if shares.min() < LEAST_RIGHT * shares.max():
        rare, often = LANDMARKS[shares.argmin()], LANDMARKS[shares.argmax()]
        raise RefusalError(
            f"detector: near the robot's report it sees {rare} in {100 * shares.min():.0f} % of the images and {often} in "
            f"{100 * shares.max():.0f} %. It marks another point for {rare}. {LABEL}"
        )
    with suppress(*_POOR):
        return _placed(recording, opinion.of(frames)).offsets
    return None


def _length_mm(recording: Recording) -> float:
    """Median length of the tool, from its base to the middle of its tips."""
    x = recording.landmarks_mm()
    return float(np.nanmedian(np.linalg.norm(x[:, 1:].mean(axis=1) - x[:, 0], axis=1)))


def _aligned(
    recording: Recording, seen: Seen, *, by_hand: bool
) -> tuple[Recording, Calibration, Hypothesis | None, float, float]:
    """The recording with its clock corrected, the cameras, a fault or None, the clock's sd in s, the share of inliers.

    The fault is a wrong opening of the jaws, which may also be the detector's.  A `RefusalError` if no cameras of a stereo
    microscope explain the detections (or labels, if `by_hand`), or if another fault explains them.
    """
    calibrated = partial(_by_labels if by_hand else _by_detections, seen=seen)
    recording, clock_sd_s = _clock(recording, seen, by_hand=by_hand)
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
        raise RefusalError(f"robot: {fault.text} {fault.cure}")
    right = float(calibration.view_inliers.sum() / max(_reported(recording, seen), 1))
    return recording, calibration, fault, clock_sd_s, right


def _clock(recording: Recording, seen: Seen, *, by_hand: bool = False) -> tuple[Recording, float]:
    """The recording with the clocks' offset as estimated from the images, if possible, and its standard deviation in s."""
    rows = seen.rows(recording)
    if len(seen.frame) < _FEW_PAIRS:  # too few for that: take the offset with the smallest residuals
        fit = _by_labels if by_hand else _fitted
        return _scanned_clock(recording, lambda one: -fit(one, seen).reprojection_rms_px), 0.01
    for reach_s in (0.2, 1.0):
        try:
            found = estimate_time_offset(rows, recording.kinematics, start_s=recording.offset_s, search_s=reach_s)
        except _POOR:
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
        with suppress(*_POOR):
            return merit(replace(recording, offset_s=recording.offset_s + change_s))
        return -np.inf

    changes_s = sorted(np.linspace(-0.2, 0.2, 21).round(9).tolist(), key=abs)
    return replace(recording, offset_s=recording.offset_s + max(changes_s, key=merit_at))


def _fitted(recording: Recording, seen: Seen, **more: float | bool) -> Calibration:
    """Calibrate affine cameras with square pixels, which leave the landmarks' offsets the least freedom."""
    return calibrate(seen.rows(recording), model="square", image_size_px=recording.image_size_px, **more)


def _placed(recording: Recording, seen: Seen, least: float = 0.0, ransac_px: float | None = None) -> Calibration:
    """As `_fitted`, with a finite working distance if the detections show one."""
    how = {"models": ("square", "square+distance"), "image_size_px": recording.image_size_px, "ransac_px": ransac_px}
    return calibrate_as_shown(seen.rows(recording, least), **how)


def _by_labels(recording: Recording, seen: Seen) -> Calibration:
    """As `_placed`, from labels set by hand.  If they are few, all are inliers, and offsets have a robot's usual prior."""
    try:
        if len(seen.frame) >= _FEW_PAIRS:
            return _placed(recording, seen)
        with warnings.catch_warnings(action="ignore", category=Unsettled):  # expected if the clock is off
            try:
                return _fitted(recording, seen, ransac_px=np.inf, offsets=True, offset_prior_sd=_ROBOTS_OFFSET_MM)
            except _POOR:  # shut jaws have no axes
                return _fitted(recording, seen, ransac_px=np.inf)
    except _POOR as error:
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
            found = _placed(recording, seen, least, ransac_px)
        except _POOR as error:
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
    best = with_scene(diagnose(rows, near=True, offsets=calibration.offsets, **stated(recording)), recording, seen.frame).best
    return best if best is not None and best.explained >= FAULTS.get(best.name, np.inf) else None


def _as_labelled(teacher: Teacher, labels: Seen) -> Teacher:
    """The teacher with offsets, and a shift of each camera's image, that are fitted to labels set by hand.

    An error that all landmarks share shifts the cameras: of thick jaws a detector may mark the visible side.
    """
    calibration, free = teacher.calibration, teacher.calibration.offsets
    fitted = free is not None and free.offset.shape == (3, 3)
    teacher = replace(teacher, turns=fitted and free.turns)
    start = free.offset.ravel() if fitted else np.zeros(9)
    own_sd, shift_sd = _OTHER_POINT * _length_mm(teacher.recording), _SHARED * np.nanmedian(tool_length_px(labels.u))

    def misfit(change: np.ndarray) -> np.ndarray:
        u = replace(teacher, offset_mm=(start + own_sd * change[:9]).reshape(3, 3)).project(labels.frame)[0]
        u += shift_sd * change[9:].reshape(2, 1, 2)
        return np.append(np.nan_to_num((u - labels.u) / CLICK_SD_PX), change)

    known = np.isfinite(labels.u)
    # The robust loss limits the influence of gross errors.
    found = least_squares(misfit, np.zeros(13), loss="soft_l1", f_scale=2.0, ftol=1e-4, xtol=1e-4)
    information = found.jac.T @ found.jac / max(1.0, 2 * found.cost / known.sum())
    own = own_sd**2 * np.linalg.inv(information[:9, :9])  # given the shift, whose variance the cameras get
    marked = known.any(axis=(0, 1, 3))[:, None]  # the other landmarks keep their offsets
    offset = np.where(marked, (start + own_sd * found.x[:9]).reshape(3, 3), teacher.offset_mm)
    own = np.where(marked[:, :, None], np.einsum("kikj->kij", own.reshape(3, 3, 3, 3)), teacher.offset_covariance_mm2)
    names = calibration.parameter_names
    chosen = np.eye(len(names))[[names.index(f"{side} offset {axis} (px)") for side in SIDES for axis in "xy"]]
    minimum = replace(calibration.minimum, state=calibration.minimum.state.moved(shift_sd * found.x[9:] @ chosen))
    covariance = calibration.parameter_covariance + shift_sd**2 * chosen.T @ np.linalg.inv(information)[9:, 9:] @ chosen
    calibration = replace(calibration, minimum=minimum, parameter_covariance=covariance)
    return replace(teacher, calibration=calibration, offset_mm=offset, offset_covariance_mm2=own)


def _contradicted(teacher: Teacher, seen: Seen) -> np.ndarray:
    """The frames in which at least two landmarks are far from the robot's report by the same shift, in both images."""
    free = teacher.calibration.offsets
    if free is not None and free.offset.shape == (3, 3):
        teacher = replace(teacher, offset_mm=free.offset, turns=free.turns)
    u, covariance = teacher.project(seen.frame)
    off = np.where((seen.confidence >= 0.5)[..., None], seen.u - u, np.nan)
    length = tool_length_px(u)[..., None]
    sd = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1) / 2) + teacher.calibration.reprojection_rms_px
    size = np.linalg.norm(off, axis=-1)
    wrong = (size > 0.06 * length) & (size > 6 * sd)  # (m, 2, 3)
    i, j = np.triu_indices(3, 1)  # pairs of landmarks
    alike = np.linalg.norm(off[:, :, i] - off[:, :, j], axis=-1) < 0.3 * size[:, :, i]
    return seen.frame[(wrong[:, :, i] & wrong[:, :, j] & alike).all(axis=1).any(axis=1)]
