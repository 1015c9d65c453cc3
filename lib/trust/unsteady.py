"""Hypotheses about what changes from frame to frame: jaws, clocks, images, zooms and robots that do not keep still.

Each frame has a number of its own, or a few.  These are normal with one standard deviation, which is estimated; the evidence
of a hypothesis integrates over them.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lib.trust.fitting import SIDES, Case, Hypothesis, Robust

_FEWEST_FRAMES = 8
_ROUNDS, _STEPS = 8, 10  # of cameras beside the numbers, and of the numbers' deviation beside given cameras
_GROWS = 1.02  # numbers that tell nothing yet must move the pixels by so much more than in the round before
_OF_ZOOM = 0.6  # of the detector's errors, by which a zoom must move landmarks: those that they share look less like one
_MOST = 0.5  # by so much of its RMS a number must differ from 0 in most frames: gross errors are in a part of them


def rigid_tips(case: Case) -> Iterator[Hypothesis]:
    """The robot reports tips at a fixed distance while the jaws open."""
    problem, tips = case.problem, case.by_frame(case.problem.x[:, 0])
    width = np.linalg.norm(tips[:, 2] - tips[:, 1], axis=1)
    width = width[np.isfinite(width)]
    if len(width) < 6 or not is_constant(width):
        return
    half = problem.axes[:, :, 1] * np.array([0.0, -1.0, 1.0])[np.minimum(problem.landmark, 2), None]
    found = _by_frame(case, lambda M: np.einsum("cij,nj->nci", M[:, :, :3], half)[..., None], 0.2)
    size = 2.0 * float(found.theta.std())
    text = f"The robot reports tips {width.mean():.2f} mm apart, always; in the images this varies by {size:.2f} mm."
    cure = "Log the opening of the jaws with the robot's pose, or calibrate with the base alone."
    yield case.found("rigid_tips", found.fit, 1, (size, 0.0, "mm"), text, cure, raw=found.raw)


def is_constant(width_mm: np.ndarray) -> bool:
    """Whether the robot reports one opening of the jaws, but for its noise."""
    return bool(width_mm.std() <= max(0.02 * width_mm.mean(), 0.03))


def unsteady(case: Case) -> Iterator[Hypothesis]:
    """Robot and images part from frame to frame, all landmarks alike: anyhow, or in time; or an image sways, or zooms."""
    problem = case.problem
    if case.frames < _FEWEST_FRAMES or np.ptp(problem.landmark) == 0:  # too little to tell such numbers from noise
        return
    found = _by_frame(case, lambda M: np.broadcast_to(M[:, :, :3], (len(problem), 2, 2, 3)), 0.05)
    size, each = np.sqrt(3.0) * found.sd, [problem.x[problem.landmark == k, 0] for k in np.unique(problem.landmark)]
    moves = max(np.ptp(x, axis=0).max() for x in each) > case.robot_mm
    if moves and _tells(case, found) and size > case.robot_mm:
        text = f"From frame to frame images and robot part by {size:.2g} mm (RMS), all landmarks alike."
        cure = "Fix the microscope and the robot's base; check times, units and columns of kinematics.csv."
        yield case.found("robot_noise", found.fit, 1, (1e3 * size, 0.0, "um"), text, cure, raw=found.raw)
    if moves and case.paths:
        velocity = np.nan_to_num(case.velocity())
        found = _by_frame(case, lambda M: np.einsum("cij,nj->nci", M[:, :, :3], velocity)[..., None], 0.02)
        if _tells(case, found):
            text = f"The times of the frames err by {1e3 * found.sd:.2g} ms (RMS), each by itself, or those of the log do."
            cure = "Write down when the camera exposed each frame, and the robot measured each position; do not round."
            yield case.found("time_stamps", found.fit, 1, (1e3 * found.sd, 0.0, "ms"), text, cure, raw=found.raw)
    shift = np.broadcast_to(np.eye(2), (len(problem), 2, 2, 2))
    zoom = 0.01 * np.nan_to_num(problem.y - problem.centre_px)[..., None]
    sways = shift, 3.0, 1.0, "px", "image_sways", "sways", "Fix that camera, and turn off stabilisation of the image."
    zooms = zoom, 1.0, _OF_ZOOM, "%", "zoom_varies", "zooms in and out", "Record without autofocus, at one zoom."
    for views, (columns, sd, share, unit, name, does, cure) in (
        ((0,), sways), ((1,), sways), ((0, 1), zooms), ((0,), zooms), ((1,), zooms)
    ):  # fmt: skip
        moved = np.concatenate([columns * (np.arange(2) == view)[:, None, None] for view in views], axis=3)
        found = _by_frame(case, lambda M, moved=moved: moved, sd)
        if _tells(case, found, share):
            who = "Each image" if len(views) == 2 else f"The {SIDES[views[0]]} image alone"
            size = found.sd * np.sqrt(columns.shape[3])
            text = f"{who} {does} from frame to frame, by {size:.2g} {unit} (RMS)."
            yield case.found(name, found.fit, 1, (size, 0.0, unit), text, cure, raw=found.raw, images=views)


class _Numbers(NamedTuple):
    """The frames' numbers theta (frames, k), normal with deviation sd, the fit beside them, and how far they move pixels."""

    fit: Robust
    theta: np.ndarray
    sd: float
    moved_px: float  # RMS
    raw: float  # gain in log likelihood, theta integrated out


def _tells(case: Case, found: _Numbers, share: float = 1.0) -> bool:
    """Whether most frames have such a number, and these move pixels by more than a share of what the detector may err by.

    Errors that the landmarks of a frame share look like these causes.
    """
    size2 = (found.theta**2).sum(axis=1)
    return bool(np.median(size2) > _MOST**2 * size2.mean() and found.moved_px > share * _claimed_px(case))


def _claimed_px(case: Case) -> float:
    """By how much the detector may err: as it says, else by the residuals."""
    return case.problem.claimed_px() or np.sqrt(2.0) * case.null.shapes[0].scale


def _by_frame(case: Case, columns: Callable[[np.ndarray], np.ndarray], sd: float) -> _Numbers:
    """The numbers of the frames of which each moves pixels by a column of columns(M) (n, 2, 2, k); `sd` is a first guess."""
    problem = moved = case.problem
    fit, moved_px = case.null, 0.0
    for _ in range(_ROUNDS):
        D, shape = columns(fit.M), fit.shapes[0]
        k, r2 = D.shape[3], (fit.residuals**2).sum(axis=2) / problem.noise**2
        weight = np.where(problem.used, (shape.freedom + 2.0) / (shape.freedom * shape.scale**2 + r2) / problem.noise**2, 0.0)
        left = np.nan_to_num(problem.y - moved.y + fit.residuals)  # by cameras without these numbers
        H, b = np.zeros((case.frames, k, k)), np.zeros((case.frames, k))
        np.add.at(H, problem.frame, np.einsum("nc,ncia,ncib->nab", weight, D, D))
        np.add.at(b, problem.frame, np.einsum("nc,ncia,nci->na", weight, D, left))
        H, axes = np.linalg.eigh(H)  # (frames, k), and the axes along which the numbers of a frame are independent
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
    chosen = 0.5 * float(np.log1p(sd**2 * H).sum() + ((theta / sd) ** 2).sum())
    return _Numbers(fit, theta, sd, moved_px, fit.total - case.null.total - chosen)


#: Causes that have so many numbers that they leave white residuals, whatever is wrong.
OF_FRAMES = ("robot_noise", "time_stamps", "image_sways", "zoom_varies")
#: They need nothing but the rows, and the tool's path in time where there is one.
FRAME_TESTS = (rigid_tips, unsteady)
