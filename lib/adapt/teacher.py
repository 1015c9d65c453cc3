"""The robot's landmarks through calibrated cameras: where they are beside the robot's report, and how well that is known.

What the robot says is refused in frames that show the whole tool elsewhere, and altogether where most of them do.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from lib.adapt.cameras import LABEL, LEAST_RIGHT, RefusalError, align, frozen, placed
from lib.adapt.looking import NEAR, Seen
from lib.calibration import Calibration, LandmarkOffsets
from lib.calibration.offsets import carried, tool_axes
from lib.cameras import NearAffineCamera
from lib.correspondences import LANDMARKS, MIN_CONFIDENCE
from lib.landmarks.metrics import tool_length_px
from lib.recordings import Recording
from lib.recordings.annotations import CLICK_SD_PX, inside

#: Share of the frames in which the images may show the whole tool elsewhere than the robot.
_CONTRADICTED = 0.2
#: Standard deviation of a detector's own constant error, as a share of the tool's length: along, across, normal.  The base
#: has no edge that ends along the shaft.  Chosen by the closeups' errors in four recordings of unfamiliar tools and lights.
_OWN_BIAS = 0.004 * np.array([[2.5, 1.0, 1.5], [1.2, 1.0, 1.5], [1.2, 1.0, 1.5]])
_CLICKS_BIAS = 0.2  # that of labels set by hand, as a share of it
#: Largest offset of a landmark, as a share of the tool's length or in mm, whichever is more: what is farther is another point
#: of the tool.  A robot's own tool calibration errs by tenths of a millimetre, however short the tool is.
_LARGEST_OFFSET, _LARGEST_OFFSET_MM = 0.15, 0.25
#: Error of an offset, as a share of it, where shut jaws borrow the tool's axes from another time, farther away than this.
_TURNED, _BORROWED_S = 0.3, 0.1
_TURNS_S = 0.02  # between samples of the log that show how jaws turn; more are not worth their time
_ODD = 0.2  # share of a large offset that may be the detector's all the same: some tools it knows far worse than others
_BEHIND = 0.1  # distance from the camera, as a share of the working distance, below which nothing is in view
_OTHER_POINT = 0.3  # from a detector's point to the labelled one, standard deviation, as a share of the tool's length


@dataclass(frozen=True, eq=False)
class Teacher:
    """The robot's landmarks, seen through calibrated cameras.

    `offset_mm` and its deviation (3, 3), in the tool's axes, say where the landmarks are beside where the robot reports them.
    """

    recording: Recording  # with the clock's offset as the images show it
    calibration: Calibration
    clock_sd_s: float
    right: float  # share of the landmarks that agree on the cameras
    offset_mm: np.ndarray
    offset_sd_mm: np.ndarray
    refused: np.ndarray  # frames in which the robot is not believed
    turns: bool = False  # as `LandmarkOffsets.turns`

    def project(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (m, 2, 3, 2) of the robot's landmarks at the instants of their image rows, and covariances (m, 2, 3, 2, 2).

        NaN where the robot is silent.  The covariance is that of calibration, robot, clock and offset.
        """
        r, c, offset = self.recording, self.calibration, self.offset_mm
        time, height = np.repeat(r.frames.time_s[frames][:, None], 3, axis=1) + r.offset_s, r.image_size_px[1]
        log_s = r.kinematics.time_s
        log = slice(None, None, max(1, int(_TURNS_S * (len(log_s) - 1) / max(np.ptp(log_s), _TURNS_S))))
        u, covariance = np.full((len(frames), 2, 3, 2), np.nan), np.full((len(frames), 2, 3, 2, 2), np.nan)
        for side, camera in enumerate(c.cameras):
            at = time
            for _ in range(3 if r.readout_s else 1):
                x = r.kinematics.at(at)
                when_s = np.append(log_s[log], at[:, 0])  # the log shows how shut jaws were turned before
                order = np.argsort(when_s)
                told = np.concatenate([r.kinematics.x_mm[log], x])[order]
                known = tool_axes(told, offset if self.turns else None)
                axes = np.nan_to_num(carried(known, told, when_s[order])[np.argsort(order)[len(when_s) - len(at) :]])
                apart_s = np.abs(when_s[order][np.isfinite(known).all(axis=(1, 2))] - at[:, :1])
                shut = apart_s.min(axis=1, initial=np.inf) > _BORROWED_S
                x = x + np.einsum("mij,kj->mki", axes, offset)
                if isinstance(camera, NearAffineCamera):  # what the robot parks behind a camera is seen nowhere
                    x[camera.depth_ratio(x.reshape(-1, 3)).reshape(x.shape[:2]) < _BEHIND] = np.nan
                u[:, side] = camera.project(x.reshape(-1, 3)).reshape(x.shape[:2] + (2,))
                at = time + r.readout_s * np.nan_to_num(u[:, side, :, 1] / (height - 1) - 0.5).clip(-0.5, 0.5)
            flat, view = np.nan_to_num(x).reshape(-1, 3), slice(2 * side, 2 * side + 2)
            J = c.derivatives(flat)[0][:, view]
            velocity = (r.kinematics.at(at + 0.02) - r.kinematics.at(at - 0.02)).reshape(-1, 3) / 0.04
            moved = self.clock_sd_s * np.einsum("nij,nj->ni", J, np.nan_to_num(velocity))
            spread = np.einsum("mij,kj,mlj->mkil", axes, self.offset_sd_mm**2, axes).reshape(-1, 3, 3)
            spread += (_TURNED * shut[:, None] * np.linalg.norm(offset, axis=1)).reshape(-1, 1, 1) ** 2 * np.eye(3)
            spread = spread + max(r.robot_accuracy_mm, c.sigma_x_mm) ** 2 * np.eye(3)
            S = c.projection_covariance(flat)[:, view, view] + J @ spread @ J.mT + moved[:, :, None] * moved[:, None]
            covariance[:, side] = S.reshape(len(frames), 3, 2, 2)
        return u, np.where(np.isfinite(u)[..., None], covariance, np.nan)

    def labels(self, frames: np.ndarray, seen: Seen | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """u, covariance (as `project`) and visibility (m, 2, 3) of some frames; NaN where the robot is silent or refused.

        Outside the image a landmark is 0, absent.  It is 1, hidden, where `seen`, of a detector that knows the tool, finds
        the two others where they should be and this one not.
        """
        u, covariance = self.project(frames)
        u = np.where(np.isin(frames, self.refused)[:, None, None, None], np.nan, u)
        shown = np.where(inside(u, self.recording.image_size_px) | np.isnan(u[..., 0]), 2, 0)
        if seen is not None:
            part = seen.of(frames)
            length = tool_length_px(u)[..., None]
            right = (np.linalg.norm(part.u - u, axis=-1) < 0.05 * length) & (part.confidence >= MIN_CONFIDENCE)
            shown = np.where(~right & (right.sum(axis=2, keepdims=True) == 2) & (shown == 2), 1, shown)
        return u, covariance, shown


def teach(
    recording: Recording, seen: Seen | None, *, opinion: Seen | None = None, before: Teacher | None = None,
    by_hand: Seen | None = None,
) -> Teacher:  # fmt: skip
    """The robot as the teacher of what a detector has `seen` in the frames for learning.

    Args:
        seen: None where labels set by hand, of few frames, have to do.
        opinion: Of later stages that this robot never taught.  They tell the landmarks' offsets; None: `seen` does.
        before: The teacher of the round before: its clock is the start, and what it refused stays refused.
        by_hand: Labels set by hand.  They tell the offsets in place of detections, which may be of other points of the tool.

    Raises:
        RefusalError: If fewer than a tenth of the landmarks, or 30, agree on cameras, the cameras are no stereo microscope's,
            a landmark is seen more than 15 % of the tool's length and 0.25 mm off, its place stays open by more than 10 %, or
            the robot contradicts the images.
    """
    alone, seen = seen is None, by_hand if seen is None else seen
    refused = frozen(recording, seen.frame)
    if before is not None:
        recording, refused = before.recording, np.union1d(refused, before.refused)
    used = seen.of(np.setdiff1d(seen.frame, refused))
    if len(used.frame) < 5:
        raise RefusalError(f"kinematics: they stand still in {len(refused)} of {len(seen.frame)} frames; check the log.")
    aligned = align(recording, used, by_hand=alone)
    calibration, clicks = aligned.calibration, None if by_hand is None else by_hand.of(np.setdiff1d(by_hand.frame, refused))
    clicked = not alone and clicks is not None and len(clicks.frame) > 0
    told, turns = calibration.offsets, False
    offset, sd = np.zeros((3, 3)), np.full((3, 3), 0.0 if told is not None else 0.1)
    if opinion is not None and not clicked:
        told = _opinion(aligned.recording, opinion, used.frame)
    if told is not None and told.offset.shape == (3, 3):
        length = _length_mm(aligned.recording)
        if not (alone or clicked):
            _check_size(told, length)
        turns, (offset, sd) = told.turns, _robots_share(told, (_CLICKS_BIAS if alone else 1.0) * _OWN_BIAS * length)
    elif before is not None:
        offset, sd, turns = before.offset_mm, before.offset_sd_mm, before.turns
    teacher = Teacher(*aligned, offset_mm=offset, offset_sd_mm=sd, turns=turns, refused=refused)
    if clicked:
        teacher = _as_labelled(teacher, clicks)
    u, covariance = teacher.project(np.unique(np.linspace(0, len(recording) - 1, 200).astype(int)))
    share = np.nanmedian(np.sqrt(np.trace(covariance, axis1=-2, axis2=-1) / 2) / tool_length_px(u)[..., None])
    if share > NEAR:
        what = "labels" if alone else "detections"
        raise RefusalError(f"{what}: they tell a landmark's place to {100 * share:.0f} % of the tool's length only. {LABEL}")
    against = _contradicted(teacher, used)
    if len(against) > max(_CONTRADICTED * len(used.frame), 2):
        raise RefusalError(
            f"robot: in {len(against)} of {len(used.frame)} frames the images show the whole tool elsewhere than the robot "
            f"says: a frozen log, another clock, a moved microscope, or a tool that the robot does not hold."
        )
    return replace(teacher, refused=np.union1d(refused, against))


def _opinion(recording: Recording, opinion: Seen, frames: np.ndarray) -> LandmarkOffsets | None:
    """The offsets that later stages see; a `RefusalError` where they hardly see a landmark near where the robot says."""
    shares = (opinion.confidence >= MIN_CONFIDENCE).mean(axis=(0, 1))
    if shares.min() < LEAST_RIGHT * shares.max():
        rare, often = LANDMARKS[shares.argmin()], LANDMARKS[shares.argmax()]
        raise RefusalError(
            f"detector: where the robot says, it sees {rare} in {100 * shares.min():.0f} % of the images and {often} in "
            f"{100 * shares.max():.0f} %. It takes another point for {rare}. {LABEL}"
        )
    try:
        return placed(recording, opinion.of(frames)).offsets
    except ValueError:
        return None


def _length_mm(recording: Recording) -> float:
    """Of the tool, from its base to the middle of its tips."""
    x = recording.landmarks_mm()
    return float(np.nanmedian(np.linalg.norm(x[:, 1:].mean(axis=1) - x[:, 0], axis=1)))


def _check_size(told: LandmarkOffsets, length_mm: float) -> None:
    """A `RefusalError` where a landmark is seen too far from the robot's report to be the same point."""
    size_mm = np.linalg.norm(told.offset, axis=1)
    if size_mm.max() > max(_LARGEST_OFFSET * length_mm, _LARGEST_OFFSET_MM):
        raise RefusalError(
            f"detector: it sees {LANDMARKS[size_mm.argmax()]} {size_mm.max():.2f} mm from where the robot reports it, "
            f"{100 * size_mm.max() / length_mm:.0f} % of the tool's length. It takes another point for it, or the robot's "
            f"tool has other dimensions. {LABEL}"
        )


def _robots_share(found: LandmarkOffsets, own_sd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The part of the offsets (3, 3) that is the robot's, and its standard deviation; the rest is the detector's own.

    Both have Gaussian priors: the detector's of `own_sd` (3, 3) mm, the robot's of the width that makes the nine numbers most
    probable.  Offsets no larger than a detector's usual ones are taken for the detector's.
    """
    widths = np.append(0.0, np.geomspace(1e-3, 2.0, 80))[:, None, None]
    total = widths**2 + own_sd**2 + found.standard_deviation**2
    width = widths[(np.log(total) + found.offset**2 / total).sum(axis=(1, 2)).argmin(), 0, 0]
    # What the rig hides moves cameras and offsets together and leaves the labels where they are: no reason to believe less.
    share = width**2 / (width**2 + own_sd**2)
    return share * found.offset, np.hypot(np.sqrt(share) * own_sd, _ODD * share * found.offset)


def _as_labelled(teacher: Teacher, labels: Seen) -> Teacher:
    """The teacher with the offsets at which its cameras see the robot's landmarks where labels set by hand are."""
    free = teacher.calibration.offsets
    fitted = free is not None and free.offset.shape == (3, 3)
    teacher, start = replace(teacher, turns=fitted and free.turns), free.offset.ravel() if fitted else np.zeros(9)
    wide_mm = _OTHER_POINT * _length_mm(teacher.recording)

    def misfit(change: np.ndarray) -> np.ndarray:
        u = replace(teacher, offset_mm=(start + wide_mm * change).reshape(3, 3)).project(labels.frame)[0]
        return np.append(np.nan_to_num((u - labels.u) / CLICK_SD_PX), change)

    known = np.isfinite(labels.u)
    # A wild click counts little.
    found = least_squares(misfit, np.zeros(9), loss="soft_l1", f_scale=2.0, ftol=1e-4, xtol=1e-4)
    sd = wide_mm * np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)) * max(1.0, 2 * found.cost / known.sum()))
    told = known.any(axis=(0, 1, 3))[:, None]  # of other landmarks the labels say nothing
    parts = {"offset_mm": (start + wide_mm * found.x).reshape(3, 3), "offset_sd_mm": sd.reshape(3, 3)}
    return replace(teacher, **{name: np.where(told, part, getattr(teacher, name)) for name, part in parts.items()})


def _contradicted(teacher: Teacher, seen: Seen) -> np.ndarray:
    """Frames in which two landmarks and more are seen in both images, by one and the same distance off the robot's report."""
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
    both = wrong[:, :, i] & wrong[:, :, j] & alike
    return seen.frame[both.all(axis=1).any(axis=1)]
