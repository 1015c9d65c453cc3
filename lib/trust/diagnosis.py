"""What is wrong with a recording: hypotheses fitted to its correspondences, and compared with "nothing is wrong".

Hypotheses about the tool are in `lib.trust.tool`, about time in `lib.trust.clocks`, about lenses, axes and eyes in
`lib.trust.optics`; those with separate parameters for each frame are in `lib.trust.unsteady`.  All allow for heavy-tailed
noise (`lib.trust.fitting`).  The evidence is the gain in log likelihood minus a penalty for the parameters (BIC).
"""

from collections import ChainMap
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
from scipy.ndimage import binary_opening, median_filter

from lib.calibration import LandmarkOffsets
from lib.correspondences import LANDMARKS, TRAIN_FURTHER, Correspondences
from lib.parallel import single_threaded_blas
from lib.recordings import Kinematics, Recording
from lib.trust.clocks import TIME_TESTS, log_elsewhere
from lib.trust.fitting import FITS, HOPELESS, SIDES, Case, Hypothesis, Problem, Robust, by_steps, compared
from lib.trust.health import affine_epipolar
from lib.trust.optics import axes_and_eyes, finite_distance, lens, stands_exchanged
from lib.trust.tool import jaw_opening, landmark_offset, tool_bends, tool_length
from lib.trust.unsteady import FRAME_TESTS, OF_FRAMES, ROBOT_ERRS

_MOST_ROWS, _FEWEST_FRAMES = 1200, 4  # most rows that are used; three frames leave nothing to check against
UNFIT = f"The detector does not fit these pictures: look at its overlays, {TRAIN_FURTHER}."
_SPIKED, _LEAST_SPIKE_MM = 5, 0.2  # width of a median filter in samples, and least distance of a spike from its output
#: Gain in log likelihood of moved cameras (16 numbers), or of a jump (6), over a slipped tool (3) that rules the latter out.
AS_GOOD = 6.0
_SURE_CHANGE = 30.0  # least gain in log likelihood by a change of the cameras (16 numbers) whose frames are examined
_RESTS, _RESTS_MM = 4, 0.06  # a tool rests if its landmarks moved less than 0.06 mm in 4 frames, noise included
#: Least share of gross errors of an unfit detector: in all landmarks, or in one that has at least so many detections.
_UNFIT_SHARE, _UNFIT_ONE, _UNFIT_FEWEST = 0.2, 0.35, 16
#: Least share of gross errors in the images of one eye, and largest share in the other's, if only the one eye is in doubt.
_ONE_EYE, _OTHER_EYE = 0.6, 0.2
_EXCHANGE = "Exchange the images of these frames between left/ and right/."
_OF_PIXELS = ("scaled_axis", "odd_pixels")
_OF_TIME = ("clock", "clock_rate", "frame_order")
_NEARLY = 0.05  # share of the residuals: causes that explain this much less still compete
_ALIKE_REST = 2.0  # a clock's offset only competes with its rate if it leaves less than this multiple of the rate's residuals
_MOSTLY = 0.5  # share of the residuals, above which a cause explains most of them
_UNITS = (1e3, 1e-3, 1e2, 1e-2, 1e1, 1e-1)  # ratios of units of length that are tried
_ALIKE, _RIGID = 5.0, 0.1  # landmarks of a tool move as far within this factor, and stay apart within this share of it
_OPEN = 0.1  # distance of the tips as a share of the tool's length, from which jaws are open
_STILL_PX, _STILL_MM = 0.3, 0.04  # detections in copies of one picture vary by less, and so does a robot at rest


def _tip_order(case: Case) -> Iterator[Hypothesis]:
    """Exchanged landmarks: the tips in both images, in one, or in some frames; or the base taken for a tip."""
    problem = case.problem
    if problem.landmark.max() != 2:
        return
    table = case.by_frame(problem.x[:, 0])
    others = [(order, (0, 1)) for order in permutations(range(3)) if order != (0, 1, 2)]
    for order, views in (*others, ((0, 2, 1), (0,)), ((0, 2, 1), (1,))):
        moved = problem.moved_to(table[problem.frame, np.array(order)[problem.landmark]], views)
        if moved.used.all(axis=1).sum() < 6:
            continue
        where, call = ("both images", "call") if len(views) == 2 else (f"the {SIDES[views[0]]} image", "calls")
        text = f"What {where} {call} {', '.join(LANDMARKS)} is {', '.join(LANDMARKS[k] for k in order)} for the robot."
        cure = f"Bring the columns of kinematics.csv, or the detections of {where}, into the same order."
        mirrored = "both images are mirrored, flip them" if len(views) == 2 else "that image is mirrored, flip it"
        cure += f" If {mirrored} instead." if order == (0, 2, 1) else ""
        fit = moved.fit(worth=case.null.total - HOPELESS)
        yield case.found("tip_order", fit, 1, (1.0, 0.0, ""), text, cure, on=moved, images=views)
    swapped = table[:, [0, 2, 1]][problem.frame, problem.landmark]  # exchanged in some frames: one bit a frame
    fit, moved, own = case.chosen(np.stack([problem.x[:, 0], swapped]))
    if not own.any():  # the gain comes from better cameras than those of `null`
        return
    text = f"The tips are exchanged in {100 * own.mean():.0f} % of the frames, first in frame {problem.number[own.argmax()]}."
    cure = "Tell the tips apart by the tool's roll, as the robot does; or train the detector with tips in the robot's order."
    raw = fit.total - case.null.total - case.frames * np.log(2.0)
    yield case.found("tip_order", fit, 1, (100 * own.mean(), 0.0, "%"), text, cure, on=moved, raw=raw)


def _log_spikes(case: Case) -> Iterator[Hypothesis]:
    """Single samples of the robot's log that lie far from those before and after them."""
    found, sizes = [], []
    for own in np.swapaxes(case.log, 0, 1) if case.kinematics else ():
        if (known := np.isfinite(own).all(axis=1)).sum() >= _SPIKED:
            x = own[known]
            away, step = (np.linalg.norm(d, axis=1) for d in (x - median_filter(x, (_SPIKED, 1)), np.diff(x, axis=0)))
            spikes = away > max(_LEAST_SPIKE_MM, 10 * np.quantile(step, 0.25))
            found, sizes = [*found, *case.kinematics.time_s[known][spikes]], [*sizes, *away[spikes]]
    if not found:
        return
    time_s, step_s = np.unique(found), np.median(np.diff(case.kinematics.time_s))
    hit = np.abs(case.at_s[:, None] - time_s).min(axis=1) < step_s
    if not hit.all() and len(np.unique(case.problem.frame[hit])) >= 3:
        fit, size = case.problem.fit(start=case.null.start, apart=hit), np.median(sizes)
        text = f"{len(time_s)} samples of kinematics.csv jump by {size:.2g} mm (median) and back, first at {time_s[0]:.2f} s."
        cure = "Leave these cells of kinematics.csv blank."
        yield case.found("log_spikes", fit, 2, (len(time_s), 0.0, "samples"), text, cure)


def _drift(case: Case) -> Iterator[Hypothesis]:
    """A steady drift: the images shift, or the cameras turn, zoom or move, at constant speed."""
    time = case.problem.time
    if not np.isfinite(time).all() or np.ptp(time) == 0:
        return
    share = (time - time.mean()) / np.ptp(time)
    changes = case.problem.of_change(share)
    cure = "Fix the microscope and the robot, or calibrate shorter parts (--frames A:B)."
    for columns, what in (
        (changes[..., 3::4], "images creep"),  # the cameras' offsets alone
        (case.problem.of_motion(share), "cameras turn or move steadily together: the images change"),
        (changes, "cameras turn, zoom or move steadily: the images change"),
    ):
        fit = case.linear(columns)
        moved_px = fit.moved_px[case.problem.used]
        size = float(np.sqrt(12.0 * (moved_px**2).sum(axis=1).mean()))  # the RMS of a line is 1/sqrt(12) of its range
        text = f"The {what} by {size:.1f} px from the first frame to the last."
        yield case.found("drift", fit, fit.theta.size, (size, 0.0, "px"), text, cure)


def _bad_part(case: Case) -> Iterator[Hypothesis]:
    """Large residuals of one landmark, or of the stretch with the largest sum of a score that is negative on average."""
    problem, parts = case.problem, []
    for k in np.unique(problem.landmark[problem.landmark <= 2]):
        cure = f"Look at the detections of {LANDMARKS[k]} and at its column in kinematics.csv, or calibrate without it."
        parts.append(("bad_landmark", problem.landmark == k, 2, f"{LANDMARKS[k]} has", cure))
    r2 = (case.null.residuals**2).sum(axis=2) / problem.noise**2
    score = np.log1p(r2 / max(np.median(r2[problem.used]) / 1.4, 1e-6)) - 1.5
    total = np.append(0.0, np.cumsum(np.bincount(problem.frame, np.where(problem.used, score, 0.0).sum(axis=1), case.frames)))
    last = int((total - np.minimum.accumulate(total)).argmax())
    first = int(total[: last + 1].argmin())
    if 2 <= last - first <= 0.6 * case.frames:
        rows = (problem.frame >= first) & (problem.frame < last)
        when = "{} to {} ({:.2f} to {:.2f} s)".format(*problem.number[[first, last - 1]], *problem.time[rows][[0, -1]])
        cure = "Look at these frames and the robot's log of this time, or leave its cells in kinematics.csv blank there."
        parts.append(("bad_stretch", rows, 4, f"Frames {when} have", cure))
        fit, share = _exchanged(problem, rows).fit(start=case.null.start), (100 * rows.mean(), 0.0, "%")
        yield case.found("exchanged_eyes", fit, 4, share, f"In frames {when} the left image is the right one.", _EXCHANGE)
    for name, rows, extra, what, cure in parts:
        inside, outside = problem.used & rows[:, None], problem.used & ~rows[:, None]
        if not inside.any() or not outside.any():
            continue
        fit = problem.fit(start=case.null.start, apart=rows)
        distance = np.linalg.norm(fit.residuals, axis=2)
        ratio = float(np.median(distance[inside]) / max(np.median(distance[outside]), 1e-3))
        if ratio >= 3.0:
            text = f"{what} residuals {ratio:.1f} times as large as the others."
            yield case.found(name, fit, extra, (ratio, 0.0, "times"), text, cure)


def _exchanged(problem: Problem, rows: np.ndarray) -> Problem:
    """The problem with left and right exchanged in the `rows` (n,) bool."""
    y = np.where(rows[:, None, None], problem.y[:, ::-1], problem.y)
    return replace(problem, y=y, seen=np.where(rows[:, None], problem.seen[:, ::-1], problem.seen))


def _camera_moved(case: Case) -> Iterator[Hypothesis]:
    """A change at one frame: one camera or both moved, the images were exchanged, or the tool slipped in its holder."""
    problem = case.problem
    if case.frames < 8:
        return
    frame, both = problem.other_cameras(case.null)
    late = (problem.frame >= frame)[:, None]
    changes = both.total - case.null.total > _SURE_CHANGE  # else no hypothesis is named, and the search would take long
    number, first, last = problem.number[[frame, *(problem.similar_cuts(frame, both) if changes else (frame, frame))]]
    parts = f"--frames {problem.number[0]}:{first}, --frames {last}:{problem.number[-1] + 1}"
    when = f"at about frame {number}" + (f" ({first} to {last})" if first < last else "")  # in the recording
    text = f"From about frame {number} on, the left image is the right one."
    fit = _exchanged(problem, late[:, 0]).fit(start=both.start)
    yield case.found("exchanged_eyes", fit, 3, (100 * late.mean(), 0.0, "%"), text, _EXCHANGE)
    slipped = problem.axes * late[..., None]
    fit = case.linear(by_steps(slipped))
    size, along = 1e3 * np.linalg.norm(fit.theta), ", ".join(f"{1e3 * v:.0f}" for v in fit.theta)
    text = f"The tool slipped {when}, by {size:.0f} um ({along} um in the tool's axes)."
    cure = f"Fix the tool in its holder, or calibrate the frames before and after separately ({parts}). "
    cure += "Where the tool does not turn, a robot whose zero changed looks the same."
    slip = case.found("tool_slipped", fit, 6, (size, 0.0, "um"), text, cure)
    # Ruled out, it only counts again if the scene stands still (`lib.trust.verdict.with_scene`).
    yield slip if fit.total > both.total - AS_GOOD else replace(slip, gain=0.0)
    together = case.linear(problem.of_motion(late[:, 0]))
    for views, fit in (((0, 1), both), ((0, 1), together), ((0,), None), ((1,), None)):
        fit = fit or case.linear(problem.of_change(late[:, 0], views))
        rows = problem.used[:, views] & late
        size = float(np.sqrt((fit.moved_px[:, views][rows] ** 2).sum() / max(rows.sum(), 1)))
        who = "Both cameras" if len(views) == 2 else f"The {SIDES[views[0]]} camera"
        how = "moved together" if fit is together else "moved or zoomed"
        text = f"{who} {how} {when}: the images shift by {size:.1f} px."
        cure = f"Calibrate the frames before and after separately ({parts}). "
        cure += "lib.registration.register_images can follow a move, but no zoom."
        cure += " A robot whose zero changed looks the same." * (len(views) == 2)
        yield case.found("camera_moved", fit, fit.theta.size + 3, (size, 0.0, "px"), text, cure, images=views)


def _frozen(case: Case) -> Iterator[Hypothesis]:
    """Positions that stand still or run on a straight line to the last digit; pixels that repeat while the robot moves."""
    problem = case.problem
    if not np.isfinite(problem.time).all() or case.frames < 4:
        return
    x, left, right, time = (case.by_frame(v) for v in (problem.x[:, 0], problem.y[:, 0], problem.y[:, 1], problem.time))
    velocity = np.diff(x, axis=0) / np.diff(time, axis=0)[..., None]
    sizes = [np.linalg.norm(np.diff(v, axis=0), axis=2) for v in (velocity, x, left, right)]
    # of each step from frame to frame the largest over the landmarks, -1 where all are missing
    change, step_x, *steps = (np.where(np.isfinite(size), size, -1.0).max(axis=1) for size in sizes)
    step_y = np.maximum(*steps)
    straight = binary_opening(np.append((change >= 0) & (change < 2e-3), False))  # five frames on one line

    def certain(name: str, fit: Robust, repeated: np.ndarray, text: str, cure: str) -> Hypothesis:
        share = 100.0 * float(repeated.mean())
        found = case.found(name, fit, 2, (share, 0.0, "%"), f"In {share:.0f} % of the frames {text}.", cure)
        gain = max(found.gain, 0.0) + float(repeated.sum() * np.log(100.0))  # noise would not repeat a number
        return replace(found, gain=gain, explained=max(found.explained, share / 100))

    still = (step_y > 0) & (straight | ((step_x >= 0) & (step_x < 1e-9)))
    text = "the robot's positions stand still, or run on an exact straight line, while the tool moves in the images"
    cure = "Log the robot at every sample; where it was silent leave the cells blank, so that these frames are not used."
    parts = [(problem.landmark >= 0, still, step_y, 0.0, text, cure)]
    for k, name in enumerate(LANDMARKS):
        still, moved_px = (sizes[1][:, k] < 1e-9) & (step_x > 1e-6), np.fmax(*(size[:, k] for size in sizes[2:]))
        text = f"the robot's position of {name} alone stands still while it moves in the images"
        cure = f"Log {name} at every sample; where its columns of kinematics.csv repeat an old position leave them blank."
        parts.append((problem.landmark == k, still, moved_px, 0.5, text, cure))  # in most, else it rests and detections err
    for rows, still, moved_px, least, text, cure in parts:
        if still.mean() >= 0.02:
            fit = problem.fit(start=case.null.start, apart=rows & np.isin(problem.frame, np.flatnonzero(still) + 1))
            always = still.all() and rows.all()  # else a tool at rest seems to move as far as the noise
            wrong = still & (always | (moved_px > 8 * fit.shapes[0].scale))
            if wrong.mean() >= 0.02 and wrong.sum() > least * still.sum():
                yield certain("frozen_kinematics", fit, wrong, text, cure)
    noise = min(fit.shapes[0].scale for fit in (case.null, *case.fits.values()))
    left, right = ((step_x > 1e-6) & (step >= 0) & (step < 0.15 * noise) for step in steps)
    far = [step > 8 * noise for step in steps]  # if one image repeats, the other shows whether the tool moved
    for views, twice in (([0, 1], left & right), ([0], left & far[1]), ([1], right & far[0])):
        if twice.mean() < 0.02 or twice.all():
            continue
        # Each image belongs to the instant at which it was first seen.
        source = np.maximum.accumulate(np.where(np.append(True, ~twice), np.arange(case.frames), 0))[problem.frame]
        fit = problem.moved_to(x[source, np.minimum(problem.landmark, 2)], views).fit(start=case.null.start)
        who = "" if len(views) == 2 else f" of the {SIDES[views[0]]} image"
        text = f"the detections{who} repeat those of the frame before while the robot moves"
        cure = "Drop images that the camera delivered twice, and give the others their own times in frames.csv."
        yield replace(certain("frozen_video", fit, twice, text, cure), images=tuple(views))


def _unexplained(case: Case, fit: Robust) -> list[Hypothesis]:
    """Faults in the residuals of the best cause: the images disagree with each other (the detector's fault) or the robot."""
    problem = replace(case.problem, seen=case.problem.seen & ~fit.apart[:, None])
    base = case.by_frame(problem.x[:, 0])[problem.frame, 0]
    tools = np.einsum("cij,ncj->nci", fit.M[:, :, :3], problem.x - base[:, None])
    reach = np.linalg.norm(tools, axis=2)[problem.landmark > 0]
    if not np.isfinite(reach).any():
        return []
    length, distance = np.nanmedian(reach), np.linalg.norm(fit.residuals, axis=2)
    far = problem.used & (distance > 0.05 * length)
    share = float(far.sum() / problem.used.sum())
    off = far if share >= _UNFIT_SHARE else problem.used
    missed = float(np.median(distance[off]))
    zoom = float(np.linalg.svd(fit.M[0, :, :3], compute_uv=False).mean())
    both, half = problem.used.all(axis=1), problem.used.sum() / 2.0
    distances = affine_epipolar(problem.y[both].reshape(-1, 4))[0]  # all NaN if there are few
    of_off = distances[off[both].any(axis=1)]
    epipolar = float(np.sqrt(2.0) * np.quantile(of_off, 0.75 if off is far else 0.5)) if of_off.size else np.nan
    gain = half * (share * np.log(max(share, 1e-9) / 0.05) + (1 - share) * np.log(max(1 - share, 1e-9) / 0.95))
    if epipolar < 0.25 * missed and missed > case.robot_mm * zoom:
        what = f"In {100 * share:.0f} % of the landmarks" if off is far else "In most landmarks"
        text = f"{what} the images agree with each other within {epipolar:.1f} px and miss the robot by {missed:.0f} px."
        cure = f"{ROBOT_ERRS} Or the detector errs alike in both images: see its overlays."
        explained = (share if off is far else 1.0) * (1.0 - (epipolar / missed) ** 2)
        gain = float(gain if off is far else half * np.log(missed / epipolar) / fit.design)
        return [Hypothesis("robot_noise", text, cure, 1e3 * missed / zoom, 0.0, "um", explained, gain)]
    text = f"{100 * share:.0f} % of the landmarks lie more than 5 % of the tool's length from where the cameras see them."
    if off is not far:
        each = [problem.used & (problem.landmark == k)[:, None] for k in range(len(LANDMARKS))]
        wrong = [far[own].mean() if own.sum() >= _UNFIT_FEWEST else 0.0 for own in each]
        if max(wrong) < _UNFIT_ONE or share < 0.05:
            return []
        what = f"{100 * max(wrong):.0f} % of the detections of {LANDMARKS[int(np.argmax(wrong))]}"
        text = f"{what} lie more than 5 % of the tool's length from where the cameras see it."
    name, cure, images, each = "detector_unfit", UNFIT, (0, 1), problem.used.sum(axis=0)
    low, high = np.sort(of_eye := far.sum(axis=0) / np.maximum(each, 1))
    if low < _OTHER_EYE and high > _ONE_EYE and each.min() >= _UNFIT_FEWEST:
        side, other = (SIDES[k] for k in np.argsort(-of_eye))
        name, images = "one_eye_unfit", (SIDES.index(side),)
        text = f"In the {side} images {100 * high:.0f} % of the landmarks lie more than 5 % of the tool's length from where "
        text += f"the cameras see them, in the {other} images {100 * low:.0f} %."
        cure = f"Are the {side} images of this recording, and each of the same instant as the {other} one? Else pair them "
        cure += f"again. If they are: {UNFIT}"
    return [Hypothesis(name, text, cure, 100 * share, 0.0, "%", share, float(gain), images)]


def _prefer_simple(found: list[Hypothesis]) -> list[Hypothesis]:
    """Lower the gains of `robot_noise` and `clock_rate` below those of simpler causes that explain nearly as much."""
    causes = [h for h in found if h.is_named]
    for name, rivals in (("robot_noise", {h.name for h in causes} - {"robot_noise"}), ("clock_rate", {"clock"})):
        own = max((h.explained for h in causes if h.name == name), default=0.0)
        least = own - _NEARLY if name == "robot_noise" else max(own - _NEARLY, 1.0 - _ALIKE_REST * (1.0 - own))
        most = max((h.gain for h in causes if h.name in rivals and h.explained > least), default=np.inf)
        found = [replace(h, gain=min(h.gain, 0.9 * most)) if h.name == name else h for h in found]
    return found


def _mixed_units(data: Correspondences) -> list[Hypothesis]:
    """A landmark in another unit of length than the others: it keeps its distance from them only times a power of ten."""
    x = data.grid("x_mm")[:, : len(LANDMARKS)]
    x = x[np.isfinite(x).all(axis=(1, 2))]
    moved = np.median(np.abs(x - np.median(x, axis=0)), axis=0).max(axis=1) if len(x) else np.zeros(x.shape[1])
    for factor, k in product(_UNITS if moved.min() > 0 else (), range(x.shape[1])):
        name, others = LANDMARKS[k], np.arange(x.shape[1]) != k
        alike = np.abs(np.log(factor * moved[k] / moved[others])) <= np.log(_ALIKE)
        before, after = (np.linalg.norm(s * x[:, [k]] - x[:, others], axis=2).std(axis=0) for s in (1.0, factor))
        if alike.all() and ((after < _RIGID * moved[others]) & (before > _RIGID * moved[others])).any():
            text = f"The robot's positions of {name} have another unit than the others: times {factor:g} they fit them."
            cure = f"Multiply the columns of {name} in kinematics.csv by {factor:g}, or state their unit in the mapping."
            return [Hypothesis("mixed_units", text, cure, factor, 0.0, "times", 1.0, float(len(data)))]
    return []


def _same_tips(data: Correspondences) -> list[Hypothesis]:
    """Tips that the robot always reports at one point, while the images show open jaws."""
    x, u = data.grid("x_mm"), data.grid("u_left")
    if not (x[:, 1] == x[:, 2]).any() or (np.abs(x[:, 1] - x[:, 2]) > 0).any():
        return []
    open_px, length_px = (np.linalg.norm(u[:, 2] - u[:, k], axis=1) for k in (1, 0))
    if not np.nanmedian(np.append(open_px / length_px, np.nan)) > _OPEN:
        return []
    text, cure = "The robot reports both tips at one point.", "Calculate each tip from the opening of the jaws in its log."
    return [Hypothesis("same_tips", text, cure, 100.0, 0.0, "%", 1.0, float(len(data)))]


@dataclass(frozen=True)
class Diagnosis:
    """The hypotheses, most likely first."""

    hypotheses: tuple[Hypothesis, ...] = ()

    @property
    def best(self) -> Hypothesis | None:
        """The fault that the data show; None where nothing beats "nothing is wrong"."""
        return max((h for h in self.hypotheses if h.is_named), key=lambda h: h.gain, default=None)


def stated(recording: Recording) -> dict[str, object]:
    """What a recording states about clock, shutter, images and robot: keyword arguments of `diagnose`."""
    names = ("kinematics", "offset_s", "readout_s", "image_size_px", "robot_accuracy_mm")
    return {name: getattr(recording, name) for name in names} | {"own_times": (recording.folder / "frames.csv").exists()}


@single_threaded_blas()
def diagnose(
    data: Correspondences, *, kinematics: Kinematics | None = None, offset_s: float = 0.0, readout_s: float = 0.0,
    image_size_px: tuple[int, int] | None = None, near: bool = False, offsets: LandmarkOffsets | None = None,
    robot_accuracy_mm: float = 0.010, own_times: bool = False,
) -> Diagnosis:  # fmt: skip
    """Fit every hypothesis about what could be wrong, and rank them.

    Args:
        data: The rows from which the cameras were calibrated, or could not be calibrated.
        kinematics: The robot's log, which gives the tool's positions a little earlier or later.  Without it they are
            interpolated between the rows, if the frames follow each other within 0.25 s.
        offset_s, readout_s, image_size_px, robot_accuracy_mm: As the recording states them.  Without a size neither the
            read-out time nor the lenses are tested.
        near: The calibrated cameras have a finite working distance, which is then no fault.
        offsets: The calibrated offsets of the landmarks.  They turn the tool's axes where the jaws are nearly shut.
        own_times: The recording states the times of its frames in frames.csv, so that its fps has no effect.

    >>> from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig
    >>> rng = np.random.default_rng(0)
    >>> x = ROBOT_FROM_MICROSCOPE.apply(rng.uniform(-4, 4, (60, 3)))
    >>> u = [pixels + rng.normal(0, 1.5, pixels.shape) for pixels in reference_rig().project(x)]
    >>> print(diagnose(Correspondences.of_points(x, *u)).best)
    None
    """
    frames = np.unique(data.frame)
    if len(data) > _MOST_ROWS:  # whole frames, spread evenly
        data = data.of_frames(frames[np.linspace(0, len(frames) - 1, int(len(frames) * _MOST_ROWS / len(data))).astype(int)])
    problem = Problem.of(data, image_size_px, offsets)
    few = problem.used.all(axis=1).sum() < 6
    if len(frames) < _FEWEST_FRAMES or (few and len(data) < 12):
        return Diagnosis()
    apart = log_elsewhere(data, kinematics, offset_s)
    if few:
        text = f"Only {problem.used.all(axis=1).sum()} of {len(data)} rows have both images and the robot's report."
        unfit = Hypothesis("detector_unfit", text, UNFIT, 100.0, 0.0, "%", 1.0, float(len(data)))
        return Diagnosis((*apart, unfit) if data.seen.all(axis=1).sum() >= 6 else (unfit,))
    if mixed := _mixed_units(data) or _same_tips(data):
        return Diagnosis(tuple(mixed))
    if (problem.y[:, 0] == problem.y[:, 1])[problem.used.all(axis=1)].all(axis=1).mean() > 0.5:
        text, cure = "Left and right images are the same.", "Put the right camera's own images into RECORDING."
        return Diagnosis((Hypothesis("same_images", text, cure, 100.0, 0.0, "%", 1.0, float(len(data))),))
    tracks = [(problem.landmark == k) & problem.used.all(axis=1) for k in np.unique(problem.landmark)]
    moved_px, moved_mm = (max(np.ptp(v[own], axis=0).max() for own in tracks if own.any()) for v in (problem.y, problem.x))
    if moved_px < _STILL_PX and moved_mm > _STILL_MM:
        text, cure = "All frames show one picture, while the robot moves.", "Check that the cameras deliver; record again."
        return Diagnosis((Hypothesis("frozen_video", text, cure, 100.0, 0.0, "%", 1.0, float(len(data))),))
    log = kinematics, offset_s, readout_s, image_size_px, robot_accuracy_mm, own_times
    whole = case = Case(problem, *log)
    # While a tool rests, its detections repeat one error, which could pass for a fault that begins or ends there.
    x_mm, kept = np.nan_to_num(data.grid("x_mm")), np.ones(len(np.unique(data.frame)), dtype=bool)
    kept[_RESTS:] = np.linalg.norm(x_mm[_RESTS:] - x_mm[:-_RESTS], axis=2).max(axis=1) > _RESTS_MM
    if kept.sum() >= max(_FEWEST_FRAMES, 0.25 * len(kept)) and not kept.all():
        case = Case(Problem.of(data.of_frames(np.unique(data.frame)[kept]), image_size_px, offsets), *log)
        whole.fits = ChainMap({}, case.fits)  # it reads these fits and keeps its own, of other rows, apart
    tests = [_tip_order, tool_length, tool_bends, jaw_opening, _log_spikes, lens, _drift, _bad_part, _camera_moved]
    tests = [*(TIME_TESTS if case.paths else ()), *tests, _frozen, *FRAME_TESTS]
    found = compared([h for test in tests for h in test(whole if test is _frozen else case)], OF_FRAMES)
    if case.misfit(case.null, *(case.fits[name] for name in _OF_TIME if name in case.fits)) >= FITS:
        found += apart
    best = Diagnosis(found := _prefer_simple([h for h in found if np.isfinite(h.gain)])).best
    if best is None:  # not before, since other faults look like offsets, too
        found += landmark_offset(case)
        best = Diagnosis(found).best
    turned = best is not None and best.name == "turned_image" and len(best.images) == 2  # which exchanges left and right
    if turned and not stands_exchanged(case.fits[best.name]):
        found = [h for h in found if h.name != "turned_image"]
        best, turned = Diagnosis(found).best, False
    plain = best is None or best.name in OF_FRAMES  # with parameters for each frame even wrong cameras fit
    fit = case.null if plain else case.fits.get(best.name, case.null)
    more = [] if near else list(finite_distance(case, fit))
    more += axes_and_eyes(case, fit, -1.0 if turned else 1.0)
    if best is not None:  # a large fault may also skew the pixels; a check after its cure shows
        after = _OF_PIXELS if best.explained > _MOSTLY else _OF_PIXELS[1:]
        more = [replace(h, gain=min(h.gain, 0.9 * best.gain)) if h.name in after else h for h in more]
    found += [h for h in more if np.isfinite(h.gain)]
    best = Diagnosis(found).best
    rest = _unexplained(case, case.null if best is None else case.fits.get(best.name, fit))
    # If the best cause leaves most landmarks far off, it is not preferred for being simpler.
    found = found + rest if any(h.explained > _MOSTLY for h in rest) else _prefer_simple(found + rest)
    return Diagnosis(tuple(sorted(found, key=lambda h: -h.gain)))
