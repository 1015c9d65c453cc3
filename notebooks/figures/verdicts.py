"""Can the calibration of a recording be trusted?  Verdicts in words and figures, and the check by held-out frames."""

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

#: Fewest complete rows of a calibration that held-out frames judge, and fewest complete rows of these frames.
_ROWS = (12, 3)
#: Number of labelled stereo frames, far apart, that is enough to calibrate; reasons for doubt if there are fewer.
_ENOUGH_LABELS = 10
_OF_FEW = ("few_frames", "few_rows", "coverage", "cross_validation")
#: Reasons that mean too little motion; uncertain cameras (from too little motion or from any other cause); wrong times.
_MOTION, _UNSURE = ("few_frames", "one_line", "one_plane", "thin"), ("coverage", "few_rows", "cross_validation")
_TIMES = ("clock", "clock_rate", "frame_order", "time_stamps", "video_times", "frame_times", "little_overlap", "slow_log")
_TIMES += ("repeated_samples",)
#: Reasons that point to the detector, if the diagnosis names no cause.
_LOST = ("no_detection", "no_consensus", "minority")
#: Fewest and most stereo frames to label: fewer teach little, and more are rarely needed.
_FEWEST, _MOST = 10, 20
#: The caption of a `health_chart`.
HEALTH_CAPTION = (
    "The score of each frame. It lies above the red line if the landmarks contradict the other image, the robot or a second "
    "detection in the mirrored or shifted image, if the tool's length differs from the robot's, or if the picture is unlike "
    "the training pictures."
)


def believed(assessed: Assessment, *, force: bool, affine: bool = False) -> Calibration:
    """Returns the calibration of a recording.

    The notebook ends here, with the reason, if there is no calibration, if its verdict is red (unless `force`), or if the
    notebook needs `affine` cameras and these have a finite distance.
    """
    left_out = "So the results that need the cameras (surface, distance, registration) are not computed, and the rest of this"
    left_out += " notebook is left out. The verdict above states the reasons, and what to do."
    if assessed.calibration is None:
        report.stop(f"The cameras could not be calibrated from this recording. {left_out}")
    if assessed.verdict.is_red and not force:
        anyway = "With `-p force True` the notebook continues anyway."
        report.stop(f"The calibration of this recording is not trustworthy. {left_out} {anyway}")
    if affine and not assessed.calibration.pair.is_affine:
        report.stop(
            "The cameras of this recording have a finite distance. The steps of this notebook hold for affine cameras "
            "only, so the rest is left out. Notebooks 00 and 07 reconstruct with cameras at a finite distance."
        )
    return assessed.calibration


def labelled_pairs(recording: Recording, frames: range) -> int:
    """The number of stereo frames, among `frames`, in which a landmark is labelled in both images."""
    if (marks := recording.annotations) is None:
        return 0
    return int((np.isfinite(marks.u_left) & np.isfinite(marks.u_right)).all(axis=2).any(axis=1)[frames].sum())


def asking_for_labels(recording: Recording, assessed: Assessment, frames: range) -> Assessment:
    """An assessment by the labels of `frames`; if these are few, its cures ask for more labels, not more frames."""
    pairs = labelled_pairs(recording, frames)
    if pairs >= min(_ENOUGH_LABELS, len(frames)):
        return assessed
    where = shlex.quote(paths.shown(recording.folder))
    cure = f"Label more stereo frames, far apart: `python3 -m lib annotate {where}`. {_ENOUGH_LABELS} are enough."
    reasons = [replace(one, cure=cure) if one.name in _OF_FEW else one for one in assessed.verdict.reasons]
    return replace(assessed, verdict=Verdict(tuple(reasons)))


def in_words(
    recording: Recording, assessed: Assessment, next_step: str | None
) -> tuple[dict[str, str], int, str]:  # fmt: skip
    """Answers to the questions of a recording's user, the number of bad frames, and a note on that number.

    If the diagnosis names a cause, its cure comes first, and doubts that may follow from it are not blamed on other things.

    Args:
        next_step: `Check.next_step`; None if labels take the place of the detector.
    """
    reasons = {reason.name: reason for reason in assessed.verdict.reasons}
    cause, health = assessed.diagnosis.best, assessed.health
    vague = ("detector_unfit",) if next_step else ("detector_unfit", "robot_noise")  # wrong labels look like noise, too
    named = cause is not None and cause.name in reasons and cause.name not in vague
    frames, note = len(health.frame), f"of {len(health.frame)}: score above 1"
    if named and cause.name not in OF_DETECTOR:
        health = health.beside(cause)
        note += " without the comparisons that another cause spoils"
    missed = np.zeros(frames, dtype=bool)
    if next_step:  # frames without labels are not bad
        missed, note = ~health.seen.any(axis=1), f"{note}, or no landmark found"
    bad = int(((health.score > 1) | missed).sum())

    moved = "Yes."
    if named and any(name in reasons for name in _UNSURE):
        moved = "Not known until the cause below is removed: it makes the cameras uncertain."
    if assessed.calibration is None:
        moved = "Not known: the cameras could not be calibrated."
    unfit = [reasons[name] for name in (*OF_DETECTOR, "base", *(() if named else _LOST)) if name in reasons]
    first = reasons[cause.name] if named else next(iter(reasons.values()), None)
    if unfit and not named and not next_step:  # doubts about the labels come before doubts that may follow from them
        first = unfit[0]
    then = "Nothing: go on." if first is None else first.cure
    unmentioned = named and first.name not in _MOTION + _TIMES  # no other answer states the cause
    if unmentioned or (first and first.name == "refused"):  # the cure alone would not say what is wrong
        then = f"{first.text} {first.cure}"
    if next_step and assessed.verdict.is_red and next_step == recording.mistimed:
        then = next_step  # while the times are wrong, nothing else is known
    elif next_step and unfit and not named:
        then = f"Adapt; then label {min(max(bad, _FEWEST), _MOST)} stereo frames."
    usable = "Yes."
    if unfit:
        why = "" if named else f"{unfit[0].text} "
        usable = f"{_refusal(unfit)} {why}{bad} of {frames} frames are bad."
    answers = {
        "Enough motion?": _answer(reasons, _MOTION if named else _MOTION + _UNSURE, moved),
        "Do the clocks agree?": _answer(reasons, _TIMES, "Nothing speaks against it."),
        "Is the detector usable?": usable if next_step else "Not asked: your labels take its place.",
        "Then what?": then,
    }
    return answers, bad, note


def _answer(reasons: Mapping[str, Reason], names: Sequence[str], good: str) -> str:
    """The texts and cures of the reasons with these names; `good` if there is none."""
    found = [reasons[name] for name in names if name in reasons]
    return " ".join([_refusal(found), *(f"{one.text} {one.cure}" for one in found)]) if found else good


def _refusal(found: Sequence[Reason]) -> str:
    return "No." if Verdict(tuple(found)).is_red else "In doubt."


def cameras_in_words(calibration: Calibration) -> str:
    """One sentence: the model of the cameras, and their distance if it is finite."""
    if calibration.pair.is_affine:
        return f"The cameras are affine (model {calibration.model})."
    inverse, _ = calibration.inverse_distance_per_mm
    return f"The cameras have a finite distance, {1 / inverse:.0f} mm (model {calibration.model})."


def half_and_rest(
    data: Correspondences, chosen: np.ndarray, *, model: str = "zero_skew"
) -> tuple[Calibration | None, Correspondences]:
    """Calibrates with the rows `chosen`; returns the calibration and the other rows, corrected by its offsets.

    If there are too few rows, it prints this, and returns None and the other rows as they are.
    """
    rows = data.subset(chosen), data.subset(~chosen)
    try:
        if any(len(part.complete) < least for part, least in zip(rows, _ROWS, strict=True)):
            raise ValueError(f"the calibration needs {_ROWS[0]} landmarks seen in both images, and its check {_ROWS[1]}.")
        half = calibrate(rows[0], model=model)
    except ValueError as error:
        print(f"No frames are held out, since the rest is not enough to calibrate: {error}")
        return None, rows[1]
    return half, with_offsets(rows[1], half.offsets)


def held_out_gap_um(half: Calibration, held_out: Correspondences) -> np.ndarray:
    """Distances (n,) um between held-out landmarks (in both images, triangulated by `half`) and the robot's report."""
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
    """States what judges the numbers of this recording: its truth, or else the verdict, held-out frames and labels."""
    if recording.truth is None:
        labels = " Its labels judge the detector (notebook 02)." if recording.annotations else ""
        judges = "The verdict judges its numbers, in notebooks 00, 03, 05 and 07 together with held-out frames."
        return f"This recording has no truth. {judges}{labels}"
    surface = "" if true_surface(recording) else " It holds no surface, so the errors of surfaces are unknown."
    return f"This recording is simulated. Its truth judges the numbers, and is not used to compute them.{surface}"


def true_surface(recording: Recording) -> Callable[[np.ndarray], np.ndarray] | None:
    """The function from left pixels (n, 2) to the true points (n, 3) mm seen there; None without a true surface."""
    truth = recording.truth
    return truth.surface if truth and (truth.folder / "surface.npz").exists() else None


def health_chart(found: Health) -> Figure:
    """The score of each frame: the strongest evidence against the detector, from the frame's landmarks and its picture."""
    page, ax = figure(height_in=2.6)
    score = np.clip(np.nan_to_num(found.score, nan=1e2), 1e-2, 1e2)
    ax.semilogy(found.frame, score, "o", ms=4, color="#0072b2", label="score of the frame")
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
    """Indices of the frames in `data`, sorted by the lowest confidence of the six detections, the highest first."""
    return np.argsort(-np.nan_to_num(data.grid("confidence").min(axis=(1, 2))), kind="stable")


def surest_and_least_sure(recording: Recording, data: Correspondences) -> Figure:
    """Six left images with their landmarks, evenly spaced from the most to the least confident; `data` holds all frames."""
    order = by_confidence(data)
    chosen = order[np.unique(np.linspace(0, len(order) - 1, 6).round().astype(int))]
    width, height = recording.image_size_px
    page, axes = figure(2, 3, width_in=12, height_in=8 * height / width + 1.2)
    for ax in axes.flat:
        ax.set_axis_off()
    weakest = np.nan_to_num(data.grid("confidence").min(axis=(1, 2)))
    for ax, k in zip(axes.flat, chosen, strict=False):
        show_image(ax, recording.frames[int(k)].left, f"Frame {k}: lowest confidence {weakest[k]:.2f}")
        landmarks_on(ax, data.grid("u_left")[k], label=False)
    return page
