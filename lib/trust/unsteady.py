"""Hypotheses about what varies from frame to frame: jaws, clocks, image shifts, zooms and robot positions.

Each frame has one or a few parameters of its own.  They are normally distributed with one standard deviation, which is
estimated.  The evidence of a hypothesis is integrated over them.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lib.trust.clocks import stamps_err
from lib.trust.fitting import SIDES, Case, Hypothesis, Robust, by_steps

_FEWEST_FRAMES = 8
_ROUNDS, _STEPS = 8, 10  # of the alternation between cameras and parameters; of the parameters' sd with given cameras
_GROWS = 1.02  # growth of the pixels' shift in a round, below which the rounds end while it is within the detector's error
_OF_ZOOM = 0.6  # least shift by a zoom over the detector's error: less than 1, as shared errors hardly look like a zoom
#: What to check if the images agree with each other and miss the robot.
ROBOT_ERRS = (
    "Check times, units, columns of kinematics.csv; the robot's accuracy, which may depend on its position; "
    "and how its poses become points: the tool's transform, and the convention of rotations (or are they inverse?)."
)
_WANDERS = (
    "Does the eye roll, and with it the pivot of the shaft? Does the microscope sway, the shaft bend, or the robot drift? "
    "Hold what moves, or calibrate shorter parts (--frames A:B)."
)
_FAR_MM = 1.0  # RMS, from which neither eye nor microscope is the reason
_COSINES = (2, 4, 8)  # numbers of cosines that are tried
#: Least share of the residuals that slow errors explain.  Errors of the detector that depend on the pose look alike; they
#: explained up to 0.26 in good recordings.
_LEAST_WANDERING = 0.4
_COMMON = 0.8  # share of the gain by times of each frame, above which one clock that is off is the reason
_MOST = 0.5  # least median size of the parameters over their RMS: gross errors only affect a part of the frames


def rigid_tips(case: Case) -> Iterator[Hypothesis]:
    """The robot reports tips at a constant distance while the jaws open."""
    problem, tips = case.problem, case.by_frame(case.problem.x[:, 0])
    width = np.linalg.norm(tips[:, 2] - tips[:, 1], axis=1)
    width = width[np.isfinite(width)]
    if len(width) < 6 or not is_constant(width):
        return
    half = problem.axes[:, :, 1] * np.array([0.0, -1.0, 1.0])[np.minimum(problem.landmark, 2), None]
    found = _by_frame(case, by_steps(half[..., None]), 0.2)
    size = 2.0 * float(found.theta.std())
    text = f"The robot always reports tips {width.mean():.2f} mm apart; in the images this varies by {size:.2f} mm."
    cure = "Log the opening of the jaws with the robot's pose, or calibrate with the base alone."
    yield case.found("rigid_tips", found.fit, 1, (size, 0.0, "mm"), text, cure, raw=found.raw)


def is_constant(width_mm: np.ndarray) -> bool:
    """True if the robot reports a constant opening of the jaws, apart from its noise."""
    return bool(width_mm.std() <= max(0.02 * width_mm.mean(), 0.03))


def unsteady(case: Case) -> Iterator[Hypothesis]:
    """All landmarks of a frame deviate together: by the robot's position, by the time, or as an image shifts or zooms."""
    problem = case.problem
    if case.frames < _FEWEST_FRAMES or np.ptp(problem.landmark) == 0:  # too few to distinguish these from noise
        return
    found = _by_frame(case, lambda M: np.broadcast_to(M[:, :, :3], (len(problem), 2, 2, 3)), 0.05)
    size, each = np.sqrt(3.0) * found.sd, [problem.x[problem.landmark == k, 0] for k in np.unique(problem.landmark)]
    moves = max(np.ptp(x, axis=0).max() for x in each) > case.robot_mm
    if moves and _is_distinct(case, found) and size > case.robot_mm:
        text = f"From frame to frame images and robot differ by {size:.2g} mm (RMS), equally for all landmarks."
        cure = f"Fix the microscope and the robot's base. {ROBOT_ERRS}"
        yield case.found("robot_noise", found.fit, 1, (1e3 * size, 0.0, "um"), text, cure, raw=found.raw)
    if moves and case.paths:
        velocity = np.nan_to_num(case.velocity())
        found = _by_frame(case, by_steps(velocity[..., None]), 0.02)
        late = case.fits.get("clock", case.null)
        if _is_distinct(case, found) and late.total - case.null.total < _COMMON * found.raw:
            weight = np.bincount(problem.frame, (velocity**2).sum(axis=1), case.frames)  # a robot at rest shows no times
            mean_s = float(np.average(found.theta[:, 0], weights=weight))
            sd_s = float(np.sqrt(np.average((found.theta[:, 0] - mean_s) ** 2, weights=weight)))
            text_and_cure = stamps_err(sd_s, mean_s)
            yield case.found("time_stamps", found.fit, 1, (1e3 * sd_s, 0.0, "ms"), *text_and_cure, raw=found.raw)
    shift = np.broadcast_to(np.eye(2), (len(problem), 2, 2, 2))
    zoom = 0.01 * np.nan_to_num(problem.y - problem.centre_px)[..., None]
    sways = shift, 3.0, 1.0, "px", "image_sways", "shifts", "Fix that camera, and turn off image stabilisation."
    zooms = zoom, 1.0, _OF_ZOOM, "%", "zoom_varies", "zooms in and out", "Record without autofocus, at one zoom."
    for views, (columns, sd, share, unit, name, does, cure) in (
        ((0,), sways), ((1,), sways), ((0, 1), zooms), ((0,), zooms), ((1,), zooms)
    ):  # fmt: skip
        moved = np.concatenate([columns * (np.arange(2) == view)[:, None, None] for view in views], axis=3)
        found = _by_frame(case, lambda M, moved=moved: moved, sd)
        if _is_distinct(case, found, share):
            who = "Each image" if len(views) == 2 else f"The {SIDES[views[0]]} image alone"
            size = found.sd * np.sqrt(columns.shape[3])
            text = f"{who} {does} from frame to frame, by {size:.2g} {unit} (RMS)."
            yield case.found(name, found.fit, 1, (size, 0.0, unit), text, cure, raw=found.raw, images=views)


def wanders(case: Case) -> Iterator[Hypothesis]:
    """The robot's report deviates slowly, equally for all landmarks: the deviation is a sum of few cosines of the time.

    What a clock explains that is off is not counted, because on a slow path its error is such a deviation.
    """
    problem, time = case.problem, case.problem.time
    if case.frames < _FEWEST_FRAMES or not np.isfinite(time).all() or np.ptp(time) == 0:
        return
    velocity, found = np.nan_to_num(case.velocity())[:, :, None] if case.paths else np.zeros((len(time), 3, 0)), []

    late = case.linear(by_steps(velocity))
    for count in (count for count in _COSINES if 3 * count <= case.frames / 2):
        cosines = np.cos(np.pi * np.arange(1, count + 1) * (time - time.min())[:, None] / np.ptp(time))  # (n, count)
        along = (np.eye(3)[:, :, None] * cosines[:, None, None]).reshape(len(time), 3, -1)
        fit = case.linear(by_steps(np.concatenate([velocity, along], axis=2)))
        wandered_mm = along @ fit.theta[velocity.shape[2] :]
        size = float(np.sqrt(((wandered_mm - wandered_mm.mean(axis=0)) ** 2).sum(axis=1).mean()))
        moved_px = np.einsum("cij,nj->nci", fit.M[:, :, :3], wandered_mm - wandered_mm.mean(axis=0))[problem.used]
        if size > case.robot_mm and np.sqrt((moved_px**2).sum(axis=1).mean()) > _claimed_px(case):
            text = f"Over seconds images and robot differ by {size:.2g} mm (RMS), equally for all landmarks."
            cure = _WANDERS if size < _FAR_MM else f"Neither eyes nor microscopes move that far. {ROBOT_ERRS}"
            size_um, raw = (1e3 * size, 0.0, "um"), fit.total - late.total
            found.append(case.found("robot_wanders", fit, 3 * count, size_um, text, cure, raw=raw))
    by_clock = 1.0 - np.exp(-(late.total - case.null.total) / problem.used.sum())
    least = max(_LEAST_WANDERING, 2.0 * by_clock)  # a clock that explains half as much is corrected first
    yield from sorted((one for one in found if one.explained > least), key=lambda one: one.gain)[-1:]


class _PerFrame(NamedTuple):
    """Parameters of the frames, and the fit with them."""

    fit: Robust
    theta: np.ndarray  # (frames, k)
    sd: float  # of theta, which is normally distributed
    moved_px: float  # RMS shift of the pixels by theta
    raw: float  # gain in log likelihood, integrated over theta


def _is_distinct(case: Case, found: _PerFrame, share: float = 1.0) -> bool:
    """True if most frames have large parameters, and these shift pixels by more than `share` times the detector's error.

    Detection errors that the landmarks of a frame share look like these causes.
    """
    size2 = (found.theta**2).sum(axis=1)
    return bool(np.median(size2) > _MOST**2 * size2.mean() and found.moved_px > share * _claimed_px(case))


def _claimed_px(case: Case) -> float:
    """The detector's error, px: as it states, else from the residuals."""
    return case.problem.claimed_px() or np.sqrt(2.0) * case.null.shapes[0].scale


def _by_frame(case: Case, columns: Callable[[np.ndarray], np.ndarray], sd: float) -> _PerFrame:
    """Fit parameters of each frame; columns(M) (n, 2, 2, k) are derivatives of the pixels by them, `sd` is a first guess."""
    problem = moved = case.problem
    fit, moved_px = case.null, 0.0
    for _ in range(_ROUNDS):
        D, shape = columns(fit.M), fit.shapes[0]
        k, r2 = D.shape[3], (fit.residuals**2).sum(axis=2) / problem.noise**2
        weight = np.where(problem.used, (shape.freedom + 2.0) / (shape.freedom * shape.scale**2 + r2) / problem.noise**2, 0.0)
        r = np.nan_to_num(problem.y - moved.y + fit.residuals)  # residuals without these parameters
        H, b = np.zeros((case.frames, k, k)), np.zeros((case.frames, k))
        np.add.at(H, problem.frame, np.einsum("nc,ncia,ncib->nab", weight, D, D))
        np.add.at(b, problem.frame, np.einsum("nc,ncia,nci->na", weight, D, r))
        H, axes = np.linalg.eigh(H)  # (frames, k), and the axes along which the parameters of a frame are independent
        b = (b[:, None] @ axes)[:, 0]
        for _ in range(_STEPS):
            variance = 1.0 / (H + sd**-2)
            theta = variance * b
            sd = max(float(np.sqrt((theta**2 + variance).mean())), 1e-6)
        theta = (axes @ theta[..., None])[..., 0]
        shift = np.einsum("ncia,na->nci", D, theta[problem.frame])
        moved = replace(problem, y=problem.y - shift)
        fit = moved.fit(start=fit.start, rounds=5)
        own, before_px = problem.used & (shift != 0).any(axis=2), moved_px
        moved_px = float(np.sqrt((shift**2).sum(axis=2)[own].mean())) if own.any() else 0.0
        if moved_px < min(_GROWS * before_px, _claimed_px(case)):
            break
    penalty = 0.5 * float(np.log1p(sd**2 * H).sum() + ((theta / sd) ** 2).sum())  # Laplace's approximation of the integral
    return _PerFrame(fit, theta, sd, moved_px, fit.total - case.null.total - penalty)


#: Causes with so many parameters over the time that they leave white residuals, whatever is wrong.
OF_FRAMES = ("robot_noise", "robot_wanders", "time_stamps", "image_sways", "zoom_varies")
#: Tests that only need the rows; some also use the tool's path over time if there is one.
FRAME_TESTS = (rigid_tips, unsteady, wanders)
