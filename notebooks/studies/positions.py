"""Tests if data are enough to calibrate, and chooses where the tool should go next."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lib.calibration import Calibration
from lib.geometry import finite_points


def box_grid(low_mm: ArrayLike, high_mm: ArrayLike, steps: int = 5) -> np.ndarray:
    """A grid of (steps^3, 3) points in a box of the robot frame, including its corners."""
    low, high = finite_points(low_mm, 3, "low_mm")[0], finite_points(high_mm, 3, "high_mm")[0]
    if not (high > low).all():
        raise ValueError(f"high_mm: must be above low_mm in every coordinate, got {low} and {high}.")
    axes = np.linspace(low, high, steps).T
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def next_positions(calibration: Calibration, candidates_mm: ArrayLike, count: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Returns positions (count, 3) mm, each chosen to increase det(information) most, and the logarithms of the gains.

    det(H^T H + h h^T) = det(H^T H)(1 + leverage), so for the affine model the largest leverage is best.  The leverage
    is a convex function of the position, so in a box a corner is best.
    """
    x = finite_points(candidates_mm, 3, "candidates_mm")
    J_x, J = calibration.derivatives(x)
    S = calibration.noise_px2 + calibration.sigma_x_mm**2 * J_x @ J_x.mT  # covariance of the residual of a new row
    covariance = calibration.parameter_covariance
    chosen, gains = [], []
    for _ in range(count):
        # D-optimality: gain by one more correspondence at each x, log det(I + S^-1 J C J^T).
        own = J @ covariance @ np.swapaxes(J, 1, 2)
        gain = np.linalg.slogdet(np.eye(S.shape[-1]) + np.linalg.solve(S, own))[1]
        best = int(gain.argmax())
        CJ = covariance @ J[best].T
        covariance = covariance - CJ @ np.linalg.solve(S[best] + own[best], CJ.T)
        chosen.append(x[best])
        gains.append(gain[best])
    return np.array(chosen), np.array(gains)


def added_error(calibration: Calibration, x_mm: ArrayLike) -> np.ndarray:
    """(n,) relative increase of the error of points triangulated at x (n, 3) by the calibration, in the worst direction.

    If it is below 0.1 in the whole workspace, the data are enough; otherwise `next_positions` proposes where to go.
    """
    alone, both = (calibration.point_covariance(x_mm, detection=detection) for detection in (False, True))
    ratio2 = np.linalg.eigvals(np.linalg.solve(both - alone, alone)).real.max(axis=1)
    return np.sqrt(1.0 + ratio2) - 1.0
