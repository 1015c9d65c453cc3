"""Scores of matches against measured disparity, for evaluation only: no matcher uses anything from here."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates

from lib.matching.result import Matches

#: The confidences of `Matches`; a larger value means a more reliable match.
CONFIDENCES = ("score", "peak_ratio", "reciprocal")


@dataclass(frozen=True)
class DisparityScore:
    """Errors |x_left - x_right - disparity| of matches in a rectified pair.

    Attributes
    ----------
    n:
        Matches scored.
    median_px, rms_px:
        Median absolute error, and RMS of the errors up to 2 px.
    above_1, above_2, above_4:
        Fraction of the scored matches whose error is above 1, 2, 4 px.
    error_px:
        (n,) signed errors, and their left pixels `u_left` (n, 2).
    """

    n: int
    median_px: float
    rms_px: float
    above_1: float
    above_2: float
    above_4: float
    error_px: np.ndarray
    u_left: np.ndarray


def non_occluded(disparity_px: ArrayLike, *, tolerance_px: float = 1.0) -> np.ndarray:
    """Mask (h, w) of the pixels of the left image that the right camera also sees.

    A pixel is hidden if it lands outside the right image, or if another pixel of its row, nearer by more than `tolerance_px`
    of disparity, lands in the same right column.  A pixel of unknown disparity (not finite) is False.
    """
    disparity = np.asarray(disparity_px, dtype=np.float32)
    height, width = disparity.shape
    known = np.isfinite(disparity)
    target = np.arange(width, dtype=np.float32) - np.where(known, disparity, np.inf)
    rows, columns = np.nonzero(known & (target >= 0) & (target <= width - 1))
    # Nearest disparity that lands on each right pixel; it counts in both neighbouring columns, so rounding leaves no holes.
    nearest = np.full((height, width + 1), -np.inf, np.float32)
    left = np.floor(target[rows, columns]).astype(np.intp)
    for column in (left, left + 1):
        np.maximum.at(nearest, (rows, column), disparity[rows, columns])
    visible = np.zeros((height, width), bool)
    column = np.rint(target[rows, columns]).astype(np.intp)
    visible[rows, columns] = nearest[rows, column] <= disparity[rows, columns] + tolerance_px
    return visible


def score_against_disparity(
    matches: Matches, disparity_px: ArrayLike, *, flat_window_px: int | None = 3, flat_range_px: float = 1.0
) -> DisparityScore:
    """Score matches of a rectified pair where ground truth is known and not occluded.

    Parameters
    ----------
    matches:
        In pixels of the image that `disparity_px` belongs to.
    disparity_px:
        (h, w), x_right = x_left - disparity; not finite = unknown.
    flat_window_px, flat_range_px:
        Score only matches for which the truth is known in a window of this width, and varies by at most
        `flat_range_px` in it, since a patch across a depth step has no single disparity.  None scores all matches that
        are not occluded.

    Raises
    ------
    ValueError
        If `disparity_px` is not a 2-D array.
    """
    disparity = np.asarray(disparity_px, dtype=np.float32)
    if disparity.ndim != 2:
        raise ValueError(f"disparity_px: expected (h, w), got shape {disparity.shape}.")
    usable = non_occluded(disparity)
    if flat_window_px is not None:
        kernel = np.ones((flat_window_px, flat_window_px), np.uint8)
        known = np.isfinite(disparity)
        low = cv2.erode(np.where(known, disparity, -1e6), kernel)
        high = cv2.dilate(np.where(known, disparity, 1e6), kernel)
        usable &= high - low <= flat_range_px
    height, width = disparity.shape
    x, y = np.rint(matches.u_left).astype(np.intp).T
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    scored = np.flatnonzero(inside)[usable[y[inside], x[inside]]]
    u_left = matches.u_left[scored]
    # Bilinear truth where it is flat; otherwise the nearest pixel, since interpolation would mix two surfaces.
    if flat_window_px is None:
        truth = disparity[y[scored], x[scored]]
    else:
        filled = np.where(np.isfinite(disparity), disparity, 0.0)
        truth = map_coordinates(filled, u_left.T[::-1], order=1)
    error = u_left[:, 0] - matches.u_right[scored, 0] - truth
    size = np.abs(error)
    if not len(size):
        nan = float("nan")
        return DisparityScore(0, nan, nan, nan, nan, nan, error, u_left)
    small = size[size <= 2]
    return DisparityScore(
        len(size),
        float(np.median(size)),
        float(np.sqrt(np.mean(small**2))) if small.size else float("nan"),
        *(float(np.mean(size > limit)) for limit in (1, 2, 4)),
        error,
        u_left,
    )


def detection_auc(confidence: ArrayLike, wrong: ArrayLike) -> float:
    """Probability that a wrong match has a lower confidence than a right one, ties counting half.

    It is the area under the ROC curve of the confidence as a detector of wrong matches: 1 is perfect, 0.5 is chance.

    Parameters
    ----------
    confidence:
        (n,), larger is more reliable; NaN (unknown) counts as the lowest.
    wrong:
        (n,) bool.  The result is NaN if all or none are wrong.
    """
    confidence, wrong = _confidence(confidence), np.asarray(wrong, dtype=bool)
    n_wrong, n_right = int(wrong.sum()), int((~wrong).sum())
    if not n_wrong or not n_right:
        return float("nan")
    from scipy.stats import rankdata  # not at the top: it takes half a second

    ranks = rankdata(confidence)
    return float(1 - (ranks[wrong].sum() - n_wrong * (n_wrong + 1) / 2) / (n_wrong * n_right))


def sparsification(confidence: ArrayLike, wrong: ArrayLike, kept: ArrayLike) -> np.ndarray:
    """Share of wrong matches among the most confident share `kept` (k,) in (0, 1] of all; equal confidences are averaged.

    Parameters
    ----------
    confidence, wrong:
        (n,) as for `detection_auc`, n > 0.
    """
    confidence, wrong = _confidence(confidence), np.asarray(wrong, dtype=float)
    _, level, count = np.unique(confidence, return_inverse=True, return_counts=True)
    smooth = (np.bincount(level, wrong) / count)[level]
    sorted_wrong = smooth[np.argsort(-confidence, kind="stable")]
    n = np.clip(np.ceil(np.asarray(kept) * len(wrong)).astype(np.intp), 1, len(wrong))
    return np.cumsum(sorted_wrong)[n - 1] / n


def _confidence(confidence: ArrayLike) -> np.ndarray:
    confidence = np.asarray(confidence, dtype=np.float64)
    return np.where(np.isnan(confidence), -np.inf, confidence)
