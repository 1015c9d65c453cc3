"""Constant offsets of the landmarks, estimated along with the cameras.

What a detector marks may lie some hundredths of a millimetre beside the landmark, always in the same direction of the tool,
and such an error does not average out.  With the robot's landmark k at x and the tool's axes R, the marked point is
x + R d_k.  The data cannot tell all nine numbers d from a shift of the cameras, so they have a Gaussian prior of zero mean,
whose width the data choose (empirical Bayes).  What the data cannot tell stays in the covariance.
"""

import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc

from lib.calibration.calibration import Calibration, LandmarkOffsets
from lib.calibration.scatter import sandwich
from lib.correspondences import Correspondences


def tool_axes(x_mm: ArrayLike, offset_mm: np.ndarray | None = None) -> np.ndarray:
    """Axes R (n, 3, 3) of a forceps from its landmarks (n, 3, 3) mm: columns along it, from tip to tip, and their normal.

    With `offset_mm` (3, 3), those of the landmarks moved by it in these very axes, which turns those of nearly shut jaws.
    NaN where the jaws are shut (tips closer than 5 % of the tool's length), a landmark is missing, or no axes fulfil that.

    >>> tool_axes([[[0, 0, 0], [3, -0.5, 0], [3, 0.5, 0]]])[0].tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    x = np.asarray(x_mm, dtype=np.float64)
    if x.ndim != 3 or x.shape[1:] != (3, 3):
        raise ValueError(f"x_mm: expected base, tip_1 and tip_2 (n, 3, 3), got {x.shape}.")
    offset = np.zeros((3, 3)) if offset_mm is None else offset_mm
    middle, apart, axes = offset[1:].mean(axis=0) - offset[0], offset[2] - offset[1], np.zeros((len(x), 3, 3))
    for _ in range(1 if offset_mm is None else 10):  # of the direction along the tool; the turn about it is exact
        along = x[:, 1:].mean(axis=1) - x[:, 0] + np.nan_to_num(axes) @ middle
        length = np.linalg.norm(along, axis=1, keepdims=True)
        with np.errstate(invalid="ignore", divide="ignore"):
            along, across = along / length, x[:, 2] - x[:, 1]
            across = across - (across * along).sum(axis=1, keepdims=True) * along
            width = np.linalg.norm(across, axis=1, keepdims=True)
            across, sine = across / width, -apart[2] / width
            cosine = np.sqrt(1 - sine**2)
            is_open = apart[1] + cosine * width > 0.05 * length
            across = np.where(is_open, cosine * across - sine * np.cross(along, across), np.nan)
        axes = np.stack([along, across, np.cross(along, across)], axis=2)
    return axes


def rows_axes(data: Correspondences, offset_mm: np.ndarray | None = None) -> np.ndarray:
    """`tool_axes` (n, 3, 3) of each row's frame; NaN too where recordings joined under the same frame numbers repeat rows.

    Where the landmarks moved by `offset_mm`, of one to three landmarks, have no axes, those of the reported ones.
    """
    if len(data) == 0 or data.landmark.max() > 2 or len(np.unique(3 * data.frame + data.landmark)) < len(data):
        return np.full((len(data), 3, 3), np.nan)
    x = data.grid("x_mm")
    axes = tool_axes(x)
    if offset_mm is not None:
        turned = tool_axes(x, np.pad(offset_mm, ((0, 3 - len(offset_mm)), (0, 0))))
        axes = np.where(np.isfinite(turned), turned, axes)
    return axes[np.unique(data.frame, return_inverse=True)[1]]


def with_offsets(data: Correspondences, offsets: LandmarkOffsets | None) -> Correspondences:
    """The rows with their landmarks where the detector sees them, as far as `Calibration.offsets` has learnt it.

    Offsets in the tool's axes move positions, where the jaws are open; offsets in the images move pixels; None nothing.
    """
    if offsets is None:
        return data
    unknown = max(data.landmark.max(initial=0) + 1 - len(offsets.offset), 0)  # landmarks that no image showed
    shift = np.pad(offsets.offset, ((0, unknown), (0, 0)))[data.landmark]
    if shift.shape[1] == 4:
        return replace(data, u_left=data.u_left - shift[:, :2], u_right=data.u_right - shift[:, 2:])
    shift = np.einsum("nij,nj->ni", rows_axes(data, offsets.offset if offsets.turns else None), shift)
    return replace(data, x_mm=data.x_mm + np.where(np.isfinite(shift), shift, 0.0))


def estimate_offsets(
    fit: Callable[..., Calibration], x: np.ndarray, y: np.ndarray, landmark: np.ndarray,
    axes: np.ndarray | None, frame: np.ndarray, prior_sd: float | None = None, iterations: int = 20,
) -> Calibration:  # fmt: skip
    """The calibration with one constant offset a landmark, in the tool's axes (n, 3, 3) or (axes=None) in the images.

    Gauss-Newton on the offsets with the cameras eliminated: every step is a whole calibration `fit` of positions (n, 3) and
    pixels (n, m) with the `views` to use, and one Schur complement; a `RuntimeWarning` where `iterations` are too few.
    Without `prior_sd` it is the one that makes the data most probable, between 0.1 and 300 um, or 0.01 and 30 px.
    """
    m = y.shape[1]
    size = m if axes is None else 3
    offset, p_value, views = np.zeros((int(landmark.max()) + 1, size)), np.nan, None
    for i in range(iterations):
        shift = offset[landmark]
        moved = (x, y - shift) if axes is None else (x + np.einsum("nij,nj->ni", axes, shift), y)
        found = fit(*moved, views=views)
        views = found.view_inliers if i >= 2 else None  # outliers that come and go from step to step would be no end
        rows = found.inliers
        J_x, J_c, weight, r = found.system
        J_o = J_x @ axes[rows] if axes is not None else np.broadcast_to(np.eye(m), (rows.sum(), m, m))
        J = (J_o[:, :, None] * (landmark[rows][:, None] == np.arange(len(offset)))[:, None, :, None]).reshape(len(r), m, -1)
        WJ = weight @ J
        H_co = np.einsum("nip,niq->pq", J_c, WJ)
        explained = np.linalg.solve(np.einsum("nip,niq->pq", J_c, weight @ J_c), H_co)
        information = np.einsum("nip,niq->pq", J, WJ) - H_co.T @ explained
        gradient = np.einsum("nip,ni->p", WJ, r)
        if np.isnan(p_value):
            chosen_sd, p_value = _evidence(information, gradient, 1e-4 if axes is not None else 1e-2)
            prior_sd = prior_sd or chosen_sd
        covariance = np.linalg.inv(information + np.eye(offset.size) / prior_sd**2)
        step = covariance @ (gradient - offset.ravel() / prior_sd**2)
        offset = offset + step.reshape(offset.shape)
        if np.abs(step).max() < 1e-4 * np.sqrt(np.diag(covariance).min()):
            break
    else:
        warnings.warn(
            f"offsets: they still move by up to {np.abs(step).max():.2g} {'px' if axes is None else 'mm'} after {iterations} "
            "steps; look at the outliers (`ransac_px`).",
            RuntimeWarning, stacklevel=3,
        )  # fmt: skip
    p = J_c.shape[2]
    prior = np.diag(np.repeat([0.0, prior_sd**-2], [p, offset.size]))
    full, effective = sandwich(np.concatenate([J_c, J], axis=2), weight, r, frame[rows], landmark[rows], prior)
    blocks = np.stack([full[j : j + size, j : j + size] for j in range(p, len(full), size)])
    learnt = LandmarkOffsets(offset, blocks, prior_sd, p_value)
    return replace(found, parameter_covariance=full[:p, :p], effective_rows=effective, offsets=learnt)


def _evidence(information: np.ndarray, gradient: np.ndarray, least: float) -> tuple[float, float]:
    """The prior's standard deviation, `least` to 3000 times that, of greatest evidence (the offsets integrated out).

    And the p-value of no offsets, in the directions that the data know better than to 500 times `least`.
    """
    values, vectors = np.linalg.eigh(information)
    along, candidates = (vectors.T @ gradient) ** 2, least * np.geomspace(1, 3000, 60)
    inflation = 1.0 + candidates[:, None] ** 2 * np.maximum(values, 0.0)
    evidence = (along * candidates[:, None] ** 2 / inflation - np.log(inflation)).sum(axis=1)
    known = values * (500 * least) ** 2 > 1.0
    p_value = float(chdtrc(known.sum(), (along[known] / values[known]).sum())) if known.any() else 1.0
    return float(candidates[np.argmax(evidence)]), p_value
