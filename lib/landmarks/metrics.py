"""Accuracy of detections: PCK, errors in pixels, and the calibration of covariance and confidence."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

#: The paper's range of thresholds, as fractions of the tool's length.
PCK_THRESHOLDS = np.linspace(0.001, 0.2, 200)
#: A larger error is gross: the predicted covariance is not meant to cover it.
GROSS_PX = 20.0


def _pairs(u: ArrayLike, u_true: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    u, u_true = np.asarray(u, dtype=np.float64), np.asarray(u_true, dtype=np.float64)
    if u.ndim != 3 or u.shape[1:] != (3, 2) or u.shape != u_true.shape:
        raise ValueError(f"u and u_true: expected two arrays (n, 3, 2), got {u.shape} and {u_true.shape}.")
    return u, u_true


def errors_px(u: ArrayLike, u_true: ArrayLike) -> np.ndarray:
    """Distances (n, 3) px between detections and labels (n, 3, 2): infinite if nothing was detected, NaN without a label."""
    u, u_true = _pairs(u, u_true)
    error = np.linalg.norm(u - u_true, axis=2)
    return np.where(np.isfinite(u_true).all(axis=2), np.where(np.isfinite(error), error, np.inf), np.nan)


def tool_length_px(u_true: ArrayLike) -> np.ndarray:
    """Mean distance (...) of the labelled tips of u_true (..., 3, 2) from the base; NaN without a base or without a tip.

    PCK is relative to it.  The paper normalises by "the distance of the tool-tip from its base" and leaves open which tip.
    """
    u_true = np.asarray(u_true, dtype=np.float64)
    distance = np.linalg.norm(u_true[..., 1:, :] - u_true[..., :1, :], axis=-1)
    known = np.isfinite(distance)
    return np.where(known.any(-1), np.where(known, distance, 0).sum(-1) / np.maximum(known.sum(-1), 1), np.nan)


def pck(u: ArrayLike, u_true: ArrayLike, threshold: ArrayLike = PCK_THRESHOLDS, *, length_px: ArrayLike | None = None):
    """Percentage of correct keypoints (paper Sec. V-B): those within `threshold` times the tool's length of the label.

    Takes detections and labels (n, 3, 2) px.  A missing detection counts as wrong, a missing label is not counted.
    `length_px` (n,) are the tool's lengths, None = from the labels; frames of unknown length, or none, are not counted.
    Returns percent, a float or (t,) as `threshold`; NaN if no label counts.

    >>> u_true = np.array([[[0.0, 0.0], [100.0, 0.0], [0.0, 100.0]]])
    >>> pck(u_true + [[[3, 0], [6, 0], [0, 0]]], u_true, [0.02, 0.05, 0.1]).round(1).tolist()
    [33.3, 66.7, 100.0]
    """
    length = tool_length_px(u_true) if length_px is None else np.asarray(length_px, dtype=np.float64)
    if length.shape != (len(u),):
        raise ValueError(f"length_px: expected ({len(u)},), one length a frame, got {length.shape}.")
    relative = errors_px(u, u_true) / np.where(length > 0, length, np.nan)[:, None]
    relative = np.sort(relative[~np.isnan(relative)])
    if not relative.size:
        return np.full(np.shape(threshold), np.nan)[()]
    return 100.0 * np.searchsorted(relative, np.asarray(threshold), side="right")[()] / relative.size


def nees(u: ArrayLike, u_true: ArrayLike, covariance: ArrayLike) -> np.ndarray:
    """Normalised estimation error squared (n, 3): chi-square with 2 degrees of freedom if the covariances are right."""
    u, u_true = _pairs(u, u_true)
    covariance = np.asarray(covariance, dtype=np.float64)
    known = np.isfinite(u - u_true).all(2) & np.isfinite(covariance).all((2, 3))
    value, d = np.full(known.shape, np.nan), (u - u_true)[known]
    value[known] = np.einsum("ni,ni->n", d, np.linalg.solve(covariance[known], d[..., None])[..., 0])
    return value


def reliability(confidence: ArrayLike, correct: ArrayLike, bins: int = 10) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean confidence, fraction correct and count in each bin of confidence, (bins,) each; NaN for empty bins."""
    confidence, correct = np.ravel(confidence).astype(float), np.ravel(correct).astype(float)
    which = np.clip((confidence * bins).astype(int), 0, bins - 1)
    count = np.bincount(which, minlength=bins)
    with np.errstate(invalid="ignore"):
        return np.bincount(which, confidence, bins) / count, np.bincount(which, correct, bins) / count, count


def calibration_error(confidence: ArrayLike, correct: ArrayLike) -> float:
    """Expected calibration error: the mean of |confidence - fraction correct| over bins, weighted by their counts."""
    mean, fraction, count = reliability(confidence, correct)
    used = count > 0
    return float(np.average(np.abs(mean - fraction)[used], weights=count[used])) if used.any() else np.nan


@dataclass(frozen=True)
class Scores:
    """The numbers of an evaluation: percent, pixels, counts.

    `median_px` and `p95_px` are over detected landmarks with a label.  `missed` counts labels without a detection, which
    PCK counts as wrong.  `gross` counts errors of `GROSS_PX` or more; `bias_px`, `nees` (the mean) and `coverage_95` exclude
    them.  `coverage_95` is the percentage of errors inside the 95 % ellipse.
    """

    pck_0_01: float
    pck_0_05: float
    pck_0_10: float
    auc: float
    median_px: float
    p95_px: float
    bias_px: tuple[float, float]
    nees: float
    coverage_95: float
    labels: int
    missed: int
    gross: int


def score(u: ArrayLike, u_true: ArrayLike, covariance: ArrayLike | None = None, *, length_px=None) -> Scores:
    """Compute all numbers; arguments as in `pck` and `nees`."""
    u, u_true = _pairs(u, u_true)
    error = errors_px(u, u_true)
    found, fine = error[np.isfinite(error)], error < GROSS_PX
    squared = np.zeros(0) if covariance is None else nees(u, u_true, covariance)[fine]
    squared = squared[np.isfinite(squared)]
    median, p95 = np.percentile(found, [50, 95]) if found.size else (np.nan, np.nan)
    x, y = (u - u_true)[fine].mean(axis=0) if fine.any() else (np.nan, np.nan)
    return Scores(
        *pck(u, u_true, [0.01, 0.05, 0.10], length_px=length_px).tolist(),
        auc=float(np.trapezoid(pck(u, u_true, length_px=length_px), PCK_THRESHOLDS) / np.ptp(PCK_THRESHOLDS)),
        median_px=float(median), p95_px=float(p95), bias_px=(float(x), float(y)),
        nees=float(squared.mean()) if squared.size else np.nan,
        coverage_95=100.0 * float((squared <= chdtri(2, 0.05)).mean()) if squared.size else np.nan,
        labels=int((~np.isnan(error)).sum()), missed=int(np.isinf(error).sum()), gross=int((found >= GROSS_PX).sum()),
    )  # fmt: skip
