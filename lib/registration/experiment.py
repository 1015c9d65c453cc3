"""The paper's registration experiment (Sec. V): known projections moved by a known motion, then recovered."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from lib.cameras import StereoRig
from lib.geometry import RigidTransform
from lib.registration.images import perturb
from lib.registration.rigid import Registration
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig

__all__ = ["ToolFrames", "motion_error", "random_motion", "registration_errors", "tool_frames"]

#: An estimator of the motion from what is at hand: (rig, x_mm (n, 3), u_left (n, 2), u_right (n, 2)).
Estimator = Callable[[StereoRig, np.ndarray, np.ndarray, np.ndarray], Registration]


@dataclass(frozen=True)
class ToolFrames:
    """Landmarks of a moving tool: `x_mm` (n, 3, 3) and `u_left`, `u_right` (n, 3, 2) with noise, and the true x."""

    x_mm: np.ndarray
    u_left: np.ndarray
    u_right: np.ndarray
    true_x_mm: np.ndarray


def tool_frames(
    n: int,
    *,
    rng: np.random.Generator,
    rig: StereoRig | None = None,
    sigma_u_px: float = 1.5,
    sigma_x_mm: float = 0.010,
    half_size_mm: tuple[float, float, float] = (5.0, 3.0, 1.2),
    jaw_mm: tuple[float, float] = (2.0, 4.0),
    opening_rad: tuple[float, float] = (0.05, 0.40),
    robot_from_microscope: RigidTransform = ROBOT_FROM_MICROSCOPE,
) -> ToolFrames:
    """A forceps in n poses of the field, seen by `rig` and told by the robot.

    Parameters
    ----------
    rig:
        What the cameras are now (a perturbed one in the experiment); None is the reference rig.
    half_size_mm:
        Half extents of the base's positions in the microscope frame, within the field and the depth of field.
    jaw_mm:
        Length of the jaws, drawn once: one tool.
    opening_rad:
        Angle between the jaws, drawn for each frame.
    """
    rig = rig or reference_rig(robot_from_microscope=robot_from_microscope)
    jaw = rng.uniform(*jaw_mm)
    half = rng.uniform(*opening_rad, n) / 2
    zero = np.zeros(n)
    # Base at the origin, jaws along x, opening in the x, y plane.
    tips = [jaw * np.stack([np.cos(half), sign * np.sin(half), zero], axis=1) for sign in (1, -1)]
    shape = np.stack([np.zeros((n, 3)), *tips], axis=1)
    # The shaft comes in from one side and dips towards the eye; it swings, dips and rolls with the hand.
    swing, dip, roll = rng.uniform([-0.6, 0.2, -0.8], [0.6, 0.7, 0.8], (n, 3)).T
    turn = Rotation.from_euler("ZYX", np.stack([swing, -dip, roll], axis=1)).as_matrix()
    base = rng.uniform(-1, 1, (n, 3)) * half_size_mm
    x = robot_from_microscope.apply(np.einsum("nij,nkj->nki", turn, shape) + base[:, None])
    u_left, u_right = (u.reshape(n, 3, 2) + rng.normal(0, sigma_u_px, (n, 3, 2)) for u in rig.project(x.reshape(-1, 3)))
    return ToolFrames(x + rng.normal(0, sigma_x_mm, x.shape), u_left, u_right, x)


def random_motion(
    rng: np.random.Generator,
    *,
    centre_mm: np.ndarray,
    rotation_rad: float = np.deg2rad(5.0),
    translation_mm: float = 1.0,
) -> RigidTransform:
    """A motion by up to the given angle about a random axis through `centre_mm`, and up to the given shift per axis."""
    axis = rng.normal(size=3)
    R = Rotation.from_rotvec(axis / np.linalg.norm(axis) * rng.uniform(0, rotation_rad)).as_matrix()
    return RigidTransform(R, centre_mm - R @ centre_mm + rng.uniform(-translation_mm, translation_mm, 3))


def motion_error(estimate: RigidTransform, truth: RigidTransform, centre_mm: np.ndarray) -> tuple[float, np.ndarray]:
    """How far an estimated motion is off: (translation in mm, Euler angles (3,) in rad).

    The translation error is that of the point that truly is at `centre_mm` (the workspace): at the robot's origin,
    which may be far away, it would only repeat the rotation error.
    """
    residual = estimate.compose(truth.inverse())
    return float(np.linalg.norm(residual.apply(centre_mm) - centre_mm)), residual.euler_rad


def registration_errors(
    estimators: Mapping[str, Estimator],
    n_frames: Sequence[int],
    *,
    trials: int,
    rng: np.random.Generator,
    outliers: float = 0.0,
    **options: float,
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Errors of each estimator after 1, 2, ... frames of one moved rig, over many motions and tools.

    Parameters
    ----------
    estimators:
        Name to estimator; all see the same data.
    n_frames:
        Frames to use, each count from the first frames of the same sequence.
    outliers:
        Share of detections replaced by a random pixel up to 100 px away.
    options:
        For `tool_frames`, such as sigma_u_px.

    Returns
    -------
    dict
        Name to (translation (trials, len(n_frames)) in mm, Euler angles (trials, len(n_frames), 3) in rad).
    """
    rig = reference_rig()
    centre_mm = ROBOT_FROM_MICROSCOPE.t
    translation = {name: np.empty((trials, len(n_frames))) for name in estimators}
    angles = {name: np.empty((trials, len(n_frames), 3)) for name in estimators}
    for trial in range(trials):
        motion = random_motion(rng, centre_mm=centre_mm)
        frames = tool_frames(max(n_frames), rng=rng, rig=perturb(rig, motion), **options)
        u = [frames.u_left.copy(), frames.u_right.copy()]
        for image in u:
            bad = rng.random(image.shape[:2]) < outliers
            image[bad] += rng.uniform(-100, 100, (int(bad.sum()), 2))
        for j, n in enumerate(n_frames):
            data = (frames.x_mm[:n].reshape(-1, 3), u[0][:n].reshape(-1, 2), u[1][:n].reshape(-1, 2))
            for name, estimator in estimators.items():
                error = motion_error(estimator(rig, *data).transform, motion, centre_mm)
                translation[name][trial, j], angles[name][trial, j] = error
    return {name: (translation[name], angles[name]) for name in estimators}
