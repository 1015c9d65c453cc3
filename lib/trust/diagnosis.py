"""What is wrong with a recording: hypotheses fitted to its correspondences, and compared with "nothing is wrong".

Those about time are in `lib.trust.clocks`.  Each is fitted under heavy-tailed noise (`lib.trust.fitting`).  Its gain in log
likelihood, less a penalty for its parameters (BIC), is its evidence.
"""

from collections import ChainMap
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from scipy.ndimage import binary_opening

from lib.calibration.checks import eyes_exchanged, sides
from lib.correspondences import LANDMARKS, TRAIN_FURTHER, Correspondences
from lib.recordings import Kinematics
from lib.trust.clocks import TIME_TESTS
from lib.trust.fitting import FITS, SIDES, Case, Hypothesis, Problem, Robust, compared
from lib.trust.health import affine_epipolar

_MOST_ROWS, _FEWEST_FRAMES = 1200, 4  # of three frames nothing checks anything
_UNFIT = f"The detector does not fit these pictures: look at its overlays, {TRAIN_FURTHER}."
_SCALE = "Check the units and the scale of the {} columns of kinematics.csv, beside those of the others."
_ROBOT_MM = 0.04  # a robot for eye surgery is better
#: Standard deviations of a camera's skew and log pixel aspect.
_SKEW_SD, _ASPECT_SD = 0.002, 0.003
#: A common log aspect above this is no lens: the images were resized, and their aspect is free.
_RESIZED = 0.1
#: Of the jaws' lengths in the log: stretches of time whose means count, and parts of time that err apart.
_STRETCHES, _PARTS = 60, 8
#: Least change of length^-2 by a scaled axis, also in standard deviations, and that which a good robot may have.
_LEAST_SCALED, _SURE_SCALED, _OWN_SD = 0.03, 5.0, 0.006
#: Least share of the variance that it explains, most that it leaves (RMS), and least turning of the jaws (RMS of n^2).
_MOST_OF_IT, _ODD, _TURNED = 0.5, 0.03, 0.01
_RESTS, _RESTS_MM = 4, 0.06  # a tool rests whose landmarks are where they were so many frames before, noise included
_STILL_PX = 0.3  # detections of one picture differ by less
BY_GEOMETRY = ("scaled_axis", "mirrored_axis", "exchanged_eyes", "mirrored_images")  # which the residuals do not show
_ACROSS = 0.15  # sine of a tool's angle to the images, below which it points neither way
_UPSIDE_DOWN = 20.0  # odds that a microscope sees the tips of a tool below its base


def _tip_order(case: Case) -> Iterator[Hypothesis]:
    """Another landmark's position: tips exchanged in both images, in one, or the base taken for a tip."""
    problem = case.problem
    if problem.landmark.max() != 2:
        return
    table = case.by_frame(problem.x[:, 0])
    others = [(order, (0, 1)) for order in permutations(range(3)) if order != (0, 1, 2)]
    for order, views in (*others, ((0, 2, 1), (0,)), ((0, 2, 1), (1,))):
        x = problem.x.copy()
        x[:, list(views)] = table[problem.frame, np.array(order)[problem.landmark]][:, None]
        if (moved := replace(problem, x=x)).used.all(axis=1).sum() < 6:
            continue
        where, call = ("both images", "call") if len(views) == 2 else (f"the {SIDES[views[0]]} image", "calls")
        text = f"What {where} {call} {', '.join(LANDMARKS)} is {', '.join(LANDMARKS[k] for k in order)} for the robot."
        cure = f"Bring the columns of kinematics.csv, or the detections of {where}, into one order."
        mirrored = "both images are mirrored, flip them" if len(views) == 2 else "that image is mirrored, flip it"
        cure += f" If {mirrored} instead." if order == (0, 2, 1) else ""
        yield case.found("tip_order", moved.fit(), 1, (1.0, 0.0, ""), text, cure, on=moved, images=views)
    swapped = table[:, [0, 2, 1]][problem.frame, problem.landmark]  # frame by frame: one bit each
    fit, moved, own = case.chosen(np.stack([problem.x[:, 0], swapped]))
    text = f"The tips are exchanged in {100 * own.mean():.0f} % of the frames."
    cure = "Tell the tips apart by the tool's roll, as the robot does; or train the detector with tips in the robot's order."
    raw = fit.total - case.null.total - case.frames * np.log(2.0)
    yield case.found("tip_order", fit, 1, (100 * own.mean(), 0.0, "%"), text, cure, on=moved, raw=raw)


def _finite_distance(case: Case, fit: Robust) -> Iterator[Hypothesis]:
    """A perspective that an affine camera has not, beside the best cause so far."""
    value, sd = fit.nearness
    far = f"by a working distance of {1 / value:.0f} mm" if value > 0 else "the wrong way, as in a mirrored image"
    text = f"The residuals are curved {far}: 1/distance is {value:.5f} +- {sd:.5f} per mm."
    cure = "Calibrate with model='near_affine' (--model near_affine on the command line)."
    n = 2.0 * case.problem.used.sum()
    beside = 0.5 * n * float(np.log1p(fit.design * (value / sd) ** 2 / n))  # Wald's test as a ratio of likelihoods
    raw = min(case.null.total - replace(case.problem, nearness_sd=1e-9).fit(start=case.null.start).total, beside)
    yield case.found("finite_distance", fit, 1, (value, sd, "1/mm"), text, cure, raw=raw)


def _landmark_offset(case: Case) -> Iterator[Hypothesis]:
    """Landmarks that the robot reports far beside where they are seen, always in the tool's same direction."""
    free = replace(case.problem, offset_sd=1.0).fit(start=case.null.start)
    size = 1e3 * np.linalg.norm(free.offsets, axis=1)
    k = int(size.argmax())
    if size[k] >= 150:
        along = ", ".join(f"{1e3 * v:.0f}" for v in free.offsets[k])
        text = f"{LANDMARKS[k]} is seen {size[k]:.0f} um beside the robot's report ({along} um in the tool's axes)."
        cure = "Correct the tool's geometry in the robot's report. --force goes on: `calibrate` removes such offsets."
        yield case.found("landmark_offset", free, 9, (size[k], 1e3 * free.offset_sd[k], "um"), text, cure)


def _tool_bends(case: Case) -> Iterator[Hypothesis]:
    """Tips that move by other amounts than the base."""
    tips = case.problem.landmark > 0
    if 0 < tips.mean() < 1:
        x = case.problem.x * tips[:, None, None]
        fit = case.linear(lambda M: np.einsum("cij,nck->ncijk", M[:, :, :3], x).reshape(*x.shape[:2], 2, 9))
        size = float(np.sqrt((fit.moved_px[tips] ** 2).sum(axis=2).mean()))
        text = f"The tips move {size:.1f} px (RMS) more or less than the base: a tool that bends, or a wrong pivot or angle."
        cure = "Check the tool's geometry and joint angles in the robot's report (lib.calibration.pivot_calibration)."
        yield case.found("tool_bends", fit, 9, (size, 0.0, "px"), text, cure)


def _drift(case: Case) -> Iterator[Hypothesis]:
    """Images that creep at a constant speed."""
    time = case.problem.time
    if np.isfinite(time).all() and np.ptp(time) > 0:
        fit = case.linear(np.eye(4).reshape(1, 2, 2, 4) * ((time - time.mean()) / np.ptp(time))[:, None, None, None])
        size, sd = np.array([np.linalg.norm(fit.theta), np.sqrt(np.trace(fit.covariance))]) / np.sqrt(2.0)
        text = f"The images creep by {size:.1f} px from the first frame to the last."
        cure = "Fix the microscope, or calibrate a shorter part (Correspondences.of_frames)."
        yield case.found("drift", fit, 4, (size, sd, "px"), text, cure)


def _bad_part(case: Case) -> Iterator[Hypothesis]:
    """One landmark, or the stretch of frames of largest residuals (the largest sum of a score, negative on average)."""
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
        when = "{:.2f} to {:.2f} s".format(*problem.time[rows][[0, -1]])
        cure = "Look at these frames and at the robot's log of this time, or leave them out (Correspondences.subset)."
        parts.append(("bad_stretch", rows, 4, f"Frames {first} to {last - 1} of those seen ({when}) have", cure))
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


def _camera_moved(case: Case) -> Iterator[Hypothesis]:
    """Other cameras from one frame on, both or one."""
    problem, fit = case.problem, case.null
    if case.frames < 8:
        return
    H = np.nan_to_num(np.concatenate([problem.x, np.ones((len(problem), 2, 1))], axis=2))
    z = np.concatenate([H, fit.residuals], axis=2)

    def columns(views: tuple[int, ...]) -> np.ndarray:
        late = H * (problem.frame >= frame)[:, None, None]
        return np.einsum("nck,cv,ij->ncivjk", late, np.eye(2)[:, views], np.eye(2)).reshape(*H.shape[:2], 2, -1)

    for _ in range(2):  # the frame that parts the rows best, under the weights of the fit so far
        weight = np.where(problem.used, 1.0 / (fit.shapes[0].scale ** 2 + (fit.residuals**2).sum(axis=2)), 0.0)
        moments = np.zeros((case.frames, 2, 6, 6))
        np.add.at(moments, problem.frame, np.einsum("nc,nci,ncj->ncij", weight, z, z))
        early, left = np.cumsum(moments, axis=0)[1:-2], 0.0
        for part in (early, moments.sum(axis=0) - early):
            G = part[..., :4, :4] + 1e-9 * np.trace(part, axis1=2, axis2=3)[..., None, None] * np.eye(4) + 1e-12 * np.eye(4)
            open_ = part[..., 4:, 4:] - part[..., 4:, :4] @ np.linalg.solve(G, part[..., :4, 4:])
            left = left + np.trace(open_, axis1=2, axis2=3).sum(axis=1)
        frame = int(left.argmin()) + 2
        fit = case.linear(columns((0, 1)))
    for views in ((0, 1), (0,), (1,)):
        fit = case.linear(columns(views)) if len(views) < 2 else fit
        size = float(np.sqrt((fit.moved_px[problem.frame >= frame][:, list(views)] ** 2).sum(axis=2).mean()))
        who = "Both cameras" if len(views) == 2 else f"The {SIDES[views[0]]} camera"
        text = f"{who} moved or zoomed at about frame {frame} of those seen: the images shift by {size:.1f} px."
        cure = "Calibrate before and after on their own. lib.registration.register_images follows a move, and no zoom."
        yield case.found("camera_moved", fit, 8 * len(views) + 3, (size, 0.0, "px"), text, cure, images=views)


def _frozen(case: Case) -> Iterator[Hypothesis]:
    """Positions that stand still or run on a straight line to the last digit; pixels that repeat while the robot moves."""
    problem = case.problem
    if not np.isfinite(problem.time).all() or case.frames < 4:
        return
    x, y, time = (case.by_frame(v) for v in (problem.x[:, 0], problem.y.reshape(-1, 4), problem.time))
    velocity = np.diff(x, axis=0) / np.diff(time, axis=0)[..., None]
    sizes = [np.linalg.norm(np.diff(v, axis=0), axis=2) for v in (velocity, x, y)]
    # (frames,) the largest of the landmarks, -1 where all are missing
    change, step_x, step_y = (np.where(np.isfinite(size), size, -1.0).max(axis=1) for size in sizes)
    straight = binary_opening(np.append((change >= 0) & (change < 2e-3), False))  # five frames on one line

    def certain(name: str, fit: Robust, repeated: np.ndarray, text: str, cure: str) -> Hypothesis:
        share = 100.0 * float(repeated.mean())
        found = case.found(name, fit, 2, (share, 0.0, "%"), f"In {share:.0f} % of the frames {text}.", cure)
        gain = max(found.gain, 0.0) + float(repeated.sum() * np.log(100.0))  # noise repeats no number
        return replace(found, gain=gain, explained=max(found.explained, share / 100))

    frozen = (step_y > 0) & (straight | ((step_x >= 0) & (step_x < 1e-9)))
    if frozen.mean() >= 0.02:
        fit = problem.fit(start=case.null.start, apart=np.isin(problem.frame, np.flatnonzero(frozen) + 1))
        if not frozen.all():  # a tool that rests is seen to move by the noise alone
            frozen &= step_y > 8 * fit.shapes[0].scale
    if frozen.mean() >= 0.02:
        text = "the robot's positions stand still, or run on an exact straight line, while the tool moves in the images"
        cure = "Log the robot at every sample; where it was silent leave the cells blank, so that these frames are not used."
        yield certain("frozen_kinematics", fit, frozen, text, cure)
    noise = min(fit.shapes[0].scale for fit in (case.null, *case.fits.values()))
    twice = (step_x > 1e-6) & (step_y >= 0) & (step_y < 0.15 * noise)
    if twice.mean() >= 0.02 and not twice.all():  # each image belongs to the instant at which it was first seen
        source = np.maximum.accumulate(np.where(np.append(True, ~twice), np.arange(case.frames), 0))[problem.frame]
        first = np.repeat(x[source, np.minimum(problem.landmark, 2)][:, None], 2, axis=1)
        fit = replace(problem, x=first).fit(start=case.null.start)
        text = "the detections repeat those of the frame before while the robot moves"
        cure = "Drop images that the camera delivered twice, and give the others their own times in frames.csv."
        yield certain("frozen_video", fit, twice, text, cure)


def _rigid_tips(case: Case) -> Iterator[Hypothesis]:
    """The robot reports tips at a fixed distance while the jaws open: one opening a frame, with a prior."""
    problem, tips = case.problem, case.by_frame(case.problem.x[:, 0])
    width = np.linalg.norm(tips[:, 2] - tips[:, 1], axis=1)
    width = width[np.isfinite(width)]
    if len(width) < 6 or width.std() > max(0.02 * width.mean(), 0.03):
        return
    side = np.select([problem.landmark == 1, problem.landmark == 2], [-1.0, 1.0], 0.0)
    fit, sd = case.null, 0.2
    for _ in range(8):
        d = np.einsum("cij,nj->nci", fit.M[:, :, :3], problem.axes[:, :, 1]) * side[:, None, None]
        weight = np.where(problem.used, 1.0 / (fit.shapes[0].scale ** 2 + (fit.residuals**2).sum(axis=2)), 0.0)[:, :, None]
        seen = problem.missed(fit, problem.x)
        information = np.bincount(problem.frame, (weight * d * d).sum(axis=(1, 2)), case.frames)
        opening = np.bincount(problem.frame, np.nansum(weight * d * seen, axis=(1, 2)), case.frames) / (information + sd**-2)
        sd = max(float(np.sqrt((opening**2 + 1.0 / (information + sd**-2)).mean())), 1e-3)
        x = problem.x + (side * opening[problem.frame])[:, None, None] * problem.axes[:, None, :, 1]
        fit = replace(problem, x=x).fit(start=fit.start, rounds=10)
    size = 2.0 * float(opening.std())
    text = f"The robot reports tips {width.mean():.2f} mm apart, always; in the images this varies by {size:.2f} mm."
    cure = "Log the opening of the jaws with the robot's pose, or calibrate with the base alone."
    chosen = 0.5 * float((np.log1p(sd**2 * information) + (opening / sd) ** 2).sum())  # the openings integrated out
    yield case.found("rigid_tips", fit, 1, (size, 0.0, "mm"), text, cure, raw=fit.total - case.null.total - chosen)


def _optics(case: Case, fit: Robust, sign: float) -> Iterator[Hypothesis]:
    """What an affine camera absorbs: the jaws, and the optics in the fit of the best cause so far, are the witnesses."""
    rows = [8 * c + 4 * i + j for c in range(2) for i in range(2) for j in range(3)]
    A, covariance = sign * fit.M[:, :, :3], fit.camera_covariance[np.ix_(rows, rows)]
    few = 2 * case.problem.used.sum() < 40
    if few or not np.isfinite(covariance).all() or min(np.linalg.svd(a, compute_uv=False)[1] for a in A) < 1e-6:
        return
    if case.misfit(fit) < FITS:  # cameras that fit nothing always have skewed pixels
        yield from list(_jaws(case)) or _scaled_axis(A, covariance)  # pixels cannot tell x from y
    yield from _handedness(case, A, covariance)


def _constraints(A: np.ndarray) -> np.ndarray:
    """(..., 4) skew of the left and right camera, log aspects, of A (..., 2, 2, 3): all 0 for square pixels."""
    size = np.linalg.norm(A, axis=-1)
    skew = (A[..., 0, :] * A[..., 1, :]).sum(axis=-1) / size.prod(axis=-1)
    return np.concatenate([skew, np.log(size[..., 0] / size[..., 1])], axis=-1)


def _jaws(case: Case) -> Iterator[Hypothesis]:
    """A robot axis of the wrong scale: the jaws' lengths in the log depend on where they point, and not on the opening alone.

    If a jaw's direction is n and an axis is s times too long, length^-2 is smaller by the factor 1 - (1 - s^-2) n^2.
    """
    x = case.log[np.isfinite(case.log).all(axis=(1, 2))]
    jaws = x[:, 1:] - x[:, :1]
    squares = (jaws**2).sum(axis=2, keepdims=True)
    if x.shape[1] != 3 or len(x) < 2 * _PARTS or squares.min() <= 0:
        return
    opening = np.linalg.norm(x[:, 2] - x[:, 1], axis=1)
    n, place = jaws / np.sqrt(squares), x[:, 1:] - x[:, 1:].mean(axis=(0, 1))
    # Eight numbers of each jaw: length^-2, n^2, n, and its place along itself.  Means of stretches of time have less noise.
    told = np.dstack([(1 / squares) / (1 / squares).mean(axis=0), n**2, n, (jaws * place).sum(axis=2) / squares[..., 0]])
    each = int(np.clip(len(x) / _STRETCHES, 1, 100))
    both = np.vander((opening - opening.mean()) / max(opening.std(), 1e-9), 3), told.reshape(len(x), -1)
    opened, told = (v[: len(x) // each * each].reshape(-1, each, v.shape[1]).mean(axis=1) for v in both)
    rest = (told - opened @ np.linalg.lstsq(opened, told, rcond=None)[0]).reshape(-1, 8)  # what the opening leaves
    length, turns, others = rest[:, 0], rest[:, 1:4], rest[:, 4:]
    along, common = np.maximum((turns**2).sum(axis=0), 1e-12), turns.T @ length
    k = (common**2 / along).argmax()
    slope, total = common[k] / along[k], length @ length
    # A base that is displaced beside the tips, or tips that lag behind it, change the lengths otherwise.
    left, otherwise = length - slope * turns[:, k], length - others @ np.linalg.lstsq(others, length, rcond=None)[0]
    sums = [part.sum() for part in np.array_split(turns[:, k] * left, _PARTS)]  # errors last for a while
    sd = float(np.hypot(np.linalg.norm(sums) / along[k], _OWN_SD))
    most = min((1 - _MOST_OF_IT) * total, _ODD**2 * len(rest), 1.1 * otherwise @ otherwise)  # which has three numbers more
    if abs(slope) >= max(_LEAST_SCALED, _SURE_SCALED * sd) and turns[:, k].std() >= _TURNED and left @ left <= most:
        scale = float((1 - slope / (slope * (n[..., k] ** 2).mean() - 1)) ** -0.5)
        text = f"The jaw lengths change with direction. They would not if the robot's {'xyz'[k]} were divided by {scale:.3f}."
        size = scale, sd * scale / 2, "times", float(1 - left @ left / total)
        yield Hypothesis("scaled_axis", text, _SCALE.format("xyz"[k]), *size, float(0.5 * (slope / sd) ** 2 - 1.5))


def _scaled_axis(A: np.ndarray, covariance: np.ndarray) -> Iterator[Hypothesis]:
    """A robot axis of the wrong scale: the pixels of A (2, 2, 3), of `covariance` (12, 12), are skewed or oblong."""
    tolerance = np.diag(np.square([_SKEW_SD, _SKEW_SD, _ASPECT_SD, _ASPECT_SD]))
    if abs(_constraints(A)[2:].mean()) > _RESIZED:
        tolerance[2:, 2:] += 1.0
    near = 1e-6 * np.abs(A).max() * np.eye(12).reshape(12, 2, 2, 3)
    spacing = np.log(12.0) / 80
    logs = spacing * np.arange(-80, 81)
    scales = np.exp(logs[:, None] * np.eye(3)[:, None])[:, :, None, None, None]  # (axes, logs, 1, 1, 1, 3)
    seen = _constraints(A * scales)
    J = (_constraints((A + near) * scales) - seen) / near.max()
    S = np.einsum("abik,ij,abjl->abkl", J, covariance, J) + tolerance
    misfit = (seen @ np.linalg.solve(S, np.swapaxes(seen, 2, 3)))[..., 0, 0]
    none = float(misfit[0, 80])
    for name, values in zip("xyz", misfit, strict=True):
        best = int(values[1:-1].argmin()) + 1
        before, least, after = values[best - 1 : best + 2]
        bend = max(float(before - 2 * least + after) / spacing**2, 1e-9)
        log = logs[best] + np.clip(0.5 * (before - after) / bend / spacing, -spacing, spacing)
        scale, sd = float(np.exp(log)), float(np.sqrt(2.0 / bend))  # A times s is plausible: the numbers are s too large
        text = f"The cameras' pixels are skewed or oblong, and square if the robot's {name} is divided by {scale:.3f}."
        # Rows that err alike say less than they seem to, and to accuse a robot's axis takes more than to accuse a clock.
        explained, gain = 1.0 - float(least) / max(none, 1e-9), float(0.5 * (none - least) - 5.5)
        yield Hypothesis("scaled_axis", text, _SCALE.format(name), scale, sd * scale, "times", explained, gain)


def _handedness(case: Case, A: np.ndarray, covariance: np.ndarray) -> Iterator[Hypothesis]:
    """A left camera on the right, or a tool that points at the cameras: exchanged eyes, or something is mirrored."""
    view = np.cross(A, np.roll(A, -1, axis=1))[:, 0].sum(axis=0)  # away from the cameras, if nothing is mirrored
    base, tips = np.split(case.by_frame(case.problem.x[:, 0]), [1], axis=1)
    tool = tips.mean(axis=1) - base[:, 0]
    ahead = tool @ view / np.linalg.norm(view) / np.linalg.norm(tool, axis=1)  # of a tool across the view nearly 0
    near, far = int((ahead < -_ACROSS).sum()), int((ahead > _ACROSS).sum())
    side, step = sides(A.reshape(4, 3))[0], 1e-6 * np.abs(A).max()
    J = np.array([(sides((A.ravel() + step * e).reshape(4, 3))[0] - side) / step for e in np.eye(12)])
    sd = float(np.sqrt(J @ covariance @ J))
    degrees = np.rad2deg(-side)
    size = float(degrees), float(np.rad2deg(sd)), "degrees", 1.0, float(0.5 * (side / sd) ** 2)
    where = f"The left camera stands on the right, by {degrees:.1f} degrees"
    if eyes_exchanged(A.reshape(4, 3), sd):
        if near > far:
            text = f"{where}, and the tool points at the cameras: an axis of the robot is mirrored."
            cure = "Use a right-handed robot frame: negate one axis, or exchange two, in kinematics.csv."
            yield Hypothesis("mirrored_axis", text, cure, *size)
        else:
            text = f"{where}, and the tool points away from it: the eyes are exchanged, or both are turned by 180 degrees."
            cure = "Exchange the folders left/ and right/ (or u_left and u_right); if the images are upside down, turn both."
            yield Hypothesis("exchanged_eyes", text, cure, *size)
    elif near > far:
        share = near / (near + far)
        text = f"In {100 * share:.0f} % of the frames the tips lie nearer to the cameras than the base. If both images are "
        text += "mirrored, heights and distances have the wrong sign."
        cure = "Flip both images, and undo what was done to the tips' order. Where the tool does point so, --force goes on."
        gain = (near - far) * np.log(_UPSIDE_DOWN)
        yield Hypothesis("mirrored_images", text, cure, 100 * share, 0.0, "%", 2 * share - 1, float(gain))


def _unexplained(case: Case, fit: Robust) -> list[Hypothesis]:
    """Residuals that the best cause leaves: the two images disagree with each other (the detector) or with the robot."""
    problem = case.problem
    base = case.by_frame(problem.x[:, 0])[problem.frame, 0]
    tools = np.einsum("cij,ncj->nci", fit.M[:, :, :3], problem.x - base[:, None])
    reach = np.linalg.norm(tools, axis=2)[problem.landmark > 0]
    if not np.isfinite(reach).any():
        return []
    length, distance = np.nanmedian(reach), np.linalg.norm(fit.residuals, axis=2)
    missed = float(np.median(distance[problem.used]))
    zoom = float(np.linalg.svd(fit.M[0, :, :3], compute_uv=False).mean())
    distances = affine_epipolar(problem.y[problem.used.all(axis=1)].reshape(-1, 4))[0]  # NaN of few, which is no witness
    epipolar, half = float(np.sqrt(2.0) * np.median(distances)), problem.used.sum() / 2.0
    if epipolar < 0.25 * missed and missed > _ROBOT_MM * zoom:
        text = f"The images agree with each other within {epipolar:.1f} px and miss the robot by {missed:.0f} px (medians)."
        cure = "Check times, units, columns of kinematics.csv; or the detector errs alike in both images: see its overlays."
        explained = 1.0 - (epipolar / missed) ** 2
        gain = half * float(np.log(missed / epipolar)) / fit.design
        return [Hypothesis("robot_noise", text, cure, 1e3 * missed / zoom, 0.0, "um", explained, gain)]
    if (share := float((distance[problem.used] > 0.05 * length).mean())) < 0.2:
        return []
    gain = half * (share * np.log(share / 0.05) + (1 - share) * np.log(max(1 - share, 1e-9) / 0.95))
    text = f"{100 * share:.0f} % of the landmarks lie more than 5 % of the tool's length from where a camera would see them."
    return [Hypothesis("detector_unfit", text, _UNFIT, 100 * share, 0.0, "%", share, float(gain))]


@dataclass(frozen=True)
class Diagnosis:
    """The hypotheses, most likely first."""

    hypotheses: tuple[Hypothesis, ...] = ()

    @property
    def best(self) -> Hypothesis | None:
        """The fault that the data show; None where nothing beats "nothing is wrong"."""
        return max((h for h in self.hypotheses if h.is_named), key=lambda h: h.gain, default=None)


def diagnose(
    data: Correspondences, *, kinematics: Kinematics | None = None, offset_s: float = 0.0, readout_s: float = 0.0,
    image_size_px: tuple[int, int] | None = None, near: bool = False,
) -> Diagnosis:  # fmt: skip
    """Fit every hypothesis about what could be wrong, and rank them.

    Args:
        data: The rows that were, or could not be, calibrated with.
        kinematics: The robot's log, which tells where the tool was a little earlier or later.  Without it the rows' own
            positions do, where the frames follow each other within 0.25 s.
        offset_s, readout_s, image_size_px: As the recording states them; without a size nothing is said of the read-out time.
        near: The cameras that were calibrated have a finite distance, so that it is no fault.

    >>> from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig
    >>> rng = np.random.default_rng(0)
    >>> x = ROBOT_FROM_MICROSCOPE.apply(rng.uniform(-4, 4, (60, 3)))
    >>> u = [pixels + rng.normal(0, 1.5, pixels.shape) for pixels in reference_rig().project(x)]
    >>> print(diagnose(Correspondences.of_points(x, *u)).best)
    None
    """
    frames = np.unique(data.frame)
    if len(data) > _MOST_ROWS:  # a part of the time: neighbours tell of clocks, and which part hardly matters
        data = data.of_frames(frames[np.linspace(0, len(frames) - 1, int(len(frames) * _MOST_ROWS / len(data))).astype(int)])
    problem = Problem.of(data, image_size_px)
    few = problem.used.all(axis=1).sum() < 6
    if len(frames) < _FEWEST_FRAMES or (few and len(data) < 12):
        return Diagnosis()
    if few:
        text = f"Only {problem.used.all(axis=1).sum()} of {len(data)} rows have both images and the robot's report."
        return Diagnosis((Hypothesis("detector_unfit", text, _UNFIT, 100.0, 0.0, "%", 1.0, float(len(data))),))
    tracks = [(problem.landmark == k) & problem.used.all(axis=1) for k in np.unique(problem.landmark)]
    moved_px, moved_mm = (max(np.ptp(v[own], axis=0).max() for own in tracks if own.any()) for v in (problem.y, problem.x))
    if moved_px < _STILL_PX and moved_mm > _ROBOT_MM:
        text, cure = "All frames show one picture, while the robot moves.", "Check that the cameras deliver, and record anew."
        return Diagnosis((Hypothesis("frozen_video", text, cure, 100.0, 0.0, "%", 1.0, float(len(data))),))
    stated = kinematics, offset_s, readout_s, image_size_px
    whole = case = Case(problem, *stated)
    # Where a tool rests its detections repeat one error, which is no fault that begins or ends there.
    x_mm, kept = np.nan_to_num(data.grid("x_mm")), np.ones(len(np.unique(data.frame)), dtype=bool)
    kept[_RESTS:] = np.linalg.norm(x_mm[_RESTS:] - x_mm[:-_RESTS], axis=2).max(axis=1) > _RESTS_MM
    if kept.sum() >= max(_FEWEST_FRAMES, 0.25 * len(kept)) and not kept.all():
        case = Case(Problem.of(data.of_frames(np.unique(data.frame)[kept]), image_size_px), *stated)
        whole.fits = ChainMap({}, case.fits)  # its own fits are of other rows
    tests = [_tip_order, _landmark_offset, _tool_bends, _drift, _bad_part, _camera_moved, _frozen]
    tests = [*(TIME_TESTS if case.paths else ()), *tests, _rigid_tips]
    found = [h for test in tests for h in test(whole if test is _frozen else case) if np.isfinite(h.gain)]
    best = Diagnosis(found := compared(found)).best
    fit = case.null if best is None else case.fits.get(best.name, case.null)
    turned = best is not None and best.name == "turned_image" and len(best.images) == 2  # then left is right
    more = [] if near else list(_finite_distance(case, fit))
    found += [h for h in (*more, *_optics(case, fit, -1.0 if turned else 1.0)) if np.isfinite(h.gain)]
    best = Diagnosis(found).best
    found += _unexplained(case, case.null if best is None else case.fits.get(best.name, fit))
    return Diagnosis(tuple(sorted(found, key=lambda h: -h.gain)))
