"""Is this data enough, and where should the tool go next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lib.calibration.calibration import Calibration
from lib.geometry import finite_points, points

__all__ = ["Advice", "advise", "box_grid", "next_positions"]


@dataclass(frozen=True)
class Advice:
    """What to do.

    Attributes:
        enough: True where calibration adds less than a tenth to the error of every triangulated point asked for.
        worst_ratio, worst_depth_um: Largest sd of these points from calibration alone: over that from one detection, and
            in depth.
        next_position_mm, gain: The reachable position (3,) that helps most, and the log det of the information it adds.
    """

    enough: bool
    worst_ratio: float
    worst_depth_um: float
    next_position_mm: np.ndarray
    gain: float


def box_grid(low_mm: ArrayLike, high_mm: ArrayLike, steps: int = 5) -> np.ndarray:
    """(steps^3, 3) points of a box in the robot frame, its corners among them.

    >>> box_grid([0, 0, 0], [1, 2, 3], steps=2)[-1].tolist()
    [1.0, 2.0, 3.0]
    """
    low, high = finite_points(low_mm, 3, "low_mm")[0], finite_points(high_mm, 3, "high_mm")[0]
    if not (high > low).all():
        raise ValueError(f"high_mm: must be above low_mm in every coordinate, got {low} and {high}.")
    axes = np.linspace(low, high, steps).T
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def next_positions(calibration: Calibration, candidates_mm: ArrayLike, count: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Positions (count, 3) mm, chosen one after another, whose correspondences raise det(information) most; and log gains.

    det(H^T H + h h^T) = det(H^T H)(1 + leverage), so for the affine model this is the largest leverage.
    """
    x = finite_points(candidates_mm, 3, "candidates_mm")
    J, S = calibration.derivatives(x)[1], calibration.row_covariance(x)
    covariance = calibration.parameter_covariance
    chosen, gains = [], []
    for _ in range(count):
        # D-optimality of one more correspondence at each x: log det(I + S^-1 J C J^T).
        own = J @ covariance @ np.swapaxes(J, 1, 2)
        gain = np.linalg.slogdet(np.eye(S.shape[-1]) + np.linalg.solve(S, own))[1]
        best = int(gain.argmax())
        CJ = covariance @ J[best].T
        covariance = covariance - CJ @ np.linalg.solve(S[best] + own[best], CJ.T)
        chosen.append(x[best])
        gains.append(gain[best])
    return np.array(chosen), np.array(gains)


def advise(
    calibration: Calibration, low_mm: ArrayLike, high_mm: ArrayLike, workspace_mm: ArrayLike | None = None
) -> Advice:
    """Judge a stereo calibration over a workspace, and say where to move next.

    Args:
        low_mm, high_mm: Corners of the box that the tool can reach in view of both cameras; a ValueError where empty.
        workspace_mm: (n, 3) points that will be reconstructed; None is a grid over the box.
    """
    grid = box_grid(low_mm, high_mm) if workspace_mm is None else points(workspace_mm, 3, "workspace_mm")
    alone, both = (calibration.point_covariance(grid, detection=detection) for detection in (False, True))
    # Per point, the direction in which calibration adds most to what one detection leaves uncertain anyway.
    ratio = np.sqrt(np.linalg.eigvals(np.linalg.solve(both - alone, alone)).real.max(axis=1).max())
    depth_um = 1e3 * float(calibration.depth_sd_mm(grid).max())
    # Leverage is a convex function of the position, so over a box it is largest at a corner.
    (position,), (gain,) = next_positions(calibration, box_grid(low_mm, high_mm, steps=2))
    return Advice(bool(np.sqrt(1 + ratio**2) < 1.10), float(ratio), depth_um, position, float(gain))
