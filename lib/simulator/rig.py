"""The reference rig: two cameras of a stereo microscope over a robot, and correspondences as it sees them.

Microscope frame: origin at the centre of the field on the focal plane, x right and y down in the unrotated
image, z away from the cameras (into the eye), millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from lib.cameras import AffineCamera, NearAffineCamera, StereoRig
from lib.correspondences import Correspondences
from lib.geometry import RigidTransform

__all__ = ["IMAGE_SIZE_PX", "ROBOT_FROM_MICROSCOPE", "SimulatedSweep", "reference_rig", "simulate_correspondences"]

IMAGE_SIZE_PX = (1920, 1080)

#: Where the reference microscope stands over the reference robot: any general pose would do.
ROBOT_FROM_MICROSCOPE = RigidTransform.from_rotation_vector((0.15, 2.90, -0.25), (12.0, -7.0, 35.0))


def reference_rig(
    *,
    pixels_per_mm: tuple[float, float] = (100.0, 98.0),
    image_rotation_rad: tuple[float, float] = (0.020, -0.015),
    convergence_rad: float = np.deg2rad(6.5),
    image_size_px: tuple[int, int] = IMAGE_SIZE_PX,
    inverse_distance_per_mm: float = 0.0,
    robot_from_microscope: RigidTransform = ROBOT_FROM_MICROSCOPE,
) -> StereoRig:
    """The rig that the simulator models by default: 10 um a pixel, 6.5 degrees between the axes.

    Args:
        pixels_per_mm, image_rotation_rad: Zoom and in-plane rotation, (left, right), independent of each other.
        convergence_rad: Angle between the two viewing directions.
        inverse_distance_per_mm: One over the working distance; 0 makes the cameras affine, anything else near-affine.
        robot_from_microscope: Where the microscope stands; the identity gives the rig in the microscope frame.

    Raises:
        ValueError: For a zoom or convergence that is not positive.

    >>> bool(reference_rig().is_affine), bool(reference_rig(inverse_distance_per_mm=1 / 150).is_affine)
    (True, False)
    """
    if min(pixels_per_mm) <= 0:
        raise ValueError(f"pixels_per_mm: must be positive, got {pixels_per_mm}.")
    if not 0 < convergence_rad < np.pi / 2:
        raise ValueError(f"convergence_rad: must lie between 0 and pi/2, got {convergence_rad}.")
    centre_px = (np.array(image_size_px) - 1) / 2
    microscope_from_robot = robot_from_microscope.inverse()
    cameras = []
    for side, zoom, roll in zip((+1, -1), pixels_per_mm, image_rotation_rad, strict=True):
        # The left camera stands at negative x and looks towards positive x.
        tilt = RigidTransform.from_rotation_vector((0.0, -side * convergence_rad / 2, 0.0))
        spin = RigidTransform.from_rotation_vector((0.0, 0.0, roll))
        camera_from_robot = spin.compose(tilt).compose(microscope_from_robot)
        linear = zoom * camera_from_robot.R[:2]
        matrix = np.column_stack([linear, zoom * camera_from_robot.t[:2] + centre_px])
        if inverse_distance_per_mm:
            cameras.append(NearAffineCamera(matrix, inverse_distance_per_mm, centre_px, robot_from_microscope.t))
        else:
            cameras.append(AffineCamera(matrix))
    return StereoRig(*cameras)


@dataclass(frozen=True, eq=False)
class SimulatedSweep(Correspondences):
    """`Correspondences` with noise, and the truth beside them: `true_x_mm` (n, 3) and `true_rig`."""

    true_x_mm: np.ndarray
    true_rig: StereoRig

    def subset(self, rows: slice | ArrayLike) -> Correspondences:
        """The rows that a slice, a mask or an array of indices names, without the truth."""
        plain = {f.name: getattr(self, f.name) for f in fields(Correspondences)}
        return Correspondences(**plain).subset(rows)


def simulate_correspondences(
    n: int,
    *,
    rng: np.random.Generator,
    rig: StereoRig | None = None,
    half_size_mm: tuple[float, float, float] = (8.0, 4.5, 1.5),
    sigma_u_px: float = 1.5,
    sigma_x_mm: float = 0.010,
    robot_from_microscope: RigidTransform = ROBOT_FROM_MICROSCOPE,
) -> SimulatedSweep:
    """Landmark positions spread over the field and the depth of field, as the rig sees them and the robot reports them.

    Args:
        n: Number of correspondences.
        half_size_mm: Half extents (3,) of the box of positions in the microscope frame; the default fills the image.
        sigma_u_px, sigma_x_mm: Standard deviation per coordinate of detections and of the robot's report.  The rows do
            not state it.

    >>> sweep = simulate_correspondences(500, rng=np.random.default_rng(0), sigma_u_px=2.0)
    >>> len(sweep.complete), float(np.std(sweep.true_rig.left.project(sweep.true_x_mm) - sweep.u_left).round(1))
    (500, 2.0)
    """
    rig = rig or reference_rig(robot_from_microscope=robot_from_microscope)
    true_x = robot_from_microscope.apply(rng.uniform(-1, 1, (n, 3)) * half_size_mm)
    u_left, u_right = (u + rng.normal(0, sigma_u_px, u.shape) for u in rig.project(true_x))
    x = true_x + rng.normal(0, sigma_x_mm, (n, 3))
    rows = Correspondences.of_points(x, u_left, u_right)
    return SimulatedSweep(**vars(rows), true_x_mm=true_x, true_rig=rig)
