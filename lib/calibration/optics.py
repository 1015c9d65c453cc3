"""What the pair's geometry tells of its optics: mirrored channels, convergence, zoom, and where the microscope stands."""

from dataclasses import dataclass

import numpy as np

from lib.calibration.calibration import Calibration
from lib.geometry import RigidTransform


@dataclass(frozen=True, eq=False)
class Optics:
    """The pair as a piece of optics.

    Attributes:
        mirrored: "no"; "left", "right", "left or right" (an odd number of reflections in one channel); "both"; "unknown":
            only perspective can tell two cameras mirrored alike from unmirrored ones on the other side of the scene.
        convergence_rad: Angle between the viewing directions (of the unmirrored pair).
        roll_rad: Rotation of the right image's content relative to the left's, x towards y.
        robot_from_microscope: Pose of the stereo head: x right in the mean image, z along the mean viewing direction,
            origin where the image centres' rays come closest.
    """

    mirrored: str
    convergence_rad: float
    roll_rad: float
    robot_from_microscope: RigidTransform


def optics(calibration: Calibration) -> Optics:
    """Judge both channels together; a ValueError for a single camera, which cannot tell a mirror."""
    rig = calibration.pair
    directions = np.stack([rig.left.viewing_direction, rig.right.viewing_direction])
    cosine = float(directions[0] @ directions[1])
    # Where perspective is seen at three standard deviations; negative = mirrored.
    distance, sd = calibration.inverse_distance_per_mm
    signs = np.sign([getattr(c, "inverse_distance_per_mm", 0.0) * (abs(distance) >= 3 * sd) for c in calibration.cameras])
    if cosine < 0:
        one = "left" if signs[0] < 0 else "right"
        mirrored = one if signs.any() and signs.sum() == 0 else "left or right"
        directions[1] *= -1
    else:
        mirrored = ("both" if signs.sum() < 0 else "no") if signs.any() else "unknown"
    z = directions.sum(axis=0) * (-1.0 if mirrored in ("both", "left") else 1.0)
    z /= np.linalg.norm(z)
    rows = [camera.linear / np.linalg.norm(camera.linear, axis=1, keepdims=True) for camera in (rig.left, rig.right)]
    x = rows[0][0] if mirrored != "left" else rows[1][0]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    roll = float(np.arctan2(-rows[1][0] @ rows[0][1], rows[1][0] @ rows[0][0]))
    if calibration.image_size_px is not None:
        centre = (np.asarray(calibration.image_size_px, dtype=float) - 1) / 2
    else:
        centre = np.nanmean(calibration.y_px[calibration.inliers].reshape(-1, 2, 2), axis=(0, 1))
    origin = rig.triangulate(centre[None], centre[None]).x_mm[0]
    angle = float(np.arccos(np.clip(abs(cosine), -1, 1)))
    return Optics(mirrored, angle, roll, RigidTransform(np.column_stack([x, y, z]), origin))
