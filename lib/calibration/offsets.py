"""Landmarks that are not seen where the robot says they are: constant offsets estimated along with the cameras.

A landmark is a point that a designer chose, and what a detector (or a person) marks on the tool may lie some hundredths
of a millimetre beside it, always in the same direction of the tool.  Such a systematic error does not average out.
With the robot's landmark k at x and the tool's axes R, the marked point is x + R d_k.  The nine numbers d are nuisance
parameters: estimated together with the cameras, or rather, since not all of them can be told from a shift of the
cameras, with a Gaussian prior of zero mean, whose width the data choose too (empirical Bayes).  What the data cannot tell
then stays in the covariance.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from lib.calibration.estimate import Calibration, calibrate

__all__ = ["OffsetCalibration", "calibrate_with_offsets", "tool_axes"]


def tool_axes(x_mm: ArrayLike) -> np.ndarray:
    """Axes R (n, 3, 3) of a forceps from its landmarks (n, 3, 3) mm: columns along it, from tip to tip, and their normal.

    NaN where the jaws are shut (tips closer than 5 % of the tool's length) or a landmark is missing.
    """
    x = np.asarray(x_mm, dtype=np.float64)
    if x.ndim != 3 or x.shape[1:] != (3, 3):
        raise ValueError(f"x_mm: expected base, tip_1 and tip_2 (n, 3, 3), got {x.shape}.")
    along = x[:, 1:].mean(axis=1) - x[:, 0]
    length = np.linalg.norm(along, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        along = along / length
        across = x[:, 2] - x[:, 1]
        across = across - (across * along).sum(axis=1, keepdims=True) * along
        width = np.linalg.norm(across, axis=1, keepdims=True)
        across = np.where(width > 0.05 * length, across / width, np.nan)
    return np.stack([along, across, np.cross(along, across)], axis=2)


@dataclass(frozen=True, eq=False)
class OffsetCalibration:
    """Cameras, and where the landmarks are seen.

    Attributes
    ----------
    calibration:
        As `calibrate` gives it, its covariances with the offsets' uncertainty in them; `x_mm` are the corrected positions.
    offset:
        (k, 3) mm in the tool's axes (along, across, normal), or (k, m) px in the images.
    covariance:
        (k, d, d) of each landmark's offset, in the squared unit.
    prior_sd:
        Of a coordinate before the data, given or chosen by the evidence.
    p_value:
        Probability of offsets as large as the data show if there are none (score test).
    """

    calibration: Calibration
    offset: np.ndarray
    covariance: np.ndarray
    prior_sd: float
    p_value: float

    @property
    def standard_deviation(self) -> np.ndarray:
        """(k, d) of the offsets."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def learnt(self) -> np.ndarray:
        """(k, d): 1 where the data determine an offset, 0 where only the prior speaks."""
        return 1.0 - (self.standard_deviation / self.prior_sd) ** 2


def calibrate_with_offsets(
    x_mm: ArrayLike,
    u: list[ArrayLike],
    landmark: ArrayLike,
    axes: ArrayLike | None,
    *,
    prior_sd: float | None = None,
    iterations: int = 20,
    **options: object,
) -> OffsetCalibration:
    """`calibrate` with one constant offset a landmark, in the tool's axes or (axes=None) in the images.

    Gauss-Newton on the offsets with the cameras eliminated: every step is a whole calibration and one Schur complement.

    Parameters
    ----------
    x_mm, u, options:
        As in `calibrate`; weighting must be "likelihood".
    landmark:
        (n,) which landmark each row is, 0 to k - 1.
    axes:
        R (n, 3, 3) of the tool in each row, from the robot's pose or from `tool_axes`.  None = offsets in the images, for
        a detector that is off by some pixels whatever the tool does; what all landmarks have in common can then not be
        told from a shift of the cameras.
    prior_sd:
        Standard deviation of an offset's coordinate, mm or px.  None = the one that makes the data most probable, between 0.1
        and 300 um, or 0.01 and 30 px; without sign of an offset it is the least, which leaves the landmarks where they are.

    iterations:
        Most steps; a `RuntimeWarning` says so where they were not enough.

    Raises
    ------
    ValueError
        As `calibrate`, and for arguments that do not fit together.
    """
    x, landmark = np.asarray(x_mm, dtype=np.float64), np.asarray(landmark)
    if landmark.shape != (len(x),) or not np.issubdtype(landmark.dtype, np.integer) or (landmark < 0).any():
        raise ValueError(f"landmark: expected {len(x)} integers from 0, got {landmark.dtype} {landmark.shape}.")
    if len(x) < 4:
        raise ValueError(f"x_mm: {len(x)} points are too few; frames with shut jaws have no axes and do not count.")
    if axes is not None:
        axes = np.asarray(axes, dtype=np.float64)
        if axes.shape != (len(x), 3, 3) or not np.isfinite(axes).all():
            raise ValueError(f"axes: expected ({len(x)}, 3, 3) finite, got {axes.shape}; drop rows of shut jaws.")
    if options.get("weighting", "likelihood") != "likelihood":
        raise ValueError("weighting: offsets need the likelihood's weights.")
    if iterations < 1:
        raise ValueError(f"iterations: must be at least 1, got {iterations}.")
    if prior_sd is not None and not prior_sd > 0:
        raise ValueError(f"prior_sd: must be positive, got {prior_sd}.")
    k, m = int(landmark.max()) + 1, 2 * len(u)
    size = 3 if axes is not None else m
    offset = np.zeros((k, size))
    pixels = [np.asarray(part, dtype=np.float64) for part in u]
    p_value = np.nan
    for _ in range(iterations):
        if axes is not None:
            moved, seen = x + np.einsum("nij,nj->ni", axes, offset[landmark]), pixels
        else:
            moved = x
            seen = [part - offset[landmark, 2 * i : 2 * i + 2] for i, part in enumerate(pixels)]
        found = calibrate(moved, seen, **options)
        rows = found.inliers
        J_c, J_x, weight, r = _system(found)
        J_o = J_x @ axes[rows] if axes is not None else np.broadcast_to(np.eye(m), (rows.sum(), m, m))
        J = np.zeros((rows.sum(), m, k * size))
        for j in range(k):
            own = landmark[rows] == j
            J[own, :, j * size : (j + 1) * size] = J_o[own]
        WJ = weight @ J
        H_cc = np.einsum("nip,niq->pq", J_c, weight @ J_c)
        H_co = np.einsum("nip,niq->pq", J_c, WJ)
        explained = np.linalg.solve(H_cc, H_co)
        information = np.einsum("nip,niq->pq", J, WJ) - H_co.T @ explained
        gradient = np.einsum("nip,ni->p", WJ, r)
        if np.isnan(p_value):
            least = 1e-4 if axes is not None else 1e-2
            p_value = _score_test(information, gradient, 500 * least)
            prior_sd = prior_sd or _most_probable(information, gradient, least * np.geomspace(1, 3000, 60))
        covariance = np.linalg.inv(information + np.eye(k * size) / prior_sd**2)
        step = covariance @ (gradient - offset.ravel() / prior_sd**2)
        offset = offset + step.reshape(offset.shape)
        if np.abs(step).max() < 1e-4 * np.sqrt(np.diag(covariance).min()):
            break
    else:
        warnings.warn(
            f"iterations: the offsets still move by up to {np.abs(step).max():.2g} {'px' if axes is None else 'mm'} after "
            f"{iterations}; allow more, or look at the outliers (`ransac_px`), which may differ from step to step.",
            RuntimeWarning,
            stacklevel=2,
        )
    parameters = found.parameter_covariance + explained @ covariance @ explained.T
    G = found._fit.state.matrix_jacobian() @ found._model.selection
    found = replace(found, parameter_covariance=parameters, covariance=G @ parameters @ G.T)
    blocks = np.stack([covariance[j * size : (j + 1) * size, j * size : (j + 1) * size] for j in range(k)])
    return OffsetCalibration(found, offset, blocks, prior_sd, p_value)


def _system(c: Calibration) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Over the inliers: derivatives by the parameters and by the points, inverse covariance of the residuals, residuals."""
    state, points = c._fit.state, c._fit.points
    _, J_x, J_c = state.evaluate(points)
    S = c._residual_covariance(points, c._inlier_noise)
    return J_c @ c._model.selection, J_x, np.linalg.inv(S), c._fit.residuals


def _most_probable(information: np.ndarray, gradient: np.ndarray, candidates: np.ndarray) -> float:
    """The prior's standard deviation of greatest evidence, the offsets integrated out."""
    values, vectors = np.linalg.eigh(information)
    values, along = np.maximum(values, 0.0), (vectors.T @ gradient) ** 2
    inflation = 1.0 + candidates[:, None] ** 2 * values
    evidence = (along * candidates[:, None] ** 2 / inflation - np.log(inflation)).sum(axis=1)
    return float(candidates[np.argmax(evidence)])


def _score_test(information: np.ndarray, gradient: np.ndarray, largest: float) -> float:
    """p-value of no offsets, in the directions that the data know better than to `largest`."""
    values, vectors = np.linalg.eigh(information)
    known = values * largest**2 > 1.0
    if not known.any():
        return 1.0
    return float(chi2.sf(((vectors.T @ gradient)[known] ** 2 / values[known]).sum(), known.sum()))
