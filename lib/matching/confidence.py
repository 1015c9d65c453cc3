"""Whether matches can be trusted: how far one stands out among the places where it might have been, and the rig's fit."""

from __future__ import annotations

import numpy as np

__all__ = ["peak_ratio", "require_fit"]


def peak_ratio(volume: np.ndarray, patch: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Response of each match, within a cell along the line, over the largest one of its patch farther away.

    The peak ratio of Hu and Mordohai (PAMI 2012), for responses, which are large where a place fits.

    Parameters
    ----------
    volume:
        (gy, gx, rows, n) responses, displacement along the epipolar line last, 0 where nothing is seen.
    patch:
        (m, 2) int, (gx, gy).
    index:
        (m,) int, which of the n displacements each match has.

    Returns
    -------
    np.ndarray
        (m,); infinite where nothing else responds, NaN where the line is too short for a rival.
    """
    x, y = patch.T
    curves = volume[y, x].max(axis=1)
    near = np.clip(index[:, None] + (-1, 0, 1), 0, curves.shape[1] - 1)
    response = np.take_along_axis(curves, near, axis=1).max(axis=1, initial=-1.0)
    np.put_along_axis(curves, near, -1.0, axis=1)
    rival = curves.max(axis=1, initial=-1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(rival >= 0, response / np.maximum(rival, 0.0), np.nan).astype(np.float64)


def require_fit(n_matches: int, epipolar_px: float, max_epipolar_px: float) -> None:
    """Refuse a rig from whose epipolar lines `n_matches` free matches lie too far, by their median `epipolar_px`.

    Raises
    ------
    ValueError
        With the distance; NaN (too few matches to tell) passes.
    """
    if epipolar_px > max_epipolar_px:
        raise ValueError(
            f"rig: it does not fit the images: the median of {n_matches} free matches lies {epipolar_px:.1f} px off its "
            f"epipolar lines, {max_epipolar_px:.1f} px are allowed (max_epipolar_px). Calibrate again, or check that left "
            "and right are not exchanged."
        )
