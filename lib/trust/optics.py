"""Hypotheses about the lenses, the robot's axes, and which eye is which."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from lib.calibration.checks import eyes_exchanged, sides
from lib.trust.fitting import FITS, Case, Hypothesis, Robust

#: Standard deviations, before the data, of a camera's skew and of the log of its pixel aspect.
_SKEW_SD, _ASPECT_SD = 0.002, 0.003
#: Least difference in chi-square that decides between resized images and a scaled axis; most to be explained if undecided.
_RATHER_RESIZED, _UNDECIDED = 9.0, 0.49
#: Jaw lengths in the log: number of stretches of time that are averaged, and of parts of time with independent errors.
_STRETCHES, _PARTS = 60, 8
#: Slope of length^-2 on n^2: the least of a scaled axis, the same in standard deviations, and that of a good robot (sd).
_LEAST_SCALED, _SURE_SCALED, _OWN_SD = 0.03, 5.0, 0.006
#: Least share of the variance that the slope explains, largest RMS that it leaves, and least RMS of n^2 as the jaws turn.
_MOST_OF_IT, _ODD, _TURNED = 0.5, 0.03, 0.01
_FIT_SHARE = 0.3  # share of the landmarks of each image that must fit before the cameras are interpreted
_DISTORTION_SD = 0.04  # prior standard deviation of the relative distortion at the corner
_ACROSS = 0.15  # sine of the tool's angle to the image plane, below which it points neither towards the cameras nor away
_UPSIDE_DOWN = 20.0  # odds that the tips of a tool lie below its base, as seen from the microscope
_INDEPENDENT_HZ = 3.0  # frames per second with independent evidence of where the tool points
#: Standard deviations of 1/distance from 0 at which its sign is certain: errors that last from frame to frame make 8 worth 6.
SURE_CURVED = 8.0
_CURVED_FITS = 0.01  # misfit below which 1/distance can be interpreted
_SCALE = "Check the units and the scale of the {} columns of kinematics.csv against the other columns."
_ODD_PIXELS = "The cameras' pixels are skewed or oblong. No axis of the robot is the cause: the jaws keep their lengths."
_STEADY = "Look for what bends, or changes while you record: shaft, microscope, clock. Resized images do no harm."


def finite_distance(case: Case, fit: Robust) -> Iterator[Hypothesis]:
    """A perspective, which an affine camera lacks, in addition to the best cause so far."""
    value, sd = fit.nearness
    if value <= 0:  # `handedness` interprets that
        return
    text = f"The residuals are curved by a working distance of {1 / value:.0f} mm: "
    text += f"1/distance is {value:.5f} +- {sd:.5f} per mm."
    cure = "Calibrate with model='near_affine' (--model near_affine on the command line)."
    n = 2.0 * case.problem.used.sum()
    wald = 0.5 * n * float(np.log1p(fit.design * (value / sd) ** 2 / n))  # Wald test as a log likelihood ratio
    raw = min(case.null.total - replace(case.problem, nearness_sd=1e-9).fit(start=case.null.start).total, wald)
    yield case.found("finite_distance", fit, 1, (value, sd, "1/mm"), text, cure, raw=raw)


def lens(case: Case) -> Iterator[Hypothesis]:
    """Lenses that distort: pixels shift along the ray from the image centre, in proportion to the cube of their distance."""
    problem = case.problem
    if case.size is None:  # the images' centre is unknown
        return

    def columns(M: np.ndarray) -> np.ndarray:
        v = np.einsum("cij,ncj->nci", M[:, :, :3], problem.x) + M[:, :, 3] - problem.centre_px
        cubes = v * (v**2).sum(axis=2, keepdims=True) / (problem.centre_px**2).sum()  # 1 at the corners
        return cubes[..., None] * np.eye(2)[:, None]

    fit = case.linear(columns)
    left, right = 100 * fit.theta
    where = [f"{abs(v):.1f} % too far {'out' if v > 0 else 'in'}" for v in (left, right)]
    text = f"The lenses distort: the corners of the left image lie {where[0]}, those of the right one {where[1]}."
    cure = "`python3 -m lib calibrate RECORDING --model zero_skew+distance+radial` corrects that."
    size, sd = np.abs(fit.theta).max(), np.sqrt(np.trace(fit.covariance) / 2)
    raw = fit.total - case.null.total - 0.5 * ((fit.theta / _DISTORTION_SD) ** 2).sum()
    yield case.found("lens_distortion", fit, 2, (100 * size, 100 * sd, "%"), text, cure, raw=raw)


def axes_and_eyes(case: Case, fit: Robust, sign: float) -> Iterator[Hypothesis]:
    """Faults that affine cameras absorb.  They show in the jaw lengths, and in the optics fitted with the best cause."""
    (A, covariance), (plain, of_plain) = (_of_axes(one, sign) for one in (fit, case.null))
    few = 2 * case.problem.used.sum() < 40
    if few or not np.isfinite(covariance).all() or min(np.linalg.svd(a, compute_uv=False)[1] for a in A) < 1e-6:
        return
    # A camera that does not fit, even if only one of the two, always has skewed pixels.
    distance, spread = np.linalg.norm(fit.residuals, axis=2), case.problem.y[case.problem.used].std(axis=0).max()
    each = [np.quantile(own[rows], _FIT_SHARE) / spread for own, rows in zip(distance.T, case.problem.used.T, strict=True)]
    if (misfit := max(case.misfit(fit), *each)) < FITS:
        # If the cameras also fit without the best cause, their pixels must be implausible there as well.
        implausible = case.misfit(case.null) >= FITS or any(h.is_named for h in _scaled_axis(plain, of_plain))
        accused, refuted = _jaws(case)
        yield from accused or (_scaled_axis(A, covariance, refuted) if implausible else ())
    if misfit < 2 * FITS:  # cameras that do not fit cannot tell left from right either
        curved = fit.nearness if misfit < _CURVED_FITS else (0.0, np.inf)
        yield from handedness(A, covariance, curved, case.by_frame(case.problem.x[:, 0]), case.problem.time)


def _of_axes(fit: Robust, sign: float) -> tuple[np.ndarray, np.ndarray]:
    """A (2, 2, 3) of the cameras of a fit, and its covariance (12, 12)."""
    rows = [8 * c + 4 * i + j for c in range(2) for i in range(2) for j in range(3)]
    return sign * fit.M[:, :, :3], fit.camera_covariance[np.ix_(rows, rows)]


def _constraints(A: np.ndarray) -> np.ndarray:
    """(..., 4) skews of left and right camera and logs of their pixel aspects, from A (..., 2, 2, 3); 0 for square pixels."""
    size = np.linalg.norm(A, axis=-1)
    skew = (A[..., 0, :] * A[..., 1, :]).sum(axis=-1) / size.prod(axis=-1)
    return np.concatenate([skew, np.log(size[..., 0] / size[..., 1])], axis=-1)


def _jaws(case: Case) -> tuple[list[Hypothesis], Callable[[int, float], bool]]:
    """A robot axis of the wrong scale: the jaw lengths in the log then depend on their direction, not only on the opening.

    If n is the component of a jaw's direction along an axis that is s times too long, length^-2 is scaled by
    1 - (1 - s^-2) n^2.  Returns the hypotheses, and a function (axis 0 to 2, s) that is True if the lengths refute s.
    """
    x = case.log[np.isfinite(case.log).all(axis=(1, 2))]
    jaws = x[:, 1:] - x[:, :1]
    squares = (jaws**2).sum(axis=2, keepdims=True)
    if x.shape[1] != 3 or len(x) < 2 * _PARTS or squares.min() <= 0:
        return [], lambda axis, scale: False
    opening = np.linalg.norm(x[:, 2] - x[:, 1], axis=1)
    n, place = jaws / np.sqrt(squares), x[:, 1:] - x[:, 1:].mean(axis=(0, 1))
    # Eight numbers of each jaw: length^-2, n^2, n, and its position along itself.  Averages over stretches have less noise.
    of_jaws = np.dstack([(1 / squares) / (1 / squares).mean(axis=0), n**2, n, (jaws * place).sum(axis=2) / squares[..., 0]])
    each = int(np.clip(len(x) / _STRETCHES, 1, 100))
    both = np.vander((opening - opening.mean()) / max(opening.std(), 1e-9), 3), of_jaws.reshape(len(x), -1)
    opened, of_jaws = (v[: len(x) // each * each].reshape(-1, each, v.shape[1]).mean(axis=1) for v in both)
    rest = (of_jaws - opened @ np.linalg.lstsq(opened, of_jaws, rcond=None)[0]).reshape(-1, 8)  # not due to the opening
    length, turns, others = rest[:, 0], rest[:, 1:4], rest[:, 4:]
    along, common = np.maximum((turns**2).sum(axis=0), 1e-12), turns.T @ length
    slopes, squared, enough = common / along, (n**2).mean(axis=(0, 1)), turns.std(axis=0) >= _TURNED
    sums = [part.sum(axis=0) for part in np.array_split(turns * (length[:, None] - slopes * turns), _PARTS)]  # errors persist
    sds = np.hypot(np.linalg.norm(sums, axis=0) / along, _OWN_SD)

    def refuted(axis: int, scale: float) -> bool:
        """True if the jaws turn enough to show the slope that this scale would cause, but do not show it."""
        q = 1.0 - scale**-2.0
        expected, slope = -q / (1.0 - q * squared[axis]), slopes[axis]
        return bool(enough[axis] and abs(slope) < abs(expected) / 2 and abs(expected - slope) > _SURE_SCALED * sds[axis])

    k = (common**2 / along).argmax()
    slope, sd, total = slopes[k], float(sds[k]), length @ length
    # A base with an offset from the tips, or tips that lag behind the base, change the lengths in other ways (`others`).
    left, otherwise = length - slope * turns[:, k], length - others @ np.linalg.lstsq(others, length, rcond=None)[0]
    most = min((1 - _MOST_OF_IT) * total, _ODD**2 * len(rest), 1.1 * otherwise @ otherwise)  # 1.1 for three more numbers
    found = []
    if abs(slope) >= max(_LEAST_SCALED, _SURE_SCALED * sd) and enough[k] and left @ left <= most:
        scale = float((1 - slope / (slope * squared[k] - 1)) ** -0.5)
        text = f"The jaw lengths change with direction. They would not if the robot's {'xyz'[k]} were divided by {scale:.3f}."
        size = scale, sd * scale / 2, "times", float(1 - left @ left / total)
        found = [Hypothesis("scaled_axis", text, _SCALE.format("xyz"[k]), *size, float(0.5 * (slope / sd) ** 2 - 1.5))]
    return found, refuted


def _scaled_axis(
    A: np.ndarray, covariance: np.ndarray, refuted: Callable[[int, float], bool] = lambda axis, scale: False
) -> Iterator[Hypothesis]:  # fmt: skip
    """A robot axis of the wrong scale: the pixels of A (2, 2, 3), with `covariance` (12, 12), are skewed or oblong.

    Images that were resized to another aspect make pixels oblong, which does no harm: the cameras absorb it.  If the axis
    is `refuted` as the cause, the cause is unknown (`odd_pixels`).
    """
    tolerance = np.diag(np.square([_SKEW_SD, _SKEW_SD, _ASPECT_SD, _ASPECT_SD]))
    near = 1e-6 * np.abs(A).max() * np.eye(12).reshape(12, 2, 2, 3)
    spacing = np.log(12.0) / 80
    logs = spacing * np.arange(-80, 81)
    scales = np.exp(logs[:, None] * np.eye(3)[:, None])[:, :, None, None, None]  # (axes, logs, 1, 1, 1, 3)
    seen = _constraints(A * scales)
    J = (_constraints((A + near) * scales) - seen) / near.max()
    S = np.einsum("abik,ij,abjl->abkl", J, covariance, J) + tolerance
    misfit = (seen @ np.linalg.solve(S, np.swapaxes(seen, 2, 3)))[..., 0, 0]
    stated, information = seen[0, 80, 0], np.linalg.inv(S[0, 80])
    none, resized = float(misfit[0, 80]), np.inf
    for free in np.array([[0, 0, 1, 1], [0, 0, 1, 0], [0, 0, 0, 1]]):  # the log aspect of both images, or of one
        resized = min(resized, none - float((free @ information @ stated) ** 2 / (free @ information @ free)))
    for axis, values in enumerate(misfit):
        best = int(values.argmin())
        if not 0 < best < len(values) - 1:  # no scale explains it
            continue
        before, least, after = values[best - 1 : best + 2]
        if least > resized + _RATHER_RESIZED:
            continue
        bend = max(float(before - 2 * least + after) / spacing**2, 1e-9)
        log = logs[best] + np.clip(0.5 * (before - after) / bend / spacing, -spacing, spacing)
        scale, sd = float(np.exp(log)), float(np.sqrt(2.0 / bend))  # A * s is plausible if positions are s times too large
        name = "xyz"[axis]
        text = f"The cameras' pixels are skewed or oblong, and square if the robot's {name} is divided by {scale:.3f}."
        # Correlated errors make the evidence look too strong, and a wrong axis is less likely than a wrong clock: 5.5 off.
        explained, gain = 1.0 - float(least) / max(none, 1e-9), float(0.5 * (none - least) - 5.5)
        size, denied = (scale, sd * scale, "times"), refuted(axis, scale)
        if resized < least + _RATHER_RESIZED:
            if denied:  # then the images were resized, which does no harm
                continue
            text += " Or the images were resized to another aspect, which does no harm: the cameras absorb it."
            explained = min(explained, _UNDECIDED)
        if denied:
            yield Hypothesis("odd_pixels", _ODD_PIXELS, _STEADY, *size, min(explained, _UNDECIDED), gain)
        else:
            yield Hypothesis("scaled_axis", text, _SCALE.format(name), *size, explained, gain)


def stands_exchanged(fit: Robust) -> bool:
    """True if the left camera of a fit stands on the right."""
    A, covariance = _of_axes(fit, 1.0)
    return bool(np.isfinite(covariance).all()) and eyes_exchanged(A.reshape(4, 3), _side(A, covariance)[1])


def _side(A: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
    """Angle by which the right camera of A (2, 2, 3) stands to the right, rad, and its sd by `covariance` (12, 12)."""
    side, step = sides(A.reshape(4, 3))[0], 1e-6 * np.abs(A).max()
    J = np.array([(sides((A.ravel() + step * e).reshape(4, 3))[0] - side) / step for e in np.eye(12)])
    return float(side), float(np.sqrt(J @ covariance @ J))


def handedness(
    A: np.ndarray, covariance: np.ndarray, nearness: tuple[float, float], x_mm: np.ndarray, time_s: np.ndarray
) -> Iterator[Hypothesis]:  # fmt: skip
    """A left camera on the right, or a mirrored world: exchanged eyes, a mirrored axis, or mirrored images.

    A (2, 2, 3) are the cameras' axes with their `covariance` (12, 12), `nearness` is 1/distance, per mm, with its standard
    deviation, x_mm (frames, 3, 3) are the landmarks as the robot reports them, and time_s (n,) are the times of their rows.

    Farther things look smaller (positive `nearness`) unless the world is mirrored.  If the data do not determine `nearness`,
    the tool's direction decides: a microscope sees the tips below the base, so tips nearer to it mean a mirrored world.
    """
    views = np.cross(A, np.roll(A, -1, axis=1))[:, 0]  # away from the cameras, if nothing is mirrored
    if views[0] @ views[1] < 0:
        return  # one image is mirrored; the verdict names it
    view = views.sum(axis=0)
    tool = x_mm[:, 1:].mean(axis=1) - x_mm[:, 0]
    ahead = tool @ view / np.linalg.norm(view) / np.linalg.norm(tool, axis=1)  # near 0 for a tool across the view
    near, known, (curved, curved_sd) = int((ahead < -_ACROSS).sum()), np.isfinite(ahead).sum(), nearness
    share = (near - int((ahead > _ACROSS).sum())) / max(known, 1)
    apart_s = np.ptp(time_s) if np.isfinite(time_s).all() else np.inf
    if abs(curved) > SURE_CURVED * curved_sd:
        mirrored, how = curved < 0, "farther things look larger"
        gain = 0.5 * (curved / curved_sd) ** 2
    else:
        mirrored, how = share > 0.5, f"in {near} of {known} frames the tips lie nearer to the cameras than the base"
        gain = share * min(known, 1.0 + _INDEPENDENT_HZ * apart_s) * np.log(_UPSIDE_DOWN)
    side, sd = _side(A, covariance)
    degrees = np.rad2deg(-side)
    size = float(degrees), float(np.rad2deg(sd)), "degrees", 1.0, float(0.5 * (side / sd) ** 2)
    where = f"The left camera stands on the right, by {degrees:.1f} degrees"
    if eyes_exchanged(A.reshape(4, 3), sd):
        if mirrored:
            text = f"{where}, and {how}: an axis of the robot is mirrored."
            cure = "Use a right-handed robot frame: negate one axis, or exchange two, in kinematics.csv."
            yield Hypothesis("mirrored_axis", text, cure, *size)
        else:
            text = f"{where}, and no axis is mirrored: the eyes are exchanged, or both images are turned by 180 degrees."
            cure = "Exchange the folders left/ and right/ (or u_left and u_right); if the images are upside down, turn both."
            yield Hypothesis("exchanged_eyes", text, cure, *size)
    elif mirrored:
        text = f"The world looks mirrored, since {how}. Then heights and distances have the wrong sign."
        cure = "Flip both images, and undo what was done to the tips' order; or, if the images are right, use a right-handed "
        cure += "robot frame and exchange left/ and right/. If the import read poses, check rotation_kind in the mapping "
        cure += "(the order of a quaternion). Where the tool does point so, --force goes on."
        explained = 1.0 if abs(curved) > SURE_CURVED * curved_sd else share
        yield Hypothesis("mirrored_images", text, cure, 100.0 * share, 0.0, "%", explained, float(gain))
