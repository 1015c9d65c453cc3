"""The paper's second experiment: reconstruct a checkerboard of known squares with the calibration from the tool."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lib.cameras import StereoRig
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE

__all__ = ["BoardError", "board_error", "find_corners", "measure_boards"]


@dataclass(frozen=True)
class BoardError:
    """RMS 3D distance (um) of triangulated corners to the known grid, and how many corners.

    Attributes
    ----------
    aligned_um:
        After rigid alignment (no scale): the paper's experiment.
    robot_um:
        To the true corners in the robot frame, nothing aligned.
    corners:
        Number of corners.
    """

    aligned_um: float
    robot_um: float
    corners: int


def find_corners(image: np.ndarray, shape: tuple[int, int]) -> np.ndarray | None:
    """Inner corners (columns * rows, 2) px of an RGB image to sub-pixel by OpenCV, row by row, or None.

    A board with odd numbers of inner corners looks the same from its other end, so the order may be reversed.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    found, corners = cv2.findChessboardCornersSB(grey, shape, flags=cv2.CALIB_CB_ACCURACY)
    return corners.reshape(-1, 2).astype(np.float64) if found else None


def board_error(rig: StereoRig, u_left: np.ndarray, u_right: np.ndarray, corners_mm: np.ndarray) -> BoardError:
    """Triangulate the corners found in a pair with `rig`, and compare with the known grid.

    Parameters
    ----------
    u_left, u_right:
        Corners (n, 2) px, each in board order or reversed.
    corners_mm:
        True corners (n, 3) in the robot frame, row by row.
    """
    # The detector may start at either end in each image: the epipolar geometry tells which orders belong together.
    u_right = min((u_right, u_right[::-1]), key=lambda u: np.square(rig.epipolar_distance(u_left, u)).sum())
    x = rig.triangulate(u_left, u_right).x_mm
    if np.square(x - corners_mm).sum() > np.square(x[::-1] - corners_mm).sum():
        x = x[::-1]
    centred, grid = x - x.mean(axis=0), corners_mm - corners_mm.mean(axis=0)
    u, _, vt = np.linalg.svd(grid.T @ centred)
    R = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    errors = (centred @ R.T - grid, x - corners_mm)
    return BoardError(*(1e3 * float(np.sqrt((e**2).sum(axis=1).mean())) for e in errors), len(x))


def measure_boards(
    rigs: dict[str, StereoRig], *, inverse_distance_per_mm: float = 0.0, boards: int = 4, seed: int = 0
) -> dict[str, BoardError]:
    """Errors of several rigs on the same rendered 0.5 mm checkerboards, pooled over the boards.

    Parameters
    ----------
    rigs:
        Robot-frame rigs by name.
    inverse_distance_per_mm:
        Of the rendered microscope; 0 is affine optics.
    boards:
        Poses, drawn within the field and depth of field.

    Raises
    ------
    ValueError
        If OpenCV finds no board at all.
    """
    from lib.simulator import Checkerboard, Microscope, render_pair
    from lib.simulator.scenes import checkerboard_poses

    rng = np.random.default_rng(seed)
    microscope = Microscope(inverse_distance_per_mm=inverse_distance_per_mm)
    found: dict[str, list[BoardError]] = {name: [] for name in rigs}
    for pose in checkerboard_poses(boards, rng):
        board = Checkerboard(pose)
        left, right = render_pair(board, microscope, rng=rng)
        corners = ROBOT_FROM_MICROSCOPE.apply(board.corners_mm)
        seen = [find_corners(view.image, (board.columns - 1, board.rows - 1)) for view in (left, right)]
        if all(u is not None for u in seen):
            for name, rig in rigs.items():
                found[name].append(board_error(rig, *seen, corners))
    if not all(found.values()):
        raise ValueError("measure_boards: no checkerboard was found in any image.")
    pooled = {}
    for name, errors in found.items():
        n = np.array([e.corners for e in errors])
        mean = [
            np.sqrt((n * np.square([getattr(e, k) for e in errors])).sum() / n.sum())
            for k in ("aligned_um", "robot_um")
        ]
        pooled[name] = BoardError(float(mean[0]), float(mean[1]), int(n.sum()))
    return pooled
