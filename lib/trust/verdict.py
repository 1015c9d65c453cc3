"""Verdicts: may a number of this recording be believed, why not, and what to do (all thresholds stand here)."""

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
from lib.correspondences import LANDMARKS, TRAIN_FURTHER, Correspondences, DataError, NoDetectionError
from lib.landmarks import Detector, detect
from lib.recordings import Doubt, Recording, Scene
from lib.trust.diagnosis import Diagnosis, diagnose, stated
from lib.trust.health import Health, feature_matches, health, spread
from lib.trust.optics import SURE_CURVED

#: From best to worst.
LEVELS = ("trustworthy", "doubtful", "not trustworthy")
#: Check -> values at which a verdict becomes doubtful, and not trustworthy.
LIMITS: dict[str, tuple[float, float]] = {
    # RMS of the residuals, each over its claim.  Heavy tails (Student t, 4 degrees) reach 1.5; a clock 5 ms off 2.
    "residuals": (1.7, 2.6),
    # Cross-validated over fitted RMS, beyond what the leverages let expect.  Clean data of 6 rows reach 1.6.
    "cross_validation": (2.0, 4.0),
    # Share of the usable rows that agree on the cameras: a bare majority may be the wrong one.
    "consensus": (0.75, 0.5),
    # Frames with rows that agree.  Of 6 clean frames on the covariances are right; of 3 nothing checks anything.
    "frames": (6, 4),
    # Rows of independent errors: a pair has 14 parameters, four numbers a row.  Their estimate is too low where rows are few.
    "rows": (6, 0),
    # Degrees between the viewing directions: a microscope's are 2 to 20 apart; beyond 45 no two of its eyes see one scene.
    "convergence_low": (1.0, 0.3),
    "convergence_high": (25.0, 45.0),
    # Zoom of one camera over the other's, and along x over along y: optics of one microscope differ by some per cent.
    "zoom_ratio": (1.3, 2.0),
    "aspect": (1.08, 1.25),
    # Degrees by which one image is turned against the other.
    "roll": (30.0, 90.0),
    # One image is a mirror image (1) or not (0).
    "mirrored": (0.5, np.inf),
    # Standard deviations of 1/distance below 0, as which farther things look larger.
    "hollow": (SURE_CURVED, SURE_CURVED + 2.0),
    # Standard deviations of a landmark's depth that the calibration adds to the detector's, at the edge of its own volume.
    "coverage": (1.5, np.inf),
    # RMS thickness of the tool's positions in standard deviations of the robot's: what is thinner may be its noise.
    "thin": (4.0, 2.0),
    # The same of each landmark's own positions, across the line or out of the plane that they lie nearest to.
    "one_line": (4.0, 4.0),
    "one_plane": (4.0, 0.0),
    # Median epipolar distance of free matches, px, beyond three of its standard deviations: band matching fails from 6 px.
    "epipolar": (1.5, 4.0),
    # Share of the landmarks that contradict themselves, the other image or the robot.  10 % gross errors a view reach 0.2.
    "health": (0.25, 0.5),
    # Share of the residuals' variance that a named fault explains.
    "diagnosis": (0.0, 0.5),
}  # fmt: skip
#: Pixel noise assumed where the detections claim none: that of labels set by hand.
_LABEL_PX = 3.0
#: A scene contradicts cameras by which landmarks move more than this, px, and so many times as far as the scene: the tool is
#: nearer, but not by that much.  A scene that moved farther than the third contradicts a tool that slipped.
_NEARER_PX, _TIMES, _MOVED_PX = 1.0, 3.0, 5.0
OF_DETECTOR = ("detector_unfit", "bad_landmark", "bad_stretch")  # causes that may be the detector's
_CHECK = "`python3 -m lib check RECORDING`"
_MORE_FRAMES = "Record more frames, with the tool in other places."
_OVERLAYS = f"Look at the overlays of {_CHECK}"
#: The texts and the page of this folder, compiled once.
TEMPLATES = Environment(loader=FileSystemLoader(Path(__file__).parent), autoescape=select_autoescape(), trim_blocks=True)


@dataclass(frozen=True)
class Reason:
    """One finding against a calibration: what it makes of the verdict, the number and its limit, and what to do."""

    name: str
    level: str
    text: str
    cure: str

    def __post_init__(self) -> None:
        if self.level not in LEVELS[1:]:
            raise ValueError(f"level: expected one of {LEVELS[1:]}, got {self.level!r}.")


@dataclass(frozen=True)
class Verdict:
    """The worst of its reasons; trustworthy without any.

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
        """True where no number that follows from the calibration should be stated."""
        return self.level == LEVELS[2]

    @classmethod
    def join(cls, parts: Iterable[Self]) -> Self:
        """The reasons of several verdicts, the worst first; of two with one name and level, the first."""
        found = {(reason.name, reason.level): reason for part in reversed(list(parts)) for reason in reversed(part.reasons)}
        return cls(tuple(sorted(reversed(found.values()), key=lambda reason: -LEVELS.index(reason.level))))

    def to_json(self) -> dict:
        """As it stands in check.json and metrics.json."""
        return {"verdict": self.level, "reasons": [vars(reason).copy() for reason in self.reasons]}

    def __str__(self) -> str:
        return "\n".join([f"Verdict: {self.level}", *(f"  {r.level}: {r.name}: {r.text} {r.cure}" for r in self.reasons)])


def judge(
    data: Correspondences | None, calibration: Calibration | None, *, diagnosis: Diagnosis | None = None,
    health: Health | None = None, epipolar_px: float | None = None, robot_accuracy_mm: float = 0.010,
    error: Exception | None = None, doubts: Sequence[Doubt] = (), epipolar_at_mm: np.ndarray | None = None,
) -> Verdict:  # fmt: skip
    """The verdict on a calibration from its own numbers and from witnesses; what is None is left out.

    Args:
        data: What was calibrated with; only its frames tell whether they are enough.
        calibration: None where it was refused; then `error` is the exception.
        epipolar_px: Median epipolar distance of matches between the two images, which know nothing of the tool.
        epipolar_at_mm: (k, 3) where these matches are, by the calibration; None takes them for near the tool.
        robot_accuracy_mm: As its maker states it.
        doubts: Of the recording (`lib.recordings.Recording.doubts`).
    """
    found: list[Reason] = []
    best = None if diagnosis is None else diagnosis.best
    if best is not None:
        text = best.text
        if best.evidence is not None and best.name != "landmark_offset":
            text += f" It explains {100 * best.explained:.0f} % of the residuals."
        found += _reason("diagnosis", best.explained, text, best.cure, best.name)
    if calibration is None:
        kinds = {NoDetectionError: "no_detection", CompetingCamerasError: "refused", NoConsensusError: "no_consensus"}
        name = next((name for kind, name in kinds.items() if isinstance(error, kind)), "refused")
        cure = f"{_OVERLAYS}; where the detector errs, {TRAIN_FURTHER}."
        if name == "refused":  # the error names its cure
            few = data is not None and len(np.unique(data.frame)) < LIMITS["frames"][1]
            cure = _MORE_FRAMES if few else "Mend that, then check again."
        found.append(Reason(name, LEVELS[2], f"There is no calibration: {error}", cure))
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
            cure = "Did a camera move, or are left and right not of one instant? Calibrate anew."
            found += _reason("epipolar", max(epipolar_px - 3.0 * sd, 0.0), text, cure)
    if health is not None:
        if best is not None and best.name not in OF_DETECTOR:  # what contradicts the robot is no detector's fault
            health = health.without_robot
        text = health.text + f" (most often: {health.worst_part})" * bool(health.seen.any()) + "."
        cure = f"The detector may not know this tool or light. {_OVERLAYS}, then {TRAIN_FURTHER}."
        found += _reason("health", health.unhealthy, text, cure, "detector_unfit")
    found += [Reason(doubt.name, LEVELS[1], doubt.text, doubt.cure) for doubt in doubts]
    return Verdict.join([Verdict(tuple(found))])


def _reason(check: str, value: float, text: str, cure: str, name: str = "") -> list[Reason]:
    """A reason where the value is beyond a limit of the check, on the side on which the second limit lies."""
    doubtful, red = LIMITS[check]
    sign = 1.0 if red > doubtful else -1.0
    if not sign * value > sign * doubtful:
        return []
    return [Reason(name or check, LEVELS[2] if sign * value > sign * red else LEVELS[1], text, cure)]


def _residuals(data: Correspondences | None, c: Calibration, robot_mm: float) -> Iterator[tuple]:
    """What `_reason` takes: how large the residuals are, and how many rows they are of."""
    used, views = c.inliers, c.view_inliers[c.inliers]
    variance = np.full((1, 2 * views.shape[1]), _LABEL_PX**2)
    if c.covariance_px2 is not None:
        rows = c.covariance_px2 if len(c.covariance_px2) == 1 else c.covariance_px2[used]
        variance = np.diagonal(rows, axis1=1, axis2=2) / c.detector_scale**2
    gain = [(camera.jacobian(c.x_mm[used][:1]) ** 2).sum() for camera in c.cameras]
    r2, claim2 = (v.reshape(len(v), -1, 2).sum(axis=2) for v in (c.residuals_px[used] ** 2, variance))
    ratio = float(np.sqrt((r2 / (claim2 + np.multiply(gain, robot_mm**2)))[views].mean()))
    text = f"The residuals, {c.reprojection_rms_px:.1f} px RMS, are {ratio:.1f} times what detector and robot claim of each."
    more = " Constant offsets of the landmarks need four frames and more, half of all, with open jaws." * (c.offsets is None)
    yield "residuals", ratio, text, f"Read the diagnosis of {_CHECK}: clock, axes, order of tips, detector.{more}"

    # What leaving a row out does to clean data: its residual grows by (1 - leverage)^-1/2.
    m = c.leverage.shape[1]
    expected = np.sqrt(np.mean(np.trace(np.linalg.inv(np.eye(m) - c.leverage), axis1=1, axis2=2) / m))
    ratio = c.press_rms_px / max(c.reprojection_rms_px * expected**2, 1e-9)
    text = f"Rows left out are predicted with {c.press_rms_px:.3g} px, rows fitted with {c.reprojection_rms_px:.3g} px RMS."
    yield "cross_validation", ratio, text, "A few rows decide everything: move the tool through the whole volume."

    usable = int(np.isfinite(c.residuals_px).sum()) // 2
    share = float(c.view_inliers.sum() / usable)
    text = f"Only {100 * share:.0f} % of the {usable} detections agree on the cameras."
    yield "consensus", share, text, f"{_OVERLAYS}: the other detections are wrong, or these are.", "minority"

    text = f"The rows that agree count as {c.effective_rows:.1f} of independent errors; {LIMITS['rows'][0]:g} are needed."
    yield "rows", c.effective_rows + 1e-9, text, _MORE_FRAMES, "few_rows"
    if data is not None:
        frames = len(np.unique(data.frame[used]))
        text = f"{frames} frames have landmarks that agree; {LIMITS['frames'][0]:g} are needed, 30 are good."
        yield "frames", frames + 1e-9, text, _MORE_FRAMES, "few_frames"


def _geometry(data: Correspondences | None, c: Calibration, robot_mm: float) -> Iterator[tuple]:
    """What `_reason` takes: how the tool moved, the optics that follow from the cameras, and the volume that it covered."""
    x = c.x_mm[c.inliers]
    if data is not None and np.ptp(landmark := data.landmark[c.inliers]):
        own = extents(np.concatenate([x[landmark == k] - x[landmark == k].mean(axis=0) for k in np.unique(landmark)]))
        shape, size_mm = ("line", own[1]) if own[1] < LIMITS["one_line"][0] * robot_mm else ("plane", own[2])
        text = f"Each landmark stays within {size_mm:.3f} mm (RMS) of one {shape}. Across it the cameras rest on the tool's "
        text += "shape as the robot reports it, which may be off."
        yield f"one_{shape}", size_mm / robot_mm, text, "Move the tool in all three directions, and turn it."
        if shape == "line":  # the optics would rest on that shape, too
            return
    zooms, name = np.array([np.diag(camera.resect().K) for camera in c.cameras]), "implausible_optics"
    cure = "Check axes and units of the kinematics, the order of the tips, and which image is left."
    aspect = float(np.exp(np.abs(np.log(zooms[:, 0] / zooms[:, 1])).max()))
    text = f"A camera's zoom differs by a factor of {aspect:.2f} between x and y; pixels are square within some per cent."
    yield "aspect", aspect, text, f"If the images were resized to another shape, undo that. Otherwise: {cure}", name
    if c.rig is None:
        return
    ratio = float(np.exp(np.abs(np.diff(np.log(zooms).mean(axis=1)))[0]))
    yield "zoom_ratio", ratio, f"One camera's zoom is {ratio:.2f} times the other's.", cure, name
    angle = np.rad2deg(c.rig.convergence_rad)
    text = f"The cameras converge by {min(angle, 180 - angle):.1f} degrees; a stereo microscope's by 2 to 20."
    yield "convergence_high", min(angle, 180 - angle), text, cure, name
    if angle < 90:
        yield "convergence_low", angle, text, "Are left and right two different cameras?", name
    mirrored, roll = optics(c).mirrored, abs(np.rad2deg(optics(c).roll_rad))
    text = f"The images are turned by {roll:.0f} degrees against each other."
    if mirrored not in ("left", "right", "left or right"):  # a mirror image looks turned, too
        yield "roll", roll, text, "Turn one of them back: surfaces cannot be matched otherwise.", "turned_image"
    text = f"One image is a mirror image ({mirrored}), or an axis of the kinematics is."
    cure = "Flip that image when recording, or exchange the sign of the axis."
    yield "mirrored", mirrored in ("left", "right", "left or right"), text, cure
    nearness, sd = c.inverse_distance_per_mm
    text = "Farther things look larger: both images are mirrored, or a left-handed robot frame goes with exchanged eyes."
    cure = "Flip both images, or use a right-handed robot frame and exchange left and right."
    yield "hollow", -nearness / sd if sd > 0 else 0.0, text, cure, "mirrored_images"

    text = f"The tool's positions lie {c.extents_mm[2]:.3f} mm (RMS) out of one plane; the robot errs by {robot_mm:.3f} mm."
    yield "thin", c.extents_mm[2] / robot_mm, text, "Move the tool along the view as well, and record more frames."
    along = np.linalg.svd(x - x.mean(axis=0))[2]
    low, high = np.percentile((x - x.mean(axis=0)) @ along.T, [5, 95], axis=0)
    corners = x.mean(axis=0) + np.stack(np.meshgrid(*np.stack([low, high]).T), axis=-1).reshape(-1, 3) @ along
    alone, both = (c.depth_sd_mm(corners, detection=detection).max() for detection in (False, True))
    sizes = " x ".join(f"{value:.1f}" for value in high - low)
    text = f"The tool covers {sizes} mm: the calibration itself leaves {1e3 * alone:.0f} um of depth open at its corners."
    cure = "Move the tool through more depths and corners; notebook 03 finds the positions that tell most."
    yield "coverage", float(alone / np.sqrt(max(both**2 - alone**2, 1e-12))), text, cure


@dataclass(frozen=True, eq=False)
class Assessment:
    """What `assess` found: no calibration where it was refused; the verdict says why.

    `epipolar_px` is the median epipolar distance of features that both images share; NaN where too few are.
    """

    data: Correspondences
    calibration: Calibration | None
    verdict: Verdict
    diagnosis: Diagnosis
    health: Health
    epipolar_px: float = np.nan


def assess(
    recording: Recording, data: Correspondences | None = None, *, detector: Callable | None = None, **options: object
) -> Assessment:  # fmt: skip
    """Calibrate, diagnose, look at the detector's health and at a witness, and judge; what is refused is a reason.

    Args:
        data: Its correspondences (detected, labelled); None runs the detector, the one that ships if none is given.
        detector: The one that made `data`; with it some frames are looked at again, mirrored and shifted.
        options: Of `lib.calibration.calibrate`.  Without `model` cameras are affine, or of a finite distance if that shows.

    A ValueError for data of frames that the recording lacks.
    """
    if data is None:
        detector = detector or Detector.load()
        data = detect(recording, detector)
    if (last := data.frame.max(initial=0)) >= len(recording):
        raise ValueError(f"data: frame {last} is none of the {len(recording)} of {recording.folder}; give its own.")
    calibration, error, epipolar_px, at_mm = None, None, np.nan, None
    try:
        fit = calibrate if "model" in options else calibrate_as_shown
        calibration = fit(data, image_size_px=recording.image_size_px, **options)
    except np.linalg.LinAlgError:
        error = DataError("the fit runs away; no cameras see these rows so. Check times, axes and units of kinematics.csv.")
    except ValueError as refused:
        error = refused
    if calibration is not None and len(y := feature_matches(recording, spread(len(recording), 3))):
        features = calibration.pair.triangulate(y[:, :2], y[:, 2:])
        known = np.isfinite(features.x_mm).all(axis=1)
        epipolar_px, at_mm = float(np.median(np.abs(features.epipolar_px))), features.x_mm[known] if known.any() else None
    straight, near = data, calibration is not None and calibration.inverse_distance_per_mm[1] > 0
    if near:  # a lens that distorts is no fault either, and what the robot parks behind a camera is seen nowhere
        left, right = calibration.cameras
        behind = (left.depth_ratio(data.x_mm) <= 0) | (right.depth_ratio(data.x_mm) <= 0)
        data = replace(data, x_mm=np.where(behind[:, None], np.nan, data.x_mm))
        straight = replace(data, u_left=left.undistort(data.u_left), u_right=right.undistort(data.u_right))
    near |= calibration is None and fit is calibrate_as_shown  # which finds a distance itself
    diagnosis = diagnose(straight, near=near, offsets=calibration and calibration.offsets, **stated(recording))
    if (best := diagnosis.best) is not None and best.name in ("camera_moved", "tool_slipped") and len(best.images) == 2:
        pairs = (recording.frames[int(i)] for i in (data.frame.min(), data.frame.max()))
        first, last = (Scene.of(pair.left, pair.right) for pair in pairs)
        moved_px, others = first.moved_px(last), [h for h in diagnosis.hypotheses if h is not best]  # NaN tells nothing
        if best.name == "tool_slipped" and (moved_px > _MOVED_PX).all():
            diagnosis = Diagnosis(tuple(others))
        elif best.name == "camera_moved" and (best.value > _NEARER_PX + _TIMES * moved_px).all():
            text = "Images and robot part" + best.text[best.text.index(" at about frame") :]
            text += " What lies behind the tool stands still: the robot's report jumped."
            jumped = replace(best, name="robot_jumped", text=text, cure=best.cure.split(". ")[0] + ".")
            diagnosis = Diagnosis((jumped, *others))
    found = health(recording, data, calibration, detector=detector)
    verdict = judge(
        data, calibration, diagnosis=diagnosis, health=found, epipolar_px=epipolar_px, error=error,
        robot_accuracy_mm=recording.robot_accuracy_mm, doubts=recording.doubts, epipolar_at_mm=at_mm,
    )  # fmt: skip
    reasons, where = verdict.reasons, shlex.quote(paths.shown(recording.folder))  # in the commands that cures name
    if data.seen.any() and not np.isfinite(data.covariance_px2).any():  # labels set by hand
        odd = ", ".join(map(str, found.frame[found.bad.any(axis=1)][:12]))
        cure = f"Look again at the labels{', first those of frames ' * bool(odd)}{odd}: `python3 -m lib annotate RECORDING`."
        theirs = ("detector_unfit", "minority", "no_consensus")  # the reasons that wrong labels cause
        reasons = [replace(r, cure=cure) if r.name in theirs else r for r in reasons]
    told = [replace(r, **{k: getattr(r, k).replace("RECORDING", where) for k in ("text", "cure")}) for r in reasons]
    return Assessment(data, calibration, Verdict(tuple(told)), diagnosis, found, epipolar_px)


def report(calibration: Calibration, *, verdict: Verdict | None = None, robot_accuracy_mm: float = 0.010) -> str:
    """A calibration in several lines of text, with at most ten outliers, largest residual first.

    Without the verdict of `lib.trust.assess`, the calibration's own numbers are judged alone.
    """
    verdict = judge(None, calibration, robot_accuracy_mm=robot_accuracy_mm) if verdict is None else verdict
    c, told = calibration, {}
    seen = np.isfinite(c.residuals_px[:, ::2])
    outliers = np.argwhere(seen & ~c.view_inliers)
    size_px = np.linalg.norm(c.residuals_px.reshape(*seen.shape, 2)[tuple(outliers.T)], axis=1)
    if c.rig is not None:
        depths = (c.depth_sd_mm(c.x_mm[c.inliers], detection=detection) for detection in (False, True))
        told = {"optics": optics(c), "depth_um": [1e3 * np.median(depth) for depth in depths], "degrees": np.rad2deg}
    return TEMPLATES.get_template("report.txt").render(
        told, c=c, verdict=verdict, detections=seen.sum(), outliers=len(outliers), landmarks=LANDMARKS,
        worst=[(*outliers[i], size_px[i]) for i in np.argsort(-size_px)[:10]],
    ).rstrip()  # fmt: skip
