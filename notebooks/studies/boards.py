"""The paper's second experiment: render checkerboards, reconstruct them with a rig, compare with the known grid."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lib.cameras import StereoRig
from lib.geometry import align_rotation
from lib.simulator import Microscope, render_pair
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE
from notebooks.studies.cameras import rms
from notebooks.studies.scenes import Checkerboard, checkerboard_poses


@dataclass(frozen=True)
class SeenBoard:
    """Corners that OpenCV found in a stereo pair, (n, 2) px in each image, and their true positions, (n, 3) mm robot frame.

    The corners of an image are in the order of `corners_mm` or reversed: a board with odd numbers of inner corners looks the
    same when rotated by half a turn.
    """

    u_left: np.ndarray
    u_right: np.ndarray
    corners_mm: np.ndarray


@dataclass(frozen=True)
class BoardError:
    """RMS 3D distance (um) of triangulated corners from the known grid.

    Attributes
    ----------
    aligned_um:
        After rigid alignment (no scale): the paper's experiment.
    robot_um:
        From the true corners in the robot frame, without alignment.
    """

    aligned_um: float
    robot_um: float


def render_boards(count: int = 4, microscope: Microscope | None = None, *, seed: int = 0) -> list[SeenBoard]:
    """Render boards of 0.5 mm squares under a microscope and find their corners to sub-pixel.

    Parameters
    ----------
    count:
        Number of poses, drawn within the field and depth of field; boards that OpenCV does not find are left out.
    microscope:
        None is the reference microscope.

    Raises
    ------
    ValueError
        If no board is found at all.
    """
    rng, microscope = np.random.default_rng(seed), microscope or Microscope()
    boards = []
    for pose in checkerboard_poses(count, rng):
        board = Checkerboard(pose)
        found = []
        for view in render_pair(board, microscope, rng=rng):
            grey = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY)
            shape = (board.columns - 1, board.rows - 1)
            found.append(cv2.findChessboardCornersSB(grey, shape, flags=cv2.CALIB_CB_ACCURACY))
        if all(ok for ok, _ in found):
            u = [corners.reshape(-1, 2).astype(np.float64) for _, corners in found]
            boards.append(SeenBoard(*u, ROBOT_FROM_MICROSCOPE.apply(board.corners_mm)))
    if not boards:
        raise ValueError("render_boards: no checkerboard was found in any image.")
    return boards


def measure(rig: StereoRig, boards: list[SeenBoard]) -> BoardError:
    """Triangulate the corners of the boards with a rig in the robot frame, and compare them with the known grids."""
    aligned, robot = [], []
    for board in boards:
        u_left, corners = board.u_left, board.corners_mm
        # The epipolar geometry decides which order of the right corners matches the left ones.
        orders = (board.u_right, board.u_right[::-1])
        u_right = min(orders, key=lambda u: np.square(rig.epipolar_distance(board.u_left, u)).sum())
        x = rig.triangulate(u_left, u_right).x_mm
        x = min((x, x[::-1]), key=lambda x: np.square(x - board.corners_mm).sum())
        centred, grid = x - x.mean(axis=0), corners - corners.mean(axis=0)
        aligned.append(centred @ align_rotation(grid.T @ centred).T - grid)
        robot.append(x - corners)
    return BoardError(1e3 * rms(np.vstack(aligned)), 1e3 * rms(np.vstack(robot)))
