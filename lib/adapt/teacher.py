"""From half-wrong detections to labels: the robot's landmarks, projected through cameras that its detections give.

The robot's report is refused in frames in which its log stands still or the image shows the whole tool elsewhere.  It is
refused altogether if a fault of clock, axes or tool explains what the images show.
"""

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.optimize import least_squares

from lib.adapt.alignment import LABEL, LEAST_RIGHT, POOR, RefusalError, aligned, clock, likeliest_fault, placed
from lib.adapt.looking import frozen, own_bias
from lib.calibration import Calibration, LandmarkOffsets
from lib.calibration.offsets import OWN_BIAS, carried, robots_part, shown_axes, tool_axes
from lib.cameras import NearAffineCamera
from lib.correspondences import LANDMARKS, MIN_CONFIDENCE, Correspondences
from lib.landmarks.detector import NEAR
from lib.landmarks.metrics import tool_length_px
from lib.landmarks.recorded import Seen
from lib.landmarks.shaft import ShaftEnd
from lib.recordings import Recording
from lib.recordings.annotations import CLICK_SD_PX, inside
from lib.trust.fitting import SIDES, Problem, by_steps

#: Least mean confidence of the inliers of a tip.  If the detector expects most of those that agree with each other to be
#: wrong, they agree on another point, such as the elbow of a jaw.
_LEAST_SURE = 0.5
_STRETCH, _SPAN = 3, 10  # this many successive frames with exchanged tips, within so many frames, are no chance
_FEWEST_SEEN = 20  # fewest detections of a landmark of which a share is judged
#: Largest share of the frames in which the images may contradict the robot.
_CONTRADICTED = 0.2
#: Largest offset of a landmark: a share of the tool's length or a length in mm, whichever is larger.  An offset larger by two
#: standard deviations is another point of the tool.  A robot's tool calibration errs by tenths of a mm even for short tools.
_LARGEST_OFFSET, _LARGEST_OFFSET_MM = 0.15, 0.25
#: Distance of the tips across the tool, with and without offsets, that shows its roll: a share of the tool's length, or a
#: multiple of the standard deviation, whichever is smaller.  And the least share of the log in which jaws are so far open.
_OPEN, _OPEN_SDS, _OPEN_SHARE = 0.12, 8.0, 0.2
#: Relative error of an offset if the tool's axes of shut jaws are taken from a time farther away than this.
_TURNED, _BORROWED_S = 0.3, 0.1
_TURNS_S = 0.02  # between the samples of the log from which axes are taken; shorter steps are not worth their time
#: Distance, as a share of the tool's length, within which an image shows the tool of another instant; those instants, s.
_LATE, _OTHER_S = 0.03, np.linspace(-2.0, 2.0, 101)
#: Least gain in log likelihood per detection by separate cameras for two parts of the time, if the cameras moved.  A smaller
#: gain narrows the residuals by less than a quarter, which unknown offsets of the landmarks can do, too.
_SURE_MOVE = 0.5
_STEP_S, _CLOCK_ROUNDS = 0.01, 3  # half of the time over which a velocity is measured; corrections of the clock by these
_BEHIND = 0.1  # least distance from the camera of a visible point, as a share of the working distance
#: Largest distance of the measured end of the shaft from the label, in standard deviations; a farther one is another edge.
_ANOTHER_EDGE = 3.0
#: Prior standard deviations, as shares of the tool's length: of the offset from a detector's point to the labelled one, and
#: of the shift of an image that errors cause which all landmarks share.
_OTHER_POINT, _SHARED = 0.3, 0.02


class OtherBaseError(RefusalError):
    """The detector marks another point than the robot for the base, but for no other landmark."""


def longest_still(recording: Recording, seen: Seen) -> tuple[np.ndarray, str]:
    """The frames before or after the cameras moved, whichever are more, and a note; all frames and "" if they did not."""
    recording, frames = clock(recording, seen)[0], seen.frame
    for _ in range(_CLOCK_ROUNDS):  # a clock that is a little off would be a reason for other cameras in a part of the path
        rows = seen.rows(recording)
        rows = rows.subset(np.isfinite(rows.x_mm).all(axis=1) & rows.seen.any(axis=1))
        problem = Problem.of(rows, recording.image_size_px)
        used = int(problem.used.sum())
        if used < 60 or len(frames) < 24:
            return frames, ""
        log_s, own = rows.time_s + recording.offset_s, (np.arange(len(rows)), rows.landmark)
        early, late = (recording.kinematics.at(log_s + step_s)[own] for step_s in (-_STEP_S, _STEP_S))
        velocity = np.nan_to_num(late - early)[..., None] / (2 * _STEP_S)  # fits the clock along with the cameras
        fit = problem.fit(by_steps(velocity))
        recording = replace(recording, offset_s=recording.offset_s + float(np.clip(fit.theta[0], -0.1, 0.1)))
    first = np.unique(rows.frame)[problem.other_cameras(fit)[0]]
    parts = frames[frames < first], frames[frames >= first]
    each = [Problem.of(rows.of_frames(part), recording.image_size_px) for part in parts]
    apart = [one.fit(by_steps(velocity[np.isin(rows.frame, part)])).total for one, part in zip(each, parts, strict=True)]
    # Separate cameras have 17 parameters more with the clock, and 12 allows for the choice of the cut.  Few frames may fit by
    # chance.
    if min(map(len, parts)) < 0.15 * len(frames) or sum(apart) - fit.total < 17 * np.log(used) / 2 + 12 + _SURE_MOVE * used:
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
    agrees_on_base: bool = True  # False: the detector marks another point than the robot's base

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
                    known = self._sure_axes(path, tool_axes(path, offset if self.turns else None))
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

    def _sure_axes(self, x_mm: np.ndarray, axes: np.ndarray) -> np.ndarray:
        """The axes (n, 3, 3) of tools at x_mm (n, 3, 3); NaN where tips too close to each other do not show the roll."""
        reported = np.einsum("nji,nj->ni", axes, x_mm[:, 2] - x_mm[:, 1])
        told = reported, reported + self.offset_mm[2] - self.offset_mm[1]
        sd_mm = np.sqrt(np.trace(self.offset_covariance_mm2[1:, 1:, 1:].sum(axis=0)) / 2)
        limit_mm = np.minimum(_OPEN * np.linalg.norm(x_mm[:, 1:].mean(axis=1) - x_mm[:, 0], axis=1), _OPEN_SDS * sd_mm)
        is_open = np.minimum(*(np.linalg.norm(apart[:, 1:], axis=1) for apart in told)) > limit_mm
        return np.where(is_open[:, None, None], axes, np.nan) if is_open.mean() > _OPEN_SHARE else axes

    def axes_px(self, frames: np.ndarray) -> np.ndarray:
        """The images (m, 2, 2, 3) px of the tool's axes in some frames, each axis as long as the tool."""
        return shown_axes(self.recording.landmarks_mm()[frames], self.calibration.cameras)

    def with_base(self, end: ShaftEnd | None) -> "Teacher":
        """The teacher whose base is moved along the shaft towards its measured end, and across to the middle of its sides.

        Label and measurement have the weights of their stated variances.  If they disagree along the shaft, the end is
        that of another edge, and the base stays; if they disagree across it, the base moves only along it.
        """
        if end is None:
            return self
        moved = self._with_moved_base(end.axis, end.along, end.sd, end)
        aside = None if moved is self else end.aside
        return moved if aside is None else moved._with_moved_base(aside.axis, aside.across, aside.sd, end)

    def _with_moved_base(self, axis: np.ndarray, step_px: np.ndarray, sd: float, end: ShaftEnd) -> "Teacher":
        """The teacher whose base is moved along an axis (3,) of the tool, whose images are `step_px` (m, 2, 2), or itself."""
        u, covariance = self.project(end.frame)
        step = step_px / (step_px**2).sum(axis=-1, keepdims=True)  # so that shifts are shares of the tool's length
        shift = np.nanmedian(((end.u - u[:, :, 0]) * step).sum(axis=-1))
        variance = np.nanmedian(np.einsum("msi,msij,msj->ms", step, covariance[:, :, 0], step))
        total = variance + sd**2
        if not abs(shift) < _ANOTHER_EDGE * np.sqrt(total):
            return self
        length_mm, offset, own = _length_mm(self.recording), self.offset_mm.copy(), self.offset_covariance_mm2.copy()
        offset[0] += variance / total * shift * length_mm * axis
        remaining = variance * sd**2 / total * length_mm**2
        own_along = own[0] @ axis
        if (before := own_along @ axis) > remaining:  # then it falls, as by a measurement
            own[0] -= (before - remaining) / before**2 * np.outer(own_along, own_along)
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
        RefusalError: If fewer than a tenth of the landmarks, or than 30, are inliers; a tip as detected agrees less than a
            tenth as often as another landmark; the inliers of a tip have a mean confidence below 0.5; the cameras
            are not those of a stereo microscope; a landmark is seen more than 15 % of the tool's length and 0.25 mm off; the
            standard deviation of its label exceeds `NEAR` of the tool's length; or the robot contradicts the images.
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
    recording, calibration, fault, clock_sd_s, right = aligned(recording, used, by_hand=alone)
    clicks = None if by_hand is None else by_hand.of(np.setdiff1d(by_hand.frame, refused))
    clicked = not alone and clicks is not None and len(clicks.frame) > 0
    rows = used.rows(recording)
    shares = _shares(rows, calibration.view_inliers)
    if opinion is None and before is None and by_hand is None:
        _check_tips(recording, rows, calibration, shares)
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
        own = 0.2 * OWN_BIAS if alone else own_bias(opinion or seen)
        offset, covariance = robots_part(offsets, own * length)
    elif before is not None:
        offset, covariance, turns = before.offset_mm, before.offset_covariance_mm2, before.turns
    # A base with few detections agrees, too.  Near the robot's report a detector may follow the robot: that says nothing new.
    agrees = not shares[0] < LEAST_RIGHT if before is None else before.agrees_on_base
    teacher = Teacher(recording, calibration, clock_sd_s, offset, covariance, refused, right, turns, agrees)
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
            f"robot: in {len(against)} of {len(used.frame)} frames the images show the whole tool, or both tips, elsewhere "
            "than the robot reports: a frozen log, another clock, a moved microscope, exchanged tips, or a tool that the "
            f"robot does not hold. If the log is right, the detector errs: {LABEL}"
        )
    return replace(teacher, refused=np.union1d(refused, against))


def _shares(rows: Correspondences, inliers: np.ndarray) -> np.ndarray:
    """(3,) share of inliers among the detections of each landmark, relative to the largest; NaN if it has few detections."""
    each = [rows.landmark == k for k in range(len(LANDMARKS))]
    seen = np.array([rows.seen[own].sum() for own in each])
    share = np.array([inliers[own].sum() for own in each]) / np.maximum(seen, 1)
    share[seen < _FEWEST_SEEN] = np.nan
    return share / max(np.nanmax(share, initial=0.0), 1e-9)


def _check_tips(recording: Recording, rows: Correspondences, calibration: Calibration, shares: np.ndarray) -> None:
    """A `RefusalError` if a tip as detected hardly ever agrees with the robot, or only where its confidence is low."""
    for k, tip in enumerate(LANDMARKS[1:], 1):  # the base has an end of its own, `Teacher.with_base`
        if shares[k] < LEAST_RIGHT:
            cause = likeliest_fault(recording, rows, None)
            what = f"{tip} is hardly ever detected where the robot reports it, but {LANDMARKS[np.nanargmax(shares)]} is."
            cure = f"Check the orientation of the tool and the order of the tips in its log. If these are right: {LABEL}"
            raise RefusalError(f"robot: {f'{cause.text} {cause.cure}' if cause else f'{what} {cure}'}")
        sure = rows.confidence[calibration.view_inliers & (rows.landmark == k)[:, None]]
        if len(sure) and sure.mean() < _LEAST_SURE:
            raise RefusalError(
                f"detector: it does not know this tool. What it takes for {tip} agrees with the robot, but its mean "
                f"confidence in that is {sure.mean():.2f}: it may be another point. {LABEL}"
            )


def _opinion(recording: Recording, opinion: Seen, frames: np.ndarray) -> LandmarkOffsets | None:
    """The offsets by later stages; a `RefusalError` if these hardly detect a landmark near where the robot reports it."""
    shares = (opinion.confidence >= MIN_CONFIDENCE).mean(axis=(0, 1))
    if shares.min() < LEAST_RIGHT * shares.max():
        rare, often = LANDMARKS[shares.argmin()], LANDMARKS[shares.argmax()]
        raise RefusalError(
            f"detector: near the robot's report it sees {rare} in {100 * shares.min():.0f} % of the images and {often} in "
            f"{100 * shares.max():.0f} %. It marks another point for {rare}. {LABEL}"
        )
    with suppress(*POOR):
        return placed(recording, opinion.of(frames)).offsets
    return None


def _length_mm(recording: Recording) -> float:
    """Median length of the tool, from its base to the middle of its tips."""
    x = recording.landmarks_mm()
    return float(np.nanmedian(np.linalg.norm(x[:, 1:].mean(axis=1) - x[:, 0], axis=1)))


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
    joint = calibration.joint_covariance.copy()
    joint[: len(names), : len(names)] += shift_sd**2 * chosen.T @ np.linalg.inv(information)[9:, 9:] @ chosen
    calibration = replace(calibration, minimum=minimum, joint_covariance=joint)
    return replace(teacher, calibration=calibration, offset_mm=offset, offset_covariance_mm2=own)


def _contradicted(teacher: Teacher, seen: Seen) -> np.ndarray:
    """The frames in which at least two landmarks are far from the robot's report by the same shift, in both images.

    Stretches with exchanged tips also count.  One image alone may show another object, which the detector takes for the tool.
    It only counts if it shows the tool where the robot reports it at another instant: then the two images do not belong
    together.
    """
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
    shifted = wrong[:, :, i] & wrong[:, :, j] & alike
    against = shifted.all(axis=1).any(axis=1)
    against |= _exchanged(u, seen)
    apart = wrong.sum(axis=2) > 1  # (m, 2)
    if (alone := apart.any(axis=1) & ~against).any():
        late = _from_other_instants(teacher, seen.of(seen.frame[alone])) < _LATE
        against[alone] = (apart[alone] & late).any(axis=1)
    return seen.frame[against]


def _exchanged(u: np.ndarray, seen: Seen) -> np.ndarray:
    """(m,) True in stretches of frames in which the tips are exchanged, either by the robot or by the detector.

    `u` (m, 2, 3, 2) px are the robot's landmarks.  Exchanges in single frames are errors of the detector, which labels mend.
    """
    tips, length = u[:, :, 1:], tool_length_px(u)[..., None]
    own, other = (np.linalg.norm(seen.u[:, :, 1:] - told, axis=-1) / length for told in (tips, tips[:, :, ::-1]))
    near = (seen.confidence[..., 1:] >= MIN_CONFIDENCE) & (np.minimum(own, other) < NEAR) & (np.abs(own - other) > NEAR / 2)
    votes, against = near.sum(axis=(1, 2)), (near & (other < own)).sum(axis=(1, 2))
    known = np.flatnonzero(votes >= 2)
    found = np.zeros(len(u), dtype=bool)
    for some in sliding_window_view(known, _STRETCH) if len(known) >= _STRETCH else ():
        if (against == votes)[some].all() and np.ptp(some) < _SPAN:
            found[some[0] : some[-1] + 1] = True
    return found


def _from_other_instants(teacher: Teacher, seen: Seen) -> np.ndarray:
    """(m, 2) distance (RMS) of the landmarks from the robot's at the nearest instant, as a share of the tool's length."""
    at = [replace(teacher.recording, offset_s=teacher.recording.offset_s + shift_s) for shift_s in _OTHER_S]
    u = np.stack([replace(teacher, recording=then).project(seen.frame)[0] for then in at])  # (t, m, 2, 3, 2)
    step, off = np.diff(u, axis=0), seen.u - u[:-1]
    share = np.nansum(off * step, axis=(3, 4)) / np.maximum(np.nansum(step**2, axis=(3, 4)), 1e-9)  # at the nearest point
    off = (off - np.clip(share, 0, 1)[..., None, None] * step) / tool_length_px(u[:-1])[..., None, None]
    r2 = (off**2).sum(axis=4)
    mean = np.nansum(r2, axis=3) / np.maximum(np.isfinite(r2).sum(axis=3), 1)
    return np.sqrt(np.where(np.isfinite(r2).any(axis=3), mean, np.inf).min(axis=0))
