"""Verdicts: whether the numbers of a recording can be trusted, why not, and what to do.  All thresholds are defined here."""

import shlex
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from jinja2 import Environment, FileSystemLoader, select_autoescape

from lib import paths
from lib.calibration import Calibration, CompetingCamerasError, NoConsensusError, calibrate, calibrate_as_shown, optics
from lib.calibration.checks import extents
from lib.calibration.offsets import shown_axes, with_offsets
from lib.correspondences import FEWEST_TO_TRAIN, LANDMARKS, TRAIN_FURTHER, Correspondences, DataError, NoDetectionError
from lib.landmarks import Detector, detect
from lib.landmarks.shaft import ShaftEnd, shaft_end
from lib.recordings import Doubt, Recording, Scene
from lib.recordings.annotations import inside
from lib.trust.clocks import PAIR_AGAIN
from lib.trust.diagnosis import AS_GOOD, UNFIT, Diagnosis, diagnose, stated
from lib.trust.fitting import SIDES
from lib.trust.footage import blurred, turned_images, with_footage
from lib.trust.health import Health, feature_matches, health, spread
from lib.trust.optics import SURE_CURVED

#: From best to worst.
LEVELS = ("trustworthy", "doubtful", "not trustworthy")
#: Check -> values at which a verdict becomes doubtful, and not trustworthy.
LIMITS: dict[str, tuple[float, float]] = {
    # RMS of residuals over their claimed sd.  Heavy tails (Student t, 4 degrees of freedom) reach 1.5; a clock 5 ms off 2.
    "residuals": (1.7, 2.6),
    # Cross-validated over fitted RMS, relative to the ratio that the leverages predict.  Clean data of 6 rows reach 1.6.
    "cross_validation": (2.0, 4.0),
    # Share of the usable detections that agree on the cameras: a bare majority may be the wrong one.
    "consensus": (0.75, 0.5),
    # Frames with inliers.  From 6 clean frames on the covariances are right; 3 frames leave nothing to check against.
    "frames": (6, 4),
    # Effective number of independent rows: a pair has 14 parameters, a row four numbers.  The estimate is low for few rows.
    "rows": (6, 0),
    # Degrees between the viewing directions: 2 to 20 in a microscope; beyond 45 both cameras cannot see the same scene.
    "convergence_low": (1.0, 0.3),
    "convergence_high": (25.0, 45.0),
    # Ratio of the two cameras' zooms, and of a camera's zooms along x and y: within one microscope a few per cent from 1.
    "zoom_ratio": (1.3, 2.0),
    "aspect": (1.08, 1.25),
    # Rotation of one image against the other, degrees.
    "roll": (30.0, 90.0),
    # One image is a mirror image (1) or not (0).
    "mirrored": (0.5, np.inf),
    # Standard deviations by which 1/distance is below 0, so that farther things look larger.
    "hollow": (SURE_CURVED, SURE_CURVED + 2.0),
    # Depth error of a landmark by the calibration over that by the detector, at the edge of the tool's volume.
    "coverage": (1.5, np.inf),
    # RMS thickness of the volume of positions over the robot's standard deviation: a thinner one may be noise.
    "thin": (4.0, 2.0),
    # The same for each landmark's own positions: RMS distance from their best line, and from their best plane.
    "one_line": (4.0, 4.0),
    "one_plane": (4.0, 0.0),
    # Median epipolar distance of free matches, px, minus three of its standard deviations: band matching fails from 6 px.
    "epipolar": (1.5, 4.0),
    # Share of bad landmarks (`Health.unhealthy`).  10 % of gross errors in each image give 0.2.
    "health": (0.25, 0.5),
    # Distance of the detected base from the end of the shaft, as a share of the tool's length, less its standard deviation.
    # On tools that the detector knows it is up to 0.01, and twice that where the images show the end poorly.
    "base": (0.025, np.inf),
    # Share of the residuals' variance that a named fault explains.
    "diagnosis": (0.0, 0.5),
}  # fmt: skip
#: Pixel noise that is assumed if the detections state none: that of labels set by hand.
_LABEL_PX = 3.0
#: Cameras have not moved if landmarks shift by more than `_NEARER_PX` plus `_TIMES` the shift of the scene, px: the tool is
#: nearer than the scene, but not by that much.  A scene that shifts by more than `_MOVED_PX` does not stand still.
_NEARER_PX, _TIMES, _MOVED_PX = 1.0, 2.0, 5.0
_WATCHED = 5  # frames in which the scene is compared if the robot seems to wander
_SHAFT_FRAMES = 24  # frames in which the end of the shaft is measured
#: Least share of the images with a landmark, by robot and cameras, in which the detector finds it; and fewest such images.
_LEAST_FOUND, _FEWEST_SHOWN = 0.5, 16
LOG_DOUBTS = ("repeated_samples", "bursts")  # doubts about the times of the log, and the named faults that they explain
_BY_LOG = ("clock", "time_stamps", "robot_noise", "robot_wanders", "smoothed_log", "odd_pixels")
#: Causes of which a refused calibration says less, or something else.
_KNOWS_BETTER = (
    "mirrored_axis", "exchanged_eyes", "turned_image", "turned_images", "mirrored_images", "mixed_units", "same_images",
)  # fmt: skip
OF_DETECTOR = ("detector_unfit", "one_eye_unfit", "bad_landmark", "bad_stretch")  # causes that may be the detector's
_CHECK = "`python3 -m lib check RECORDING`"
_MORE_FRAMES = "Record more frames, with the tool in other places."
_OVERLAYS = f"Look at the overlays of {_CHECK}"
#: The templates of this folder, compiled once.
TEMPLATES = Environment(loader=FileSystemLoader(Path(__file__).parent), autoescape=select_autoescape(), trim_blocks=True)


@dataclass(frozen=True)
class Reason:
    """One reason for doubt about a calibration: the level it leads to, the number and its limit, and what to do."""

    name: str
    level: str
    text: str
    cure: str

    def __post_init__(self) -> None:
        if self.level not in LEVELS[1:]:
            raise ValueError(f"level: expected one of {LEVELS[1:]}, got {self.level!r}.")


@dataclass(frozen=True)
class Verdict:
    """A verdict and its reasons: the level is that of the worst reason, and trustworthy without any.

    >>> verdict = Verdict((Reason("few_frames", "doubtful", "5 frames; 6 or more are needed.", "Record more."),))
    >>> verdict.level, Verdict.join([verdict, Verdict()]).level, Verdict().level
    ('doubtful', 'doubtful', 'trustworthy')
    """

    reasons: tuple[Reason, ...] = ()

    @property
    def level(self) -> str:
        """One of `LEVELS`."""
        return max((reason.level for reason in self.reasons), key=LEVELS.index, default=LEVELS[0])

    @property
    def is_red(self) -> bool:
        """True if no number that follows from the calibration should be stated."""
        return self.level == LEVELS[2]

    @classmethod
    def join(cls, parts: Iterable[Self]) -> Self:
        """The reasons of several verdicts, the worst first; of those with equal name and level only the first is kept."""
        found = {(reason.name, reason.level): reason for part in reversed(list(parts)) for reason in reversed(part.reasons)}
        return cls(tuple(sorted(reversed(found.values()), key=lambda reason: -LEVELS.index(reason.level))))

    def to_json(self) -> dict:
        """The verdict as in check.json and metrics.json."""
        return {"verdict": self.level, "reasons": [vars(reason).copy() for reason in self.reasons]}

    def __str__(self) -> str:
        return "\n".join([f"Verdict: {self.level}", *(f"  {r.level}: {r.name}: {r.text} {r.cure}" for r in self.reasons)])


def judge(
    data: Correspondences | None, calibration: Calibration | None, *, diagnosis: Diagnosis | None = None,
    health: Health | None = None, epipolar_px: float | None = None, robot_accuracy_mm: float = 0.010,
    error: Exception | None = None, doubts: Sequence[Doubt] = (), epipolar_at_mm: np.ndarray | None = None,
    shaft: ShaftEnd | None = None,
) -> Verdict:  # fmt: skip
    """The verdict on a calibration, from its own numbers and from independent evidence; arguments that are None are skipped.

    Args:
        data: The calibrated rows; needed for the checks of frames, and of each landmark's motion.
        calibration: None if it was refused; then `error` is the exception.
        epipolar_px: Median epipolar distance of features matched between the two images, independent of the tool.
        epipolar_at_mm: (k, 3) positions of these features by the calibration; None assumes that they are near the tool.
        robot_accuracy_mm: Standard deviation of the robot's position per coordinate, as the manufacturer states it.
        doubts: Those of the recording (`lib.recordings.Recording.doubts`) and of its images (`lib.trust.footage.blurred`).
        shaft: Where the shaft ends in the aligned images, measured from the detected base.
    """
    found: list[Reason] = []
    best = None if diagnosis is None else diagnosis.best
    if best is not None:
        text = best.text
        if best.evidence is not None and best.name != "landmark_offset":
            text += f" It explains {100 * best.explained:.0f} % of the residuals."
        by_log = [doubt.cure for doubt in doubts if doubt.name in LOG_DOUBTS and best.name in _BY_LOG]
        found += _reason("diagnosis", best.explained, text, (by_log or [best.cure])[0], best.name)
    if calibration is None:
        errs = (best and best.name in OF_DETECTOR) or (health and health.unhealthy > LIMITS["health"][0])
        competing = "no_consensus" if errs else "refused"  # wrong detections may agree with each other
        kinds = {NoDetectionError: "no_detection", CompetingCamerasError: competing, NoConsensusError: "no_consensus"}
        name = next((name for kind, name in kinds.items() if isinstance(error, kind)), "refused")
        cure = f"{_OVERLAYS}; where the detector errs, {TRAIN_FURTHER}."
        if name == "refused" or (name == "no_detection" and data is not None and data.is_by_hand):  # the error names its cure
            few = data is not None and len(np.unique(data.frame)) < LIMITS["frames"][1]
            cure = _MORE_FRAMES if few else "Correct that, then check again."
        text = f"There is no calibration: {error}"
        if best is not None and best.name in _KNOWS_BETTER:
            text, cure = "There is no calibration.", "Correct what the diagnosis names, then check again."
        found.append(Reason(name, LEVELS[2], text, cure))
    else:
        what = data, calibration, robot_accuracy_mm
        for finding in (*_residuals(*what), *_geometry(*what)):
            found += _reason(*finding)
        if epipolar_px is not None and np.isfinite(epipolar_px):
            n, at_mm = calibration.pair.epipolar_normal, calibration.x_mm[calibration.inliers].mean(axis=0)[None]
            at_mm = at_mm if epipolar_at_mm is None else epipolar_at_mm
            sd = np.sqrt(np.median(n @ calibration.projection_covariance(at_mm) @ n))
            text = f"Features of both images lie {epipolar_px:.1f} px (median) off the epipolar lines; "
            text += f"{LIMITS['epipolar'][0]:g} are allowed."
            cure = "Did a camera move, or were left and right not taken at the same instant? Calibrate again."
            found += _reason("epipolar", max(epipolar_px - 3.0 * sd, 0.0), text, cure)
    if health is not None:
        if best is not None and best.name not in OF_DETECTOR:
            health = health.beside(best)
        text = health.text + f" (most often: {health.worst_part})" * bool(health.seen.any()) + "."
        cure = f"The detector may not know this tool or light. {_OVERLAYS}, then {TRAIN_FURTHER}."
        found += _reason("health", health.unhealthy, text, cure, "detector_unfit")
    if shaft is not None:
        side = "behind" if shaft.moved > 0 else "beyond"
        text = f"The detector marks the base {100 * abs(shaft.moved):.1f} % of the tool's length {side} the end of the shaft."
        cure = f"It may not know this tool. {_OVERLAYS}, then {TRAIN_FURTHER}."
        found += _reason("base", abs(shaft.moved) - shaft.sd, text, cure)
    found += [Reason(doubt.name, LEVELS[1], doubt.text, doubt.cure) for doubt in doubts]
    return Verdict.join([Verdict(tuple(found))])


def _reason(check: str, value: float, text: str, cure: str, name: str = "") -> list[Reason]:
    """One reason if the value is beyond a limit, else none; low values are bad if the red limit is not higher."""
    doubtful, red = LIMITS[check]
    sign = 1.0 if red > doubtful else -1.0
    if not sign * value > sign * doubtful:
        return []
    return [Reason(name or check, LEVELS[2] if sign * value > sign * red else LEVELS[1], text, cure)]


def _residuals(data: Correspondences | None, c: Calibration, robot_mm: float) -> Iterator[tuple]:
    """Arguments of `_reason`: the size of the residuals, and the number of rows and frames that agree."""
    used, views = c.inliers, c.view_inliers[c.inliers]
    variance = np.full((1, 2 * views.shape[1]), _LABEL_PX**2)
    if c.covariance_px2 is not None:
        rows = c.covariance_px2 if len(c.covariance_px2) == 1 else c.covariance_px2[used]
        variance = np.diagonal(rows, axis1=1, axis2=2) / c.detector_scale**2
    gain = [(camera.jacobian(c.x_mm[used][:1]) ** 2).sum() for camera in c.cameras]
    r2, claim2 = (v.reshape(len(v), -1, 2).sum(axis=2) for v in (c.residuals_px[used] ** 2, variance))
    ratio = float(np.sqrt((r2 / (claim2 + np.multiply(gain, robot_mm**2)))[views].mean()))
    text = f"The residuals, {c.reprojection_rms_px:.1f} px RMS, are {ratio:.1f} times as large as detector and robot claim."
    more = " Landmark offsets were not fitted: this needs open jaws in four frames, and in half of all." * (c.offsets is None)
    yield "residuals", ratio, text, f"Read the diagnosis of {_CHECK}: clock, axes, order of tips, detector.{more}"

    # With clean data, the residual of a row that is left out grows by the factor (1 - leverage)^-1/2.
    m = c.leverage.shape[1]
    expected = np.sqrt(np.mean(np.trace(np.linalg.inv(np.eye(m) - c.leverage), axis1=1, axis2=2) / m))
    ratio = c.press_rms_px / max(c.reprojection_rms_px * expected**2, 1e-9)
    text = f"RMS errors: {c.press_rms_px:.3g} px of rows left out of the fit, {c.reprojection_rms_px:.3g} px of fitted ones."
    yield "cross_validation", ratio, text, "A few rows decide everything: move the tool through the whole volume."

    usable = int(np.isfinite(c.residuals_px).sum()) // 2
    share = float(c.view_inliers.sum() / usable)
    text = f"Only {100 * share:.0f} % of the {usable} detections agree on the cameras."
    yield "consensus", share, text, f"{_OVERLAYS}: either the other detections are wrong, or these are.", "minority"

    text = f"The rows that agree are worth {c.effective_rows:.1f} with independent errors; {LIMITS['rows'][0]:g} are needed."
    yield "rows", c.effective_rows + 1e-9, text, _MORE_FRAMES, "few_rows"
    if data is not None:
        frames = len(np.unique(data.frame[used]))
        text = f"{frames} frames have landmarks that agree; {LIMITS['frames'][0]:g} are needed, 30 are good."
        yield "frames", frames + 1e-9, text, _MORE_FRAMES, "few_frames"


def _geometry(data: Correspondences | None, c: Calibration, robot_mm: float) -> Iterator[tuple]:
    """Arguments of `_reason`: how the tool moved, the optics that the cameras imply, and the volume that the tool covered."""
    x = c.x_mm[c.inliers]
    if data is not None and np.ptp(landmark := data.landmark[c.inliers]):
        own = extents(np.concatenate([x[landmark == k] - x[landmark == k].mean(axis=0) for k in np.unique(landmark)]))
        shape, size_mm = ("line", own[1]) if own[1] < LIMITS["one_line"][0] * robot_mm else ("plane", own[2])
        text = f"Each landmark stays within {size_mm:.3f} mm (RMS) of one {shape}. Across it the calibration relies on the "
        text += "tool's shape as the robot reports it, which may be wrong."
        yield f"one_{shape}", size_mm / robot_mm, text, "Move the tool in all three directions, and turn it."
        if shape == "line":  # the optics would rely on the tool's shape, too
            return
    zooms, name = np.array([np.diag(camera.resect().K) for camera in c.cameras]), "implausible_optics"
    cure = "Check axes and units of the kinematics, the order of the tips, and which image is left."
    aspect = float(np.exp(np.abs(np.log(zooms[:, 0] / zooms[:, 1])).max()))
    text = f"A camera's zoom differs by a factor of {aspect:.2f} between x and y; pixels are square within a few per cent."
    undo = f"undo that, or import with {np.exp(np.log(zooms[:, 1] / zooms[:, 0]).mean()):.2f} times the present pixel_aspect"
    yield "aspect", aspect, text, f"If the images were resized to another shape, {undo}. Otherwise: {cure}", name
    if c.rig is None:
        return
    ratio = float(np.exp(np.abs(np.diff(np.log(zooms).mean(axis=1)))[0]))
    unless = f"{cure} If the cameras are built so, nothing is wrong."
    yield "zoom_ratio", ratio, f"One camera's zoom is {ratio:.2f} times the other's.", unless, name
    angle = np.rad2deg(c.rig.convergence_rad)
    text = f"The cameras converge by {min(angle, 180 - angle):.1f} degrees; a stereo microscope's by 2 to 20."
    yield "convergence_high", min(angle, 180 - angle), text, unless, name
    if angle < 90:
        yield "convergence_low", angle, text, "Are left and right two different cameras?", name
    mirrored, roll = optics(c).mirrored, np.rad2deg(optics(c).roll_rad)
    text = f"The images are rotated by {abs(roll):.0f} degrees against each other."
    cure = "Rotate one of them back: surfaces cannot be matched otherwise."
    if back := round(-roll / 90) * 90 % 360:
        cure += f" Import again, with video.rotate_right = {back} in the mapping if the right image is the turned one,"
        cure += f" or with video.rotate_left = {-back % 360} if the left one is."
    if mirrored not in ("left", "right", "left or right"):  # a mirror image looks rotated, too
        yield "roll", abs(roll), text, cure, "turned_image"
    text, cure = f"One image is a mirror image ({mirrored}).", "Flip that image when recording."
    yield "mirrored", mirrored in ("left", "right", "left or right"), text, cure
    nearness, sd = c.inverse_distance_per_mm
    text = "Farther things look larger: both images are mirrored, or a left-handed robot frame goes with exchanged eyes."
    cure = "Flip both images, or use a right-handed robot frame and exchange left and right."
    yield "hollow", -nearness / sd if sd > 0 else 0.0, text, cure, "mirrored_images"

    errs_mm = max(robot_mm, c.sigma_x_mm)
    text = f"The positions lie only {c.extents_mm[2]:.3f} mm (RMS) out of one plane; the robot errs by {errs_mm:.3f} mm."
    yield "thin", c.extents_mm[2] / errs_mm, text, "Move the tool along the view as well, and record more frames."
    along = np.linalg.svd(x - x.mean(axis=0))[2]
    low, high = np.percentile((x - x.mean(axis=0)) @ along.T, [5, 95], axis=0)
    corners = x.mean(axis=0) + np.stack(np.meshgrid(*np.stack([low, high]).T), axis=-1).reshape(-1, 3) @ along
    own_px2 = np.nanmedian(np.diagonal(_noise_px2(c), axis1=1, axis2=2))  # a few uncertain detections dominate a mean
    alone, both = (c.depth_sd_mm(corners, detection=noise).max() for noise in (False, own_px2 * np.eye(c.y_px.shape[1])))
    sizes = " x ".join(f"{value:.1f}" for value in high - low)
    text = f"The tool covers {sizes} mm: at its corners the calibration alone has a depth error of {1e3 * alone:.0f} um (sd)."
    cure = "Move the tool through more depths and corners; notebook 03 finds the most informative positions."
    yield "coverage", float(alone / np.sqrt(max(both**2 - alone**2, 1e-12))), text, cure


def _noise_px2(c: Calibration) -> np.ndarray:
    """(inliers, m, m) px^2: covariances of the detections of a calibration, NaN where not seen; or one for all (1, m, m)."""
    return c.noise_px2[None] if c.covariance_px2 is None else (c.covariance_px2 + 0 * c.y_px[:, :, None])[c.inliers]


@dataclass(frozen=True, eq=False)
class Assessment:
    """The result of `assess`; `calibration` is None if it was refused, and the verdict says why.

    `epipolar_px` is the median epipolar distance of features that both images show; NaN if there are too few.  `shaft` is the
    end of the shaft as the images show it; None if they do not show it clearly, without a detector, or if the robot errs.
    """

    data: Correspondences
    calibration: Calibration | None
    verdict: Verdict
    diagnosis: Diagnosis
    health: Health
    epipolar_px: float = np.nan
    shaft: ShaftEnd | None = None


def assess(
    recording: Recording, data: Correspondences | None = None, *, detector: Callable | None = None, **options: object
) -> Assessment:  # fmt: skip
    """Calibrate, diagnose, test the detector's health and the epipolar lines, and judge; a refused calibration is a reason.

    Args:
        data: Correspondences of the recording, detected or labelled; None runs the detector (by default that which ships).
        detector: The one that made `data`.  It is run again on some frames, mirrored and shifted.
        options: Of `lib.calibration.calibrate`.  Without `model` cameras are affine, or near-affine if a distance shows.

    Raises ValueError if `data` has frames that the recording lacks.
    """
    if data is None:
        detector = detector or Detector.load()
        data = detect(recording, detector)
    if (last := data.frame.max(initial=0)) >= len(recording):
        raise ValueError(f"data: frame {last} is not among the {len(recording)} of {recording.folder}; give data of these.")
    calibration, error, epipolar_px, at_mm = None, None, np.nan, None
    try:
        fit = calibrate if "model" in options else calibrate_as_shown
        calibration = fit(data, image_size_px=recording.image_size_px, **options)
    except np.linalg.LinAlgError:
        error = DataError("the fit diverges; no cameras explain these rows. Check times, axes and units of kinematics.csv.")
    except ValueError as refused:
        error = refused
    if calibration is not None and len(y := feature_matches(recording, spread(len(recording), 3))):
        features = calibration.pair.triangulate(y[:, :2], y[:, 2:])
        known = np.isfinite(features.x_mm).all(axis=1)
        epipolar_px, at_mm = float(np.median(np.abs(features.epipolar_px))), features.x_mm[known] if known.any() else None
    missed, straight, near = [], data, fit is calibrate_as_shown  # it would have found a distance itself
    if calibration is not None:
        (left, right), near = calibration.cameras, calibration.inverse_distance_per_mm[1] > 0
        if near:  # then lens distortion is no fault either, and positions behind a camera are not visible
            behind = (left.depth_ratio(data.x_mm) <= 0) | (right.depth_ratio(data.x_mm) <= 0)
            data = replace(data, x_mm=np.where(behind[:, None], np.nan, data.x_mm))
        missed = _missed(data, calibration, recording.image_size_px)
        straight = data = _in_view(data, calibration, recording.image_size_px)
        if near:
            straight = replace(data, u_left=left.undistort(data.u_left), u_right=right.undistort(data.u_right))
    diagnosis = diagnose(straight, near=near, offsets=calibration and calibration.offsets, **stated(recording))
    diagnosis = with_footage(with_scene(diagnosis, recording, data.frame), recording, data)
    if turned := turned_images(recording, np.unique(data.frame)):  # they look like many causes, and none of these matters
        diagnosis = Diagnosis((turned,))
    found = health(recording, data, calibration, detector=detector)
    shaft, best = None, diagnosis.best
    if detector is not None and calibration is not None and (best is None or best.name in ("landmark_offset", *OF_DETECTOR)):
        shaft = _shaft(recording, data, calibration)  # faults of the robot would blur the aligned images
    verdict = judge(
        data, calibration, diagnosis=diagnosis, health=found, epipolar_px=epipolar_px, error=error,
        robot_accuracy_mm=recording.robot_accuracy_mm, epipolar_at_mm=at_mm, shaft=shaft,
        doubts=[*recording.doubts, *blurred(recording, np.unique(data.frame)), *missed],
    )  # fmt: skip
    reasons, where = verdict.reasons, shlex.quote(paths.shown(recording.folder))  # in the commands that cures name
    if len(recording) < FEWEST_TO_TRAIN:  # `adapt` would refuse them
        longer = f"record {FEWEST_TO_TRAIN} frames or more, then {TRAIN_FURTHER}"
        reasons = [replace(r, cure=r.cure.replace(TRAIN_FURTHER, longer)) for r in reasons]
    if data.is_by_hand:
        odd = ", ".join(map(str, found.frame[found.bad.any(axis=1)][:12]))
        cure = f"Look again at the labels{', first those of frames ' * bool(odd)}{odd}: `python3 -m lib annotate RECORDING`."
        by_labels = ("detector_unfit", "one_eye_unfit", "minority", "no_consensus")  # the reasons that wrong labels cause
        mended = [r.cure.replace(UNFIT, cure) if UNFIT in r.cure else cure for r in reasons]
        reasons = [replace(r, cure=m) if r.name in by_labels else r for r, m in zip(reasons, mended, strict=True)]
    reasons = [replace(r, **{k: getattr(r, k).replace("RECORDING", where) for k in ("text", "cure")}) for r in reasons]
    return Assessment(data, calibration, Verdict(tuple(reasons)), diagnosis, found, epipolar_px, shaft)


def _missed(data: Correspondences, c: Calibration, size_px: tuple[int, int]) -> list[Doubt]:
    """The doubt that the detector finds a landmark in few of the images in which robot and cameras place it."""
    shown = inside(np.stack(c.pair.project(data.x_mm), axis=1), size_px)
    each = [shown & (data.landmark == k)[:, None] for k in range(len(LANDMARKS))]
    found = np.array([data.seen[own].mean() if own.sum() >= _FEWEST_SHOWN else 1.0 for own in each])
    if data.is_by_hand or found.min() >= _LEAST_FOUND:
        return []
    what = f"{LANDMARKS[found.argmin()]} in only {100 * found.min():.0f} % of the images that should show it"
    return [Doubt("missed", f"The detector finds {what}.", f"It may not know this tool. {_OVERLAYS}, then {TRAIN_FURTHER}.")]


def _in_view(data: Correspondences, c: Calibration, size_px: tuple[int, int]) -> Correspondences:
    """The calibrated `data` without outliers in images that do not show the robot's tool: something else was found there."""
    told_px = np.stack(c.pair.project(data.x_mm), axis=1)
    outside = ((told_px < 0) | (told_px > np.array(size_px) - 1)).any(axis=2) & ~c.view_inliers
    left, right = (np.where(away[:, None], np.nan, u) for away, u in zip(outside.T, (data.u_left, data.u_right), strict=True))
    return replace(data, u_left=left, u_right=right)


def with_scene(diagnosis: Diagnosis, recording: Recording, frames: np.ndarray) -> Diagnosis:
    """The diagnosis of some frames, corrected by the scene behind the tool: if it stands still, so do the cameras."""
    best = diagnosis.best
    if best is None or best.name not in ("camera_moved", "tool_slipped", "drift", "robot_wanders"):
        return diagnosis
    frames = np.unique(frames)
    pairs = (recording.frames[int(i)] for i in frames[spread(len(frames), _WATCHED if best.name == "robot_wanders" else 2)])
    first, *later = (Scene.of(pair.left, pair.right) for pair in pairs)
    moved_px = np.max([first.moved_px(scene) for scene in later], axis=0)[list(best.images)]  # NaN decides nothing
    others = [h for h in diagnosis.hypotheses if h.name != best.name]
    moves = (moved_px > _MOVED_PX).all()
    if best.name == "robot_wanders":
        does = "moves, too: eye or microscope move, or images are stabilised" if moves else "stands still: robot or tool err"
        found = replace(best, text=f"{best.text} The scene behind the tool {does}.")
        return Diagnosis((found, *others)) if moves or (moved_px <= _MOVED_PX).all() else diagnosis
    if best.name == "tool_slipped":
        return Diagnosis(tuple(others)) if moves else diagnosis
    if not ((best.value > _NEARER_PX + _TIMES * moved_px) & (moved_px < _MOVED_PX)).all():  # a turned image moves far
        return diagnosis
    if best.name == "drift":
        text = f"Images and robot disagree more and more, by {best.value:.1f} px from the first frame to the last."
        text += " The scene behind the tool stands still: the robot drifts, or the detector's error depends on the pose."
        cure = f"{_OVERLAYS}. If landmarks are marked beside the tool, {TRAIN_FURTHER}; else look for slack in the robot."
        if np.ptp(frames) + 1 < len(recording):
            cure = f"Check all frames first: a drift goes on, an error that depends on the pose comes and goes. {cure}"
        return Diagnosis((replace(best, name="robot_drifts", text=text, cure=cure), *others))
    when = best.text[best.text.index(" at about frame") :]
    if len(best.images) == 1:  # the other image and the robot agree
        text = f"The {SIDES[best.images[0]]} images disagree with the robot{when.replace(' at', ' from', 1)}"
        text += " The scene behind the tool stands still, so they belong to other instants, or the detector errs in them."
        return Diagnosis((replace(best, name="frame_order", text=text, cure=PAIR_AGAIN), *others))
    jump = min((h for h in diagnosis.hypotheses if h.name == best.name), key=lambda h: h.evidence[2])  # of fewest parameters
    slip = next((h for h in others if h.name == "tool_slipped"), None)
    if slip and slip.evidence[0] > jump.evidence[0] - AS_GOOD:
        return Diagnosis((replace(slip, gain=best.gain), *(h for h in others if h is not slip)))
    text = f"Images and robot disagree{when} The scene behind the tool stands still, so the robot's report jumped."
    return Diagnosis((replace(best, name="robot_jumped", text=text, cure=best.cure.split(". ")[0] + "."), *others))


def _shaft(recording: Recording, data: Correspondences, calibration: Calibration) -> ShaftEnd | None:
    """The end of the shaft, in frames that are aligned where the detector sees the landmarks on average."""
    frames = np.unique(data.frame)
    frames = frames[spread(len(frames), _SHAFT_FRAMES)]
    if recording.skeleton != LANDMARKS or calibration.rig is None:
        return None
    x = with_offsets(data, calibration.offsets).of_frames(frames).grid("x_mm")
    base = np.stack(calibration.pair.project(x[:, 0]), axis=1)
    return shaft_end(recording, frames, base, shown_axes(x, calibration.cameras))


def report(
    calibration: Calibration, *, verdict: Verdict | None = None, robot_accuracy_mm: float = 0.010,
    data: Correspondences | None = None,
) -> str:  # fmt: skip
    """A calibration as several lines of text, with at most ten outliers, largest residual first.

    Without the verdict of `lib.trust.assess`, only the calibration's own numbers are judged.  With the calibrated `data`,
    outliers have their frame and landmark, else the number of their row.
    """
    verdict = judge(None, calibration, robot_accuracy_mm=robot_accuracy_mm) if verdict is None else verdict
    c, stereo = calibration, {}
    seen = np.isfinite(c.residuals_px[:, ::2])
    outliers = np.argwhere(seen & ~c.view_inliers)
    size_px = np.linalg.norm(c.residuals_px.reshape(*seen.shape, 2)[tuple(outliers.T)], axis=1)
    if c.rig is not None:
        depths = (c.depth_sd_mm(c.x_mm[c.inliers], detection=detection) for detection in (False, _noise_px2(c)))
        stereo = {"optics": optics(c), "depth_um": [1e3 * np.nanmedian(depth) for depth in depths], "degrees": np.rad2deg}
    return TEMPLATES.get_template("report.txt").render(
        stereo, c=c, verdict=verdict, detections=seen.sum(), outliers=len(outliers), landmarks=LANDMARKS,
        worst=[(*outliers[i], size_px[i]) for i in np.argsort(-size_px)[:10]], data=data,
    ).rstrip()  # fmt: skip
