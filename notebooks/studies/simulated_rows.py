"""Correspondences of the reference rig, simulated without images."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from lib.cameras import StereoRig
from lib.correspondences import Correspondences
from lib.geometry import RigidTransform
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig


@dataclass(frozen=True, eq=False)
class SimulatedSweep(Correspondences):
    """`Correspondences` with noise, and their truth: `true_x_mm` (n, 3) and `true_rig`."""

    true_x_mm: np.ndarray
    true_rig: StereoRig

    def subset(self, rows: slice | ArrayLike) -> Correspondences:
        """The rows selected by a slice, a mask or an array of indices, without the truth."""
        return Correspondences(**{f.name: getattr(self, f.name) for f in fields(Correspondences)}).subset(rows)


def simulate_correspondences(
    n: int, *, rng: np.random.Generator, rig: StereoRig | None = None,
    half_size_mm: tuple[float, float, float] = (8.0, 4.5, 1.5), sigma_u_px: float = 1.5, sigma_x_mm: float = 0.010,
    robot_from_microscope: RigidTransform = ROBOT_FROM_MICROSCOPE,
) -> SimulatedSweep:  # fmt: skip
    """`n` positions in a box around the microscope frame's origin, detected by the rig and reported by the robot.

    `sigma_u_px` and `sigma_x_mm` are the standard deviations per coordinate; they are not stored in the rows.
    """
    rig = rig or reference_rig(robot_from_microscope=robot_from_microscope)
    true_x = robot_from_microscope.apply(rng.uniform(-1, 1, (n, 3)) * half_size_mm)
    u_left, u_right = (u + rng.normal(0, sigma_u_px, u.shape) for u in rig.project(true_x))
    x = true_x + rng.normal(0, sigma_x_mm, (n, 3))
    rows = Correspondences.of_points(x, u_left, u_right)
    return SimulatedSweep(**vars(rows), true_x_mm=true_x, true_rig=rig)
