"""What the pair's geometry tells of its optics: mirrored channels, convergence, zoom, and where the microscope stands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lib.calibration.calibration import Calibration
from lib.cameras import NearAffineCamera
from lib.geometry import RigidTransform

__all__ = ["Optics", "optics"]


@dataclass(frozen=True, eq=False)
class Optics:
    """The pair as a piece of optics.

    Attributes:
        mirrored: "no", "left or right" (one channel has an odd number of reflections), "both", or "unknown": two affine
            cameras mirrored alike look like unmirrored ones on the other side of the scene, only perspective can tell.
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
    """Judge both channels together.

    A single affine camera cannot tell a mirror (a flip only turns its unseen third row): a ValueError.
    """
    rig = calibration.rig
    if rig is None:
        raise ValueError("optics: a single camera cannot tell mirrored optics; calibrate with [u_left, u_right].")
    directions = np.stack([rig.left.viewing_direction, rig.right.viewing_direction])
    cosine = float(directions[0] @ directions[1])
    signs = np.sign([_depth_sign(camera, calibration) for camera in (rig.left, rig.right)])
    if cosine < 0:
        mirrored = "left or right"
        if signs.any() and signs.sum() == 0:
            mirrored = "left" if signs[0] < 0 else "right"
    elif signs.any():
        mirrored = "both" if signs.sum() < 0 else "no"
    else:
        mirrored = "unknown"
    if cosine < 0:
        directions[1] *= -1
    if mirrored == "both" or (mirrored == "left"):
        directions *= -1
    z = directions.sum(axis=0)
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
        centre = calibration.y_px[calibration.inliers].reshape(-1, 2, 2).mean(axis=(0, 1))
    origin = rig.triangulate(centre[None], centre[None]).x_mm[0]
    pose = RigidTransform(np.column_stack([x, y, z]), origin)
    angle = float(np.arccos(np.clip(abs(cosine), -1, 1)))
    return Optics(mirrored, angle, roll, pose)


def _depth_sign(camera: object, calibration: Calibration) -> float:
    """+1 or -1 where perspective is seen at three standard deviations (negative = mirrored), else 0."""
    value, sd = calibration.inverse_distance_per_mm
    if not isinstance(camera, NearAffineCamera) or abs(value) < 3 * sd:
        return 0.0
    return float(np.sign(camera.inverse_distance_per_mm))
