"""What stands before the numbers of a recording: may they be believed, and which frames can be held out."""

from __future__ import annotations

import shlex
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from lib import paths
from lib.calibration import Calibration, calibrate, with_offsets
from lib.correspondences import Correspondences
from lib.recordings import Recording
from lib.trust import Assessment, Health, Reason, Verdict
from lib.trust.verdict import OF_DETECTOR
from lib.workbench import report
from notebooks.figures.overview import landmarks_on
from notebooks.figures.style import figure, show_image

#: Fewest rows of a calibration that is to be judged by held-out frames, and of those frames.
_ROWS = (12, 3)
#: Stereo frames with labels that are enough to calibrate, if they are far apart; reasons that fewer of them give.
_ENOUGH_LABELS = 10
_OF_FEW = ("few_frames", "few_rows", "coverage", "cross_validation")
#: Reasons that speak of too little motion, of cameras that are unsure (by that too, but any cause makes it worse), of times.
_MOTION, _UNSURE = ("few_frames", "one_line", "one_plane", "thin"), ("coverage", "few_rows", "cross_validation")
_TIMES = ("clock", "clock_rate", "frame_order", "time_stamps", "frame_times", "little_overlap", "slow_log")
#: Reasons that speak of the detector where no cause is named.
_LOST = ("no_detection", "no_consensus", "minority")
#: Stereo frames to label: fewer teach little, and more are rarely needed.
_FEWEST, _MOST = 10, 20
#: What a `health_chart` shows.
HEALTH_CAPTION = (
    "The score of each frame. Above the red line its landmarks contradict themselves, the other image or the robot, the "
    "tool's length in it is not the robot's, or its picture is unlike those of the training."
)


def believed(assessed: Assessment, *, force: bool, affine: bool = False) -> Calibration:
    """The calibration of a recording; without one, or on a red one unless `force`, the notebook ends here and says why.

    So it does where it needs `affine` cameras and these are not.
    """
    left_out = "So what follows from the cameras (surface, distance, registration) is not computed, and the rest of this"
    left_out += " notebook is left out. The verdict above says why, and what to do."
    if assessed.calibration is None:
        report.stop(f"The cameras could not be calibrated from this recording. {left_out}")
    if assessed.verdict.is_red and not force:
        anyway = "With `-p force True` the notebook goes on in spite of it."
        report.stop(f"The calibration of this recording is not trustworthy. {left_out} {anyway}")
    if affine and not assessed.calibration.pair.is_affine:
        report.stop(
            "The cameras of this recording have a finite distance. This notebook works out step by step what holds for "
            "affine ones, so its rest is left out. Notebooks 00 and 07 reconstruct with the cameras as they are."
        )
    return assessed.calibration


def labelled_pairs(recording: Recording) -> int:
    """How many stereo frames have a label in both images."""
    if (marks := recording.annotations) is None:
        return 0
    return int((np.isfinite(marks.u_left) & np.isfinite(marks.u_right)).all(axis=2).any(axis=1).sum())


def asking_for_labels(recording: Recording, assessed: Assessment) -> Assessment:
    """An assessment of labels; where they are few and frames are left, its cures ask for more labels, not for more frames."""
    pairs = labelled_pairs(recording)
    if pairs >= min(_ENOUGH_LABELS, len(recording)):
        return assessed
    where = shlex.quote(paths.shown(recording.folder))
    cure = f"Label more stereo frames, far apart: `python3 -m lib annotate {where}`; {_ENOUGH_LABELS} are enough."
    reasons = [replace(one, cure=cure) if one.name in _OF_FEW else one for one in assessed.verdict.reasons]
    return replace(assessed, verdict=Verdict(tuple(reasons)))


def in_words(
    recording: Recording, assessed: Assessment, next_step: str | None
) -> tuple[dict[str, str], int, str]:  # fmt: skip
    """Answers to what the user of a recording asks, how many frames are bad, and a note on that number.

    A cause that the diagnosis names comes before all that may follow from it.

    Args:
        next_step: Of `lib.trust.check`; None where labels take the detector's place.
    """
    reasons = {reason.name: reason for reason in assessed.verdict.reasons}
    cause, health = assessed.diagnosis.best, assessed.health
    vague = ("detector_unfit",) if next_step else ("detector_unfit", "robot_noise")  # wrong labels look like noise, too
    named = cause is not None and cause.name in reasons and cause.name not in vague
    frames, note = len(health.frame), f"of {len(health.frame)}: their score is above 1"
    if named and cause.name not in OF_DETECTOR:  # what contradicts the robot is no detector's fault
        health = health.without_robot
        note += " without what contradicts the robot, since another cause is named"
    missed = np.zeros(frames, dtype=bool)
    if next_step:  # frames without labels are not bad
        missed, note = ~health.seen.any(axis=1), f"{note}, or nothing is found"
    bad = int(((health.score > 1) | missed).sum())

    moved = "Yes."
    if named and any(name in reasons for name in _UNSURE):
        moved = "Not known before the cause below is mended: it leaves the cameras unsure."
    if assessed.calibration is None:
        moved = "Not known: there are no cameras yet that could tell."
    unfit = [reasons[name] for name in OF_DETECTOR + (() if named else _LOST) if name in reasons]
    first = reasons[cause.name] if named else next(iter(reasons.values()), None)
    if unfit and not named and not next_step:  # the labels come before what may follow from them
        first = unfit[0]
    then = "Nothing: go on." if first is None else first.cure
    untold = named and first.name not in _MOTION + _TIMES
    if untold or (first and first.name == "refused"):  # the text names what to mend
        then = f"{first.text} {first.cure}"
    if next_step and assessed.verdict.is_red and next_step == recording.mistimed:
        then = next_step  # where the times are wrong, nothing else is known
    elif next_step and unfit and not named:
        then = f"Adapt; then label {min(max(bad, _FEWEST), _MOST)} stereo frames."
    usable = f"{_refusal(unfit)} {bad} of {frames} frames are bad." if unfit else "Yes."
    answers = {
        "Enough motion?": _answer(reasons, _MOTION if named else _MOTION + _UNSURE, moved),
        "Do the clocks agree?": _answer(reasons, _TIMES, "Nothing speaks against it."),
        "Is the detector usable?": usable if next_step else "Not asked: your labels take its place.",
        "Then what?": then,
    }
    return answers, bad, note


def _answer(reasons: Mapping[str, Reason], names: Sequence[str], good: str) -> str:
    """Those of the reasons that have these names, each with its cure; `good` where there is none."""
    found = [reasons[name] for name in names if name in reasons]
    return " ".join([_refusal(found), *(f"{one.text} {one.cure}" for one in found)]) if found else good


def _refusal(found: Sequence[Reason]) -> str:
    return "No." if Verdict(tuple(found)).is_red else "In doubt."


def cameras_in_words(calibration: Calibration) -> str:
    """One sentence: the model of the cameras, and their distance where it is finite."""
    if calibration.pair.is_affine:
        return f"The cameras are affine (model {calibration.model})."
    inverse, _ = calibration.inverse_distance_per_mm
    return f"The cameras are near: their distance is {1 / inverse:.0f} mm (model {calibration.model})."


def half_and_rest(
    data: Correspondences, chosen: np.ndarray, *, model: str = "zero_skew"
) -> tuple[Calibration | None, Correspondences]:
    """A calibration with the rows `chosen`, and the others with its offsets; None, with a line that says so, if too few."""
    rows = data.subset(chosen), data.subset(~chosen)
    try:
        if any(len(part.complete) < least for part, least in zip(rows, _ROWS, strict=True)):
            raise ValueError(f"a calibration needs {_ROWS[0]} landmarks seen in both images, its check {_ROWS[1]}.")
        half = calibrate(rows[0], model=model)
    except ValueError as error:
        print(f"No frames are held out, since the others alone give no calibration: {error}")
        return None, rows[1]
    return half, with_offsets(rows[1], half.offsets)


def held_out_gap_um(half: Calibration, held_out: Correspondences) -> np.ndarray:
    """Distances (n,) um of the held-out landmarks that both images show, triangulated by `half`, from the robot's report."""
    test = held_out.complete
    points = half.rig.triangulate(test.u_left, test.u_right, half.detection_covariance(test))
    return 1e3 * np.linalg.norm(points.x_mm - test.x_mm, axis=1)


def sealed(page: Figure, verdict: Verdict) -> Figure:
    """A figure with the verdict on the recording's calibration above its title, and the worst reason with its cure."""
    worst = verdict.reasons[0] if verdict.reasons else None
    text = f"Calibration: {verdict.level}." + (f" {worst.text} {worst.cure}" if worst else "")
    width = int(11 * page.get_figwidth())
    lines = [*textwrap.wrap(text, width), *filter(None, [page.get_suptitle()])]
    page.suptitle("\n".join(lines), x=0.01, ha="left", fontsize=10, color=report.VERDICT_COLOURS[verdict.level])
    return page


def whether_true(recording: Recording) -> str:
    """What judges the numbers of this recording: its truth, or else the verdict, held-out frames and labels."""
    if recording.truth is None:
        labels = " Its labels judge the detector (notebook 02)." if recording.annotations else ""
        judges = "The verdict judges its numbers, and in notebooks 00, 03, 05 and 07 held-out frames do."
        return f"This recording has no truth. {judges}{labels}"
    surface = "" if true_surface(recording) else " It holds no surface, so the errors of surfaces are not known."
    return f"This recording is simulated. Its truth judges the numbers and computes none of them.{surface}"


def true_surface(recording: Recording) -> Callable[[np.ndarray], np.ndarray] | None:
    """The true points (n, 3) mm seen at left pixels (n, 2), as a function; None where no truth holds a surface."""
    truth = recording.truth
    return truth.surface if truth and (truth.folder / "surface.npz").exists() else None


def health_chart(found: Health) -> Figure:
    """One number a frame: the worst of what the frame's landmarks and its picture show against the detector."""
    page, ax = figure(height_in=2.6)
    score = np.clip(np.nan_to_num(found.score, nan=1e2), 1e-2, 1e2)
    ax.semilogy(found.frame, score, "o", ms=4, color="#0072b2", label="worst part")
    low = score.min()
    if "unfamiliar" in found.parts:
        unfamiliar = np.maximum(found.parts["unfamiliar"][:, 0], 1e-2)
        ax.semilogy(found.frame, unfamiliar, "s", ms=3, color="#e69f00", label="unfamiliar picture")
        low = np.fmin.reduce(unfamiliar, initial=low)
    ax.axhline(1.0, color="#b42318", lw=1)
    ax.set(xlabel="frame", ylabel="score", ylim=(0.9 * low, max(2.0, 1.2 * score.max())))
    said = f"{(score > 1).sum()} of {len(score)} frames lie above the line. {found.text}."
    ax.set_title("\n".join(textwrap.wrap(said, 115)), fontsize=10)
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter("")
    page.legend(loc="outside lower center", fontsize=9, ncols=2)
    return page


def by_confidence(data: Correspondences) -> np.ndarray:
    """Positions of the frames in `data`, the surest first, by the confidence of the weakest of their six detections."""
    return np.argsort(-np.nan_to_num(data.grid("confidence").min(axis=(1, 2))), kind="stable")


def surest_and_least_sure(recording: Recording, data: Correspondences) -> Figure:
    """Six left images with their landmarks, evenly from the surest to the least sure; `data` holds all frames."""
    order = by_confidence(data)
    chosen = order[np.unique(np.linspace(0, len(order) - 1, 6).round().astype(int))]
    width, height = recording.image_size_px
    page, axes = figure(2, 3, width_in=12, height_in=8 * height / width + 1.2)
    for ax in axes.flat:
        ax.set_axis_off()
    weakest = np.nan_to_num(data.grid("confidence").min(axis=(1, 2)))
    for ax, k in zip(axes.flat, chosen, strict=False):
        show_image(ax, recording.frames[int(k)].left, f"Frame {k}: weakest confidence {weakest[k]:.2f}")
        landmarks_on(ax, data.grid("u_left")[k], label=False)
    return page
