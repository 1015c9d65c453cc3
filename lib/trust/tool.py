"""Hypotheses about the tool that the robot reports: offsets of its landmarks, its length, its jaws, and whether it bends."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from lib.calibration.timing import shift_misfits
from lib.correspondences import LANDMARKS
from lib.trust.fitting import Case, Hypothesis, by_steps
from lib.trust.unsteady import is_constant

_LEAST_OFFSET_UM = 250  # a robot's tool calibration errs by tenths of a mm, and `calibrate` corrects such offsets
_SHARED_SDS = 8.0  # largest error, in its sd, of a shared offset along the shaft: from about 1 px that depends on the pose
_LEAST_LENGTH_MM = 1.0  # larger than the error of any tool calibration
_LENGTHS_MM = np.linspace(-5.0, 85.0, 37)  # lengths of the tool that are tried, if the robot's report lacks it
_OPENED = 1.25  # a smaller factor may come from constant offsets of the tips, which do no harm
_BENDS = 1.5  # least motion of a bent tool's tips, as a multiple of the error that the detector states for the base


def landmark_offset(case: Case) -> Iterator[Hypothesis]:
    """Landmarks with large offsets from the robot's report, constant in the tool's axes.

    A tool that turns about a pivot hardly determines an offset along the shaft that all landmarks share, since a change of
    the cameras looks nearly the same.  So of that part only what exceeds `_SHARED_SDS` standard deviations counts.
    """
    free = replace(case.problem, offset_sd=1.0).fit(start=case.null.start)
    covariance, along = free.offset_covariance, np.tile([1.0, 0.0, 0.0], 3)
    shared, shared_sd = np.median(free.offsets[:, 0]), np.sqrt(along @ covariance @ along) / 3
    counts = shared - np.clip(shared, -_SHARED_SDS * shared_sd, _SHARED_SDS * shared_sd)
    offsets, rest = free.offsets + (counts - shared) * along.reshape(3, 3), np.eye(9) - np.outer(along, along) / 3
    variance = np.diag(rest @ covariance @ rest).reshape(3, 3).sum(axis=1) + (counts != 0) * shared_sd**2
    sizes, sds = 1e3 * np.linalg.norm(offsets, axis=1), 1e3 * np.sqrt(variance)
    size, sd = sizes.max(), sds[sizes.argmax()]
    if size - 2.0 * sd > _LEAST_OFFSET_UM:
        far = [k for k in np.argsort(-sizes) if sizes[k] > 2.0 * sds[k]]
        each = [f"{LANDMARKS[k]} by {sizes[k]:.0f} um ({', '.join(f'{1e3 * v:.0f}' for v in offsets[k])})" for k in far]
        text = f"Landmarks have constant offsets from the robot's report, in the tool's axes: {'; '.join(each)}."
        cure = "Robot or detector errs; labels set by hand show which. `calibrate` removes such offsets (--force if refused)."
        longer_mm = offsets[0, 0] - offsets[1:, 0]  # by which the log's jaws are longer than those in the images
        if 1e3 * np.abs(longer_mm).min() > _LEAST_OFFSET_UM and longer_mm.prod() > 0:
            how = f"{np.abs(longer_mm).mean():.2f} mm too {'long' if longer_mm[0] > 0 else 'short'}"
            cure += f" If the detector is right, the jaws in the robot's geometry may be {how}."
        found = case.found("landmark_offset", free, 9, (size, sd, "um"), text, cure)
        certainty = 0.5 * ((size - _LEAST_OFFSET_UM) / sd) ** 2  # the fit absorbs offsets, so residuals show none
        yield replace(found, gain=max(found.gain, float(certainty)), explained=float(1.0 - _LEAST_OFFSET_UM / size))


def tool_length(case: Case) -> Iterator[Hypothesis]:
    """One offset of all landmarks: the robot reports another point of the tool, such as its flange."""
    problem, fits = case.problem, []
    y = np.where(problem.used[:, :, None], problem.y, np.nan).reshape(-1, 4)
    for axes in (problem.axes, case.smooth_axes()):
        along = axes[:, None, :, 0]
        misfit = shift_misfits(problem.x[:, 0] + _LENGTHS_MM[:, None, None] * along[:, 0], y)
        start_mm = _LENGTHS_MM[misfit.sum(axis=1).argmin()]
        moved = replace(problem, x=problem.x + start_mm * along)
        fit = moved.fit(by_steps(axes))
        fits.append((fit.total, fit, fit.theta + [start_mm, 0.0, 0.0]))
    _, fit, offset_mm = max(fits, key=lambda one: one[0])
    size_mm, sd_mm = float(np.linalg.norm(offset_mm)), float(np.sqrt(np.trace(fit.covariance)))
    if size_mm - 2.0 * sd_mm > _LEAST_LENGTH_MM:
        each = ", ".join(f"{v:.2f}" for v in offset_mm)
        text = f"All landmarks lie {size_mm:.1f} mm from where the robot reports them ({each} mm in the tool's axes)."
        cure = "Does the robot report its flange? Tell it the tool's length, or add it to all columns of kinematics.csv."
        yield case.found("landmark_offset", fit, 3, (1e3 * size_mm, 1e3 * sd_mm, "um"), text, cure)


def tool_bends(case: Case) -> Iterator[Hypothesis]:
    """Tips that move more or less than the base, as if the tool bent."""
    tips = case.problem.landmark > 0
    if 0 < tips.mean() < 1 and case.problem.landmark.max() <= 2:
        x = case.problem.x * tips[:, None, None]
        fit = case.linear(by_steps(np.kron(np.eye(3), x[:, :, None])))
        size = float(np.sqrt((fit.moved_px[tips] ** 2).sum(axis=2).mean()))
        if size < _BENDS * case.problem.claimed_px(~tips):
            return  # the detector's error at the base is as large
        text = f"The tips move {size:.1f} px (RMS) more or less than the base: a tool that bends, or a wrong pivot or angle."
        cure = "Check the tool's geometry and joint angles in the robot's report (lib.calibration.pivot_calibration)."
        yield case.found("tool_bends", fit, 9, (size, 0.0, "px"), text, cure)


def jaw_opening(case: Case) -> Iterator[Hypothesis]:
    """Tips whose distance is the reported one times a factor, or a constant minus the reported one.

    With a constant opening this would only be an offset.
    """
    tips = case.by_frame(case.problem.x[:, 0])[:, 1:]
    across = tips[:, 1] - tips[:, 0]
    each = np.linalg.norm(across, axis=1)
    width = each[np.isfinite(each)]
    if case.problem.landmark.max() != 2 or not len(width) or is_constant(width):
        return
    share = np.array([0.0, -0.5, 0.5])[case.problem.landmark]
    half = across[case.problem.frame] * share[:, None]
    fit = case.linear(by_steps(half[..., None]))
    factor, sd = 1.0 + float(fit.theta[0]), float(np.sqrt(fit.covariance[0, 0]))
    # Where the opening changes little, factor and offsets may cancel; then the factor without offsets is near 1.
    y = case.problem.y
    shown, told = (np.diff(case.by_frame(u)[:, 1:], axis=1) for u in (y, y - case.problem.missed(case.null, case.problem.x)))
    plain = float(np.nanmedian((shown * told).sum(axis=-1) / (told**2).sum(axis=-1)))
    nearer = 0.0 < factor < 1.0 / _OPENED and plain < _OPENED**-0.5  # below 0 the tips are exchanged
    if nearer or (factor > _OPENED and plain > _OPENED**0.5):
        text = f"In the images the tips are {factor:.2f} +- {sd:.2f} times as far apart as in the robot's report."
        cure = "Does the robot's log state the opening of one jaw or of both? Check that, and the length of the jaws."
        yield case.found("jaw_opening", fit, 1, (factor, sd, "times"), text, cure)
    halves = np.stack([half, half / np.maximum(each, 1e-9)[case.problem.frame, None]], axis=2)
    fit = case.linear(by_steps(halves))
    slope, sd, shut = 1.0 + float(fit.theta[0]), float(np.sqrt(fit.covariance[0, 0])), float(fit.theta[1])
    if slope + 3.0 * sd < 0.0 < shut + slope * np.median(width):  # the median is below 0 if the tips are exchanged
        text = f"The jaw's signal runs the other way: tips that the robot reports {-shut / slope:.2f} mm apart are shut."
        cure = "Reverse the opening of the jaws in the robot's log, or their angle: it shrinks where the images show it grow."
        yield case.found("jaw_opening", fit, 2, (slope, sd, "times"), text, cure)
