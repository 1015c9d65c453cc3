"""The paper's registration experiment (Sec. V): known projections moved by a known motion, then recovered."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from lib.cameras import StereoRig
from lib.geometry import RigidTransform
from lib.registration import Registration
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig

__all__ = [
    "MotionErrors",
    "ToolFrames",
    "bumped_images",
    "motion_error",
    "random_motion",
    "recorded_registration_errors",
    "registration_errors",
    "tool_frames",
]

#: An estimator of the motion from what is at hand: (rig, x_mm (n, 3), u_left (n, 2), u_right (n, 2)).
Estimator = Callable[[StereoRig, np.ndarray, np.ndarray, np.ndarray], Registration]


@dataclass(frozen=True)
class ToolFrames:
    """Landmarks of a moving tool: `x_mm` (n, 3, 3) and `u_left`, `u_right` (n, 3, 2) with noise, and the true x."""

    x_mm: np.ndarray
    u_left: np.ndarray
    u_right: np.ndarray
    true_x_mm: np.ndarray


@dataclass(frozen=True)
class MotionErrors:
    """Errors of one estimator over trials: NaN where it could not tell.

    Attributes
    ----------
    n_frames:
        (k,) frames used.
    translation_mm:
        (trials, k) of a point at the workspace.
    euler_rad:
        (trials, k, 3) about the robot's x, y, z axes.
    """

    n_frames: tuple[int, ...]
    translation_mm: np.ndarray
    euler_rad: np.ndarray

    @classmethod
    def empty(cls, trials: int, n_frames: Sequence[int]) -> MotionErrors:
        shape = (trials, len(n_frames))
        return cls(tuple(int(n) for n in n_frames), np.full(shape, np.nan), np.full((*shape, 3), np.nan))

    @property
    def translation_rms_um(self) -> np.ndarray:
        """(k,) root mean square over the trials."""
        return 1e3 * np.sqrt(np.nanmean(self.translation_mm**2, axis=0))

    @property
    def euler_rms_deg(self) -> np.ndarray:
        """(k, 3) root mean square over the trials."""
        return np.rad2deg(np.sqrt(np.nanmean(self.euler_rad**2, axis=0)))


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
) -> dict[str, MotionErrors]:
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
    """
    rig = reference_rig()
    centre_mm = ROBOT_FROM_MICROSCOPE.t
    errors = {name: MotionErrors.empty(trials, n_frames) for name in estimators}
    for trial in range(trials):
        motion = random_motion(rng, centre_mm=centre_mm)
        frames = tool_frames(max(n_frames), rng=rng, rig=rig.moved(motion), **options)
        for u in (frames.u_left, frames.u_right):
            bad = rng.random(u.shape[:2]) < outliers
            u[bad] += rng.uniform(-100, 100, (int(bad.sum()), 2))
        _estimate_all(errors, trial, estimators, rig, (frames.x_mm, frames.u_left, frames.u_right), motion, centre_mm)
    return errors


def recorded_registration_errors(
    estimators: Mapping[str, Estimator],
    n_frames: Sequence[int],
    *,
    rig: StereoRig,
    x_mm: np.ndarray,
    u_left: np.ndarray,
    u_right: np.ndarray,
    trials: int,
    rng: np.random.Generator,
) -> dict[str, MotionErrors]:
    """The same from a recording, needing no truth: it is the calibrated projections that are moved, by a known motion.

    Parameters
    ----------
    rig:
        Calibrated with other frames than these.
    x_mm, u_left, u_right:
        (n, 3, 3) mm as the robot reports, (n, 3, 2) px as detected, in order of time; NaN = missing.  Each trial uses
        consecutive frames from a random one on.
    """
    if len(x_mm) < max(n_frames):
        raise ValueError(f"n_frames: up to {max(n_frames)} frames are asked for, the recording has {len(x_mm)}.")
    centre_mm = np.nanmean(x_mm, axis=(0, 1))
    errors = {name: MotionErrors.empty(trials, n_frames) for name in estimators}
    for trial in range(trials):
        motion = random_motion(rng, centre_mm=centre_mm)
        stale = rig.moved(motion.inverse())
        first = int(rng.integers(0, len(x_mm) - max(n_frames) + 1))
        window = tuple(values[first:] for values in (x_mm, u_left, u_right))
        _estimate_all(errors, trial, estimators, stale, window, motion, centre_mm)
    return errors


def _estimate_all(errors, trial, estimators, rig, window, motion, centre_mm) -> None:
    for name, estimator in estimators.items():
        for j, n in enumerate(errors[name].n_frames):
            x, u_left, u_right = (values[:n].reshape(-1, values.shape[-1]) for values in window)
            seen = np.isfinite(np.hstack([x, u_left, u_right])).all(axis=1)
            try:
                found = estimator(rig, x[seen], u_left[seen], u_right[seen]).transform
            except ValueError:
                continue  # too few landmarks in these frames: the errors stay NaN
            errors[name].translation_mm[trial, j], errors[name].euler_rad[trial, j] = motion_error(
                found, motion, centre_mm
            )


def bumped_images(
    left: np.ndarray, right: np.ndarray, rig: StereoRig, motion: RigidTransform
) -> tuple[np.ndarray, np.ndarray]:
    """A stereo pair as cameras that moved by `motion` would have taken it: warped by what the motion does to images.

    Exact for a shift in any direction, and for a rotation about a camera's own axis; other rotations would show parts
    of the scene differently, which no warp can.

    Parameters
    ----------
    left, right:
        (h, w, 3) uint8.
    rig:
        The cameras that took them.
    """
    moved = rig.moved(motion)
    images = []
    for image, before, after in ((left, rig.left, moved.left), (right, rig.right, moved.right)):
        turn = after.linear @ np.linalg.pinv(before.linear)
        warp = np.column_stack([turn, after.offset_px - turn @ before.offset_px])
        size = (image.shape[1], image.shape[0])
        images.append(cv2.warpAffine(image, warp, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    return images[0], images[1]
