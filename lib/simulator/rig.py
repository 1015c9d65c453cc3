"""The reference rig: two cameras of a stereo microscope over a robot, and correspondences as it sees them.

Microscope frame: origin at the centre of the field on the focal plane, x right and y down in the unrotated
image, z away from the cameras (into the eye), millimetres.
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from lib.cameras import StereoRig
from lib.correspondences import Correspondences
from lib.geometry import RigidTransform
from lib.simulator.microscope import IMAGE_SIZE_PX, ROBOT_FROM_MICROSCOPE, Microscope

__all__ = ["IMAGE_SIZE_PX", "ROBOT_FROM_MICROSCOPE", "SimulatedSweep", "reference_rig", "simulate_correspondences"]


def reference_rig(*, robot_from_microscope: RigidTransform = ROBOT_FROM_MICROSCOPE, **geometry: object) -> StereoRig:
    """The rig that the simulator models by default: 10 um a pixel, 6.5 degrees between the axes.

    Args:
        robot_from_microscope: Where the microscope stands; the identity gives the rig in the microscope frame.
        geometry: Attributes of `Microscope` such as pixels_per_mm, image_size_px, inverse_distance_per_mm.

    >>> bool(reference_rig().is_affine), bool(reference_rig(inverse_distance_per_mm=1 / 150).is_affine)
    (True, False)
    """
    return Microscope(**geometry).rig(robot_from_microscope)


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
    n: int, *, rng: np.random.Generator, rig: StereoRig | None = None,
    half_size_mm: tuple[float, float, float] = (8.0, 4.5, 1.5), sigma_u_px: float = 1.5, sigma_x_mm: float = 0.010,
    robot_from_microscope: RigidTransform = ROBOT_FROM_MICROSCOPE,
) -> SimulatedSweep:  # fmt: skip
    """`n` positions spread over the field and the depth of field, as the rig sees them and the robot reports them.

    Args:
        half_size_mm: Half extents (3,) of the box of positions in the microscope frame; the default fills the image.
        sigma_u_px, sigma_x_mm: Standard deviation per coordinate of detections and reports.  The rows do not state it.

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
