"""Constant offsets of the landmarks, estimated along with the cameras.

The point that a detector finds may be some hundredths of a millimetre from the landmark, always in the same direction of the
tool.  Such an error does not average out.  If the robot reports landmark k at x and the tool has the axes R, the point found
is x + R d_k.  The data cannot distinguish all nine numbers d from a shift of the cameras, so d has a Gaussian prior of zero
mean, whose width the data choose (empirical Bayes).  Directions that the data do not determine keep a large covariance.
"""

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from lib.calibration.calibration import Calibration, LandmarkOffsets
from lib.calibration.robust import LooseCameraError, NoConsensusError, consensus
from lib.calibration.scatter import sandwich
from lib.cameras import AffineCamera, NearAffineCamera
from lib.correspondences import Correspondences, DataError

#: Step of the numerical derivatives by the offsets, mm or px.
_STEP = 1e-4
#: Largest offset (from the mean of all) that may explain two competing cameras, and largest offset that may explain a single
#: landmark that is an outlier for the others' cameras.  Beyond these the detector finds another point of the tool.
_MOST_MM, _MOST_ALONE_MM = 0.8, 0.25
#: Number of first steps that use given detections, if consensus alone finds no good inliers; later steps use the inliers.
_WITH_GIVEN = 4
_FAR_OUT = 4.0  # distance from a loose camera, in standard deviations, beyond which offsets are not the reason
#: Grid of initial offsets that turn the axes (a robot's model of its tool errs by tenths of a millimetre), and rows used.
_GRID_MM, _STARTING_ROWS = (0.0, 0.2, -0.2), 2000
#: Number of initial values that are refined, reweightings of the rows in a step, and decrease of the cost that ends them.
_REFINED, _REWEIGHTED, _SETTLED = 4, 3, 0.1
#: Standard deviation of the detector's constant error in units of the tool's length: base and tips; along, across and normal
#: to the tool.  Chosen on recordings of unfamiliar tools and lights.
OWN_BIAS = 0.004 * np.array([[2.5, 1.0, 1.5], [1.2, 1.0, 1.5], [1.2, 1.0, 1.5]])
_ODD = 0.2  # share of a large offset that may still be the detector's: it knows some tools far worse than others
#: The tool's axes (n, 3, 3) in each row; or a function from offsets (..., k, 3) to the axes (..., n, 3, 3); None: no axes.
Axes = np.ndarray | Callable[[np.ndarray], np.ndarray] | None


class Unsettled(RuntimeWarning):
    """The offsets have not converged after the given number of steps."""


_FAILURES = (DataError, np.linalg.LinAlgError, Unsettled)


def tool_axes(x_mm: ArrayLike, offset_mm: np.ndarray | None = None) -> np.ndarray:
    """Axes R (n, 3, 3) of a forceps from its landmarks (n, 3, 3) mm.  Columns: along the tool, from tip to tip, their normal.

    With `offset_mm` (..., 1 to 3, 3), the axes (..., n, 3, 3) of the moved landmarks; the offsets are in these same axes.  If
    the reported tips may be crossed there are two solutions; the one that turns least from row to row is taken, so rows must
    be in order of time.  NaN where the tips are closer than 5 % of the tool's length, or a landmark is missing.

    >>> tool_axes([[[0, 0, 0], [3, -0.5, 0], [3, 0.5, 0]]])[0].tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    x = np.asarray(x_mm, dtype=np.float64)
    if x.ndim != 3 or x.shape[1:] != (3, 3):
        raise ValueError(f"x_mm: expected base, tip_1 and tip_2 (n, 3, 3), got {x.shape}.")
    along, across = (x[:, 1] + x[:, 2]) / 2 - x[:, 0], x[:, 2] - x[:, 1]
    with np.errstate(invalid="ignore", divide="ignore"):
        size = np.linalg.norm(along, axis=1)
        m = along / size[:, None]
        beside = (across * m).sum(axis=1, keepdims=True)
        across = across - beside * m
        width = np.linalg.norm(across, axis=1, keepdims=True)
        c = across / width
        g = np.cross(m, c)
        if offset_mm is None:
            return np.where((width > 0.05 * size[:, None])[:, :, None], np.stack([m, c, g], axis=2), np.nan)
        # In the wanted axes the direction `a` of the reported vector along the tool is known, and the component along the
        # normal of the reported vector from tip to tip.  Together they determine all three angles.
        base, tip_1, tip_2 = (*np.moveaxis(offset_mm[..., None, :], -3, 0), np.zeros(3), np.zeros(3))[:3]  # (..., 1, 3)
        middle, apart = (tip_1 + tip_2) / 2 - base, tip_2 - tip_1
        straight = np.sqrt(size**2 - middle[..., 1] ** 2 - middle[..., 2] ** 2)
        a = np.stack(np.broadcast_arrays(straight, -middle[..., 1], -middle[..., 2]), axis=-1) / size[:, None]
        up = np.array([0.0, 0.0, 1.0]) - a[..., 2:] * a
        up /= np.linalg.norm(up, axis=-1, keepdims=True)
        side = np.cross(up, a)
        sine = np.clip((-apart[..., 2:] - beside * a[..., 2:]) / (width * up[..., 2:]), -1, 1)
        cosine = np.multiply.outer([1.0, -1.0], np.sqrt(1 - sine**2))
        own = np.stack([a, side, up], axis=-1)
        y, z = cosine * c - sine * g, sine * c + cosine * g
        axes = np.stack([np.broadcast_to(m, y.shape), y, z], axis=-1) @ own.mT  # (2, ..., n, 3, 3)
        opening = apart[..., 1] + (beside * a + width * (cosine * side + sine * up))[..., 1]
        shut = 0.05 * (straight + middle[..., 0])
        possible = (width[:, 0] > shut) & (opening > np.stack([np.full(shut.shape, -np.inf), -shut]))  # jaws hardly cross
    found = np.where(possible[0, ..., None, None], axes[0], np.where(possible[1, ..., None, None], axes[1], np.nan))
    for index in np.argwhere(possible.all(axis=0).any(axis=-1)).tolist():
        _choose_least_turning(axes[:, *index], possible[:, *index], found[*index])
    return found


def _choose_least_turning(axes: np.ndarray, possible: np.ndarray, found: np.ndarray) -> None:
    """Where both axes (2, n, 3, 3) are `possible` (2, n), write those that turn least into `found` (n, 3, 3), in place."""
    known = np.flatnonzero(possible.any(axis=0))
    two = np.concatenate([[False], possible[:, known].all(axis=0), [False]])
    known = known[two[:-2] | two[1:-1] | two[2:]]  # rows with two choices and their neighbours; the others are fixed
    y = axes[..., 1][:, known]
    own = np.where(possible[:, known], [[0.0], [1e-6]], np.inf)
    turn = np.nan_to_num(1 - np.einsum("snx,tnx->nst", y[:, :-1], y[:, 1:]), nan=np.inf).tolist()
    (a, b), previous = own[:, 0].tolist(), []  # dynamic programming: the least cost of paths that end in choice a or b
    for ((aa, ab), (ba, bb)), (own_a, own_b) in zip(turn, own.T[1:].tolist(), strict=True):
        previous.append((a + aa > b + ba, a + ab > b + bb))
        a, b = min(a + aa, b + ba) + own_a, min(a + ab, b + bb) + own_b
    which = [b < a]
    for choice in reversed(previous):
        which.append(choice[which[-1]])
    found[known] = axes[np.array(which[::-1], int), known]


def rows_axes(data: Correspondences, offset_mm: np.ndarray | None = None, *, carry: bool = False) -> np.ndarray:
    """`tool_axes` (n, 3, 3) of each row's frame.  All NaN if a landmark of a frame occurs twice, as in joined recordings.

    With `offset_mm` (1 to 3, 3), the axes of the moved landmarks, or those of the reported landmarks where these have none.
    If `carry`, both are first filled by axes `carried` from other frames.
    """
    if len(data) == 0 or data.landmark.max() > 2 or len(np.unique(3 * data.frame + data.landmark)) < len(data):
        return np.full((len(data), 3, 3), np.nan)
    x = data.grid("x_mm")
    axes = tool_axes(x)
    axes = carried(axes, x) if carry else axes
    if offset_mm is not None:
        turned = tool_axes(x, offset_mm)
        turned = carried(turned, x) if carry else turned
        axes = np.where(np.isfinite(turned), turned, axes)
    return axes[np.unique(data.frame, return_inverse=True)[1]]


def carried(axes: np.ndarray, x_mm: np.ndarray, time_s: np.ndarray | None = None) -> np.ndarray:
    """The axes (n, 3, 3) of tools at x_mm (n, 3, 3), in order of time; NaN ones are filled from the nearest row with axes.

    The axes of that row are turned as the shaft turned since: shut jaws show where the shaft points, but not its roll.
    The nearest row is the nearest in time, or without `time_s` in order.
    """
    along = x_mm[:, 1:].mean(axis=1) - x_mm[:, 0]
    found, time = axes.copy(), np.arange(len(axes)) if time_s is None else time_s
    has_axes, is_reported = np.isfinite(axes).all(axis=(1, 2)), np.isfinite(along).all(axis=1)
    known, shut = np.flatnonzero(has_axes & is_reported), np.flatnonzero(~has_axes & is_reported)
    if known.size and shut.size:
        nearest = known[np.searchsorted((time[known[1:]] + time[known[:-1]]) / 2, time[shut])]
        axis = np.cross(along[nearest], along[shut])
        sine, cosine = np.linalg.norm(axis, axis=1), (along[nearest] * along[shut]).sum(axis=1)
        turn = Rotation.from_rotvec(axis * (np.arctan2(sine, cosine) / np.maximum(sine, 1e-300))[:, None])
        found[shut] = turn.as_matrix() @ axes[nearest]
    return found


def shown_axes(x_mm: np.ndarray, cameras: Sequence[AffineCamera | NearAffineCamera]) -> np.ndarray:
    """The images (m, k, 2, 3) px, by k cameras, of the axes of tools at x_mm (m, 3, 3), in order of time.

    Each axis is as long as the tool is usually.  If the jaws are always shut, only the first axis is known; the others are 0.
    """
    along, axes = x_mm[:, 1:].mean(axis=1) - x_mm[:, 0], carried(tool_axes(x_mm), x_mm)
    size = np.linalg.norm(along, axis=1)
    axes = (along / size[:, None])[:, :, None] * [1.0, 0.0, 0.0] if np.isnan(axes).all() else axes
    return np.einsum("cij,mjk->mcik", [camera.linear for camera in cameras], np.nanmedian(size) * axes)


def with_offsets(data: Correspondences, offsets: LandmarkOffsets | None) -> Correspondences:
    """The correspondences with the `Calibration.offsets` applied, so that positions and detections agree.

    Offsets in the tool's axes move positions; those of shut jaws use the axes of the nearest frame with open jaws
    (`carried`).  Offsets in the images move pixels.  None changes nothing.
    """
    if offsets is None:
        return data
    unknown = max(data.landmark.max(initial=0) + 1 - len(offsets.offset), 0)  # landmarks never seen in the calibration
    shift = np.vstack([offsets.offset, np.zeros((unknown, offsets.offset.shape[1]))])[data.landmark]
    if shift.shape[1] == 4:
        return replace(data, u_left=data.u_left - shift[:, :2], u_right=data.u_right - shift[:, 2:])
    shift = np.einsum("nij,nj->ni", rows_axes(data, offsets.offset if offsets.turns else None, carry=True), shift)
    return replace(data, x_mm=data.x_mm + np.where(np.isfinite(shift), shift, 0.0))


def robots_part(found: LandmarkOffsets, own_sd_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The robot's part of the offsets (3, 3) mm, and its covariance (3, 3, 3); the rest is the detector's error.

    Both parts have Gaussian priors: the detector's of standard deviations `own_sd_mm` (3, 3), the robot's of the likeliest
    one; the covariance allows for others.  Offsets no larger than a detector's usual errors are attributed to the detector.
    """
    widths = np.append(0.0, np.geomspace(1e-3, 2.0, 80))[:, None, None]
    total = widths**2 + own_sd_mm**2 + found.standard_deviation**2
    misfit = (np.log(total) + found.offset**2 / total).sum(axis=(1, 2))
    # A shift of cameras and offsets together changes no label, so its large covariance is no reason for a smaller share.
    shares = widths**2 / (widths**2 + own_sd_mm**2)
    share, odds = shares[misfit.argmin()], np.exp((misfit.min() - misfit) / 2)
    # Other widths are possible, too: even if no offset is most probable, its standard deviation is not 0.
    variance = np.average(shares * own_sd_mm**2 + ((shares - share) * found.offset) ** 2, axis=0, weights=odds)
    variance += (_ODD * share * found.offset) ** 2
    return share * found.offset, variance[:, :, None] * np.eye(3)


def estimate_offsets(
    fit: Callable[..., Calibration], x: np.ndarray, y: np.ndarray, landmark: np.ndarray, frame: np.ndarray,
    axes: Axes = None, prior_sd: float | None = None, iterations: int = 20, start: Calibration | None = None,
) -> Calibration:  # fmt: skip
    """The calibration with one constant offset a landmark, in the tool's axes or (axes=None) in the images.

    Gauss-Newton on the offsets with the cameras eliminated.  A step makes a whole calibration `fit` of positions (n, 3) and
    pixels (n, m), with inlier `views`, and a Schur complement.  An `Unsettled` warning says that `iterations` are too few.
    `start` gives the first offsets, their prior and p-value.  Without `prior_sd` the prior's width is the one of maximum
    evidence, between 0.1 and 300 um or 0.01 and 30 px.
    If rows agree on no camera, or one landmark is mostly an outlier, small offsets may be the reason.
    Else the `NoConsensusError` is raised, or the calibration without that landmark returned.
    """
    steps = partial(_steps, fit, x, y, landmark, frame, axes, prior_sd, iterations, start)
    if axes is None:
        return steps()
    found, refused, attempts = None, None, [np.isfinite(y).reshape(len(y), -1, 2).all(axis=2)]
    try:
        found = steps()
    except NoConsensusError as error:
        refused = error
    if found is not None and _agree_alike(found, landmark):
        return found
    if isinstance(refused, LooseCameraError):  # wrong detections far outside its noise would spoil the offsets
        with suppress(DataError):
            attempts.insert(0, consensus(x, y, _FAR_OUT * refused.sigma_px, np.random.default_rng(0))[0])
    elif refused:  # each landmark agrees with itself, whatever its offset
        alone = np.zeros_like(attempts[0])
        for rows in (landmark == k for k in np.unique(landmark)):
            with suppress(DataError):
                alone[rows] = consensus(x[rows], y[rows], None, np.random.default_rng(0))[0]
        attempts = [alone]
    for first_views in attempts:
        with suppress(*_FAILURES), warnings.catch_warnings(action="error", category=Unsettled):
            other = steps(first_views=first_views)
            offset = other.offsets.offset[np.bincount(landmark) > 0]
            most, centre = (_MOST_MM, offset.mean(axis=0)) if refused else (_MOST_ALONE_MM, 0.0)
            if np.linalg.norm(offset - centre, axis=1).max() <= most and _agree_alike(other, landmark):
                return other
    if refused:
        raise refused
    return found


def _agree_alike(found: Calibration, landmark: np.ndarray) -> bool:
    """True if no landmark's share of inliers is below half of the largest landmark's share."""
    count = np.bincount(landmark)
    shares = np.bincount(landmark, found.inliers)[count > 0] / count[count > 0]
    return bool(shares.min() >= 0.5 * shares.max())


def _steps(
    fit: Callable[..., Calibration], x: np.ndarray, y: np.ndarray, landmark: np.ndarray, frame: np.ndarray,
    axes: Axes, prior_sd: float | None, iterations: int, start: Calibration | None, *, first_views: np.ndarray | None = None,
) -> Calibration:  # fmt: skip
    """The Gauss-Newton steps of `estimate_offsets`; the first ones use `first_views` (n, cameras) instead of inliers."""
    offset = np.zeros((int(landmark.max()) + 1, y.shape[1] if axes is None else 3))
    p_value, score, views = np.nan, None, None
    if start is not None:
        offset, prior_sd, p_value = start.offsets.offset, start.offsets.prior_sd, start.offsets.p_value
    step, share, before_px, before_inliers = np.zeros(offset.size), 1.0, np.inf, None
    given = 0 if first_views is None else _WITH_GIVEN

    for i in range(iterations):
        own = axes(offset) if callable(axes) else np.eye(y.shape[1])[None].repeat(len(x), axis=0) if axes is None else axes
        shift = np.einsum("nij,nj->ni", own, offset[landmark])
        views = first_views if i < given else views
        found = fit(*((x, y - shift) if axes is None else (x + shift, y)), views=views)
        # Keep the inliers after a few steps, else they may alternate for ever; find them anew if other axes raise the error.
        keeps = i >= given + 2 or (i > given and np.array_equal(found.view_inliers, before_inliers))
        views = found.view_inliers if keeps and found.reprojection_rms_px < 1.2 * before_px else None
        before_px, before_inliers = found.reprojection_rms_px, found.view_inliers
        rows = found.inliers
        J_x, J_c, weight, r = found.system
        J = _by_offset(axes, offset, landmark, own)[rows]
        J = J if axes is None else J_x @ J
        information, gradient = _without_cameras(J, J_c, weight, r)
        if start is None and score is None:
            chosen_sd, score = _evidence(information, gradient, 1e-4 if axes is not None else 1e-2)
            prior_sd = prior_sd or chosen_sd
        covariance = np.linalg.inv(information + np.eye(offset.size) / prior_sd**2)
        before, step = step, covariance @ (gradient - offset.ravel() / prior_sd**2)
        share = share / 2 if step @ before < 0 else min(1.5 * share, 1.0)  # shorten steps that reverse their direction
        offset = offset + share * step.reshape(offset.shape)
        moved, least_sd = share * np.abs(step).max(), np.sqrt(np.diag(covariance).min())
        if moved < 1e-3 * least_sd and i >= given:
            break
    else:
        if moved > 0.1 * least_sd:
            text = f"they still move by up to {moved:.2g} {'px' if axes is None else 'mm'} after {iterations} steps"
            warnings.warn(f"offsets: {text}; look at the outliers (`ransac_px`).", Unsettled, stacklevel=4)
    p = J_c.shape[2]
    prior = np.diag(np.repeat([0.0, prior_sd**-2], [p, offset.size]))
    full, effective = sandwich(np.concatenate([J_c, J], axis=2), weight, r, J_x, frame[rows], landmark[rows], prior)
    sd = np.sqrt(np.diag(full)[p:]).reshape(offset.shape)
    if score is not None:  # correlated errors count less
        p_value = float(chdtrc(score[0], score[1] * effective / len(r))) if score[0] else 1.0
    learnt = LandmarkOffsets(offset, sd, prior_sd, p_value)
    return replace(found, joint_covariance=full, effective_rows=effective, offsets=learnt)


def _without_cameras(J: np.ndarray, J_c: np.ndarray, weight: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Information (p, p) and gradient (p,) of offsets with derivatives J (n, m, p), after eliminating the cameras (J_c)."""
    both, p = np.concatenate([J_c, J], axis=2), J_c.shape[2]
    weighted = (weight @ both).reshape(-1, both.shape[2])
    information, gradient = weighted.T @ both.reshape(weighted.shape), weighted.T @ r.ravel()
    explained = np.linalg.solve(information[:p, :p], information[:p, p:])
    return information[p:, p:] - information[p:, :p] @ explained, gradient[p:] - explained.T @ gradient[:p]


def start_of_turning(
    found: Calibration, axes: np.ndarray, turned: Callable[[np.ndarray], np.ndarray], landmark: np.ndarray
) -> np.ndarray:
    """Initial offsets (k, 3) for estimating offsets that turn the axes: the best of a grid, refined.

    Three linear combinations of the offsets turn the axes (`_turns`).  At each point of a grid over these three, the other
    offsets follow from a linear problem; Gauss-Newton steps refine the best points.  `found` is the calibration with the
    reported `axes` (n, 3, 3), and `turned` maps offsets to axes.
    """
    some = np.random.default_rng(0).permutation(found.inliers.sum())[:_STARTING_ROWS]  # random rows, of all landmarks
    rows, offset, k = np.flatnonzero(found.inliers)[some], found.offsets.offset, len(found.offsets.offset)
    J_x, J_c, weight, r = (part if len(part) == 1 else part[some] for part in found.system)
    landmark, (turns, along), p = landmark[rows], _turns(k), J_c.shape[2]
    r = r + (J_x @ axes[rows] @ offset[landmark][:, :, None])[:, :, 0]
    prior = np.eye(3 * k) / max(found.offsets.prior_sd, _GRID_MM[1]) ** 2

    def of_rows(offset: np.ndarray) -> np.ndarray:
        return turned(offset)[..., rows, :, :]

    def gauss_newton(offset: np.ndarray, own: np.ndarray | None = None) -> tuple[float, np.ndarray]:
        """The cost of offsets, with the cameras eliminated, and the offsets after a Gauss-Newton step.

        If the axes are given as `own`, the step does not turn them.  The noise is Student's t of 4 degrees of freedom, so
        rows with wrong axes, whose residuals are large, have little weight.
        """
        held, own = own is not None, of_rows(offset) if own is None else own
        residual = r - (J_x @ own @ offset[landmark][:, :, None])[:, :, 0]
        J = np.concatenate([J_c, J_x @ _by_offset(None if held else of_rows, offset, landmark, own)], axis=2)
        flat, weighted, robust = J.reshape(-1, J.shape[2]), (weight @ J).reshape(-1, J.shape[2]), np.ones(len(r))
        for _ in range(_REWEIGHTED):
            now = weighted * np.repeat(robust, r.shape[1])[:, None]
            information, gradient = now.T @ flat, now.T @ residual.ravel()
            rest = residual - J_c @ np.linalg.solve(information[:p, :p], gradient[:p])
            r2 = (rest * (weight @ rest[:, :, None])[:, :, 0]).sum(axis=1)
            median = max(np.median(r2), 1e-12)
            robust = 1 / (1 + r2 / median)
        information[p:, p:] += prior + held * 1e3 * np.trace(information) * turns.T @ turns
        step = np.linalg.solve(information, gradient - np.append(np.zeros(p), prior @ offset.ravel()))[p:]
        cost = len(r) * np.log(median) + 2 * np.log1p(r2 / median).sum()
        return float(cost), offset + step.reshape(offset.shape)

    starts = []
    for few in np.split(np.tensordot(list(product(_GRID_MM, repeat=3)), along, 1), 9):  # all at once need much memory
        few = np.stack([gauss_newton(*one)[1] for one in zip(few, of_rows(few), strict=True)])
        starts += [(gauss_newton(*one)[0], one[0]) for one in zip(few, of_rows(few), strict=True)]
    best = min(starts, key=lambda start: start[0])
    for _, offset in sorted(starts, key=lambda start: start[0])[:_REFINED]:
        (cost, to), share = gauss_newton(offset), 1.0
        for _ in range(10):
            new = gauss_newton(offset + share * (to - offset))
            if new[0] > cost:
                share /= 2
                continue
            settled = cost - new[0] < _SETTLED
            offset, cost, to, share = offset + share * (to - offset), *new, 1.0
            if settled:
                break
        best = min(best, (cost, offset), key=lambda start: start[0])
    return best[1]


def _turns(k: int) -> tuple[np.ndarray, np.ndarray]:
    """The three linear combinations of offsets (k, 3) that turn the axes: rows (3, 3 k), and offsets (3, k, 3) of one each.

    They are the shift of the tips' middle relative to the base, across and normal, and of tip_2 relative to tip_1, normal.
    """
    rows = [[0, -1, 0, 0, 0.5, 0, 0, 0.5, 0], [0, 0, -1, 0, 0, 0.5, 0, 0, 0.5], [0, 0, 0, 0, 0, -1, 0, 0, 1]]
    rows = np.array(rows)[:, : 3 * k]
    return rows, np.linalg.pinv(rows).T.reshape(3, k, 3)


def _by_offset(axes: Axes, offset: np.ndarray, landmark: np.ndarray, own: np.ndarray) -> np.ndarray:
    """(n, m, k m): derivatives of the rows' shifts (n, m) by offsets (k, m); a function `axes` makes the axes `own` turn."""
    k, m = offset.shape
    J = np.einsum("nij,nk->nikj", own, np.eye(k)[landmark]).reshape(-1, m, k * m)
    if callable(axes):
        turns, along = _turns(k)
        more, less = axes(offset + _STEP * np.stack([along, -along]))
        J = J + np.einsum("tnij,nj->nit", (more - less) / (2 * _STEP), offset[landmark]) @ turns
    return J


def _evidence(information: np.ndarray, gradient: np.ndarray, least: float) -> tuple[float, tuple[int, float]]:
    """The prior's standard deviation (`least` to 3000 times that) of maximum evidence, and a score test of no offsets.

    The test's degrees of freedom and chi-square are of the directions whose standard deviation is below 500 times `least`.
    """
    values, vectors = np.linalg.eigh(information)
    along, candidates = (vectors.T @ gradient) ** 2, least * np.geomspace(1, 3000, 60)
    inflation = 1.0 + candidates[:, None] ** 2 * np.maximum(values, 0.0)
    evidence = (along * candidates[:, None] ** 2 / inflation - np.log(inflation)).sum(axis=1)
    known = values * (500 * least) ** 2 > 1.0
    return float(candidates[np.argmax(evidence)]), (int(known.sum()), float((along[known] / values[known]).sum()))


def further_step(found: Calibration, data: Correspondences, column: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Estimates one more parameter, 0 so far, of the calibration `found` of `data`: its value and standard deviation.

    One Gauss-Newton step in it, cameras and offsets together; `column` (inliers, m) is the derivative of the pixels by it.
    The third result (q,) is how the parameters of `joint_covariance` follow it.
    """
    rows, learnt = data.subset(found.inliers), found.offsets
    J_x, J_c, weight, r = found.system
    parts, now, prior = [J_c, column[:, :, None]], np.zeros(J_c.shape[2] + 1), np.zeros(J_c.shape[2] + 1)
    if learnt is not None:
        own = np.eye(r.shape[1])[None]
        if learnt.offset.shape[1] == 3:
            own = J_x @ np.nan_to_num(rows_axes(data, learnt.offset if learnt.turns else None)[found.inliers])
        by_offset = own[:, :, None] * np.eye(len(learnt.offset))[rows.landmark][:, None, :, None]
        parts.insert(1, by_offset.reshape(*r.shape, -1))
        now = np.insert(now, -1, learnt.offset.ravel())
        prior = np.insert(prior, -1, np.full(learnt.offset.size, learnt.prior_sd**-2))
    J = np.concatenate(parts, axis=2)
    weighted = (weight @ J).reshape(-1, J.shape[2])
    information = weighted.T @ J.reshape(weighted.shape) + np.diag(prior)
    step = np.linalg.solve(information, weighted.T @ r.ravel() - prior * now)[-1]
    sd = np.sqrt(sandwich(J, weight, r, J_x, rows.frame, rows.landmark, np.diag(prior))[0][-1, -1])
    return float(step), float(sd), -np.linalg.solve(information[:-1, :-1], information[:-1, -1])
