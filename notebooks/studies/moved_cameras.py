"""The paper's registration experiment (Sec. V): known cameras are moved by a known motion, then registered.

Notebooks 00, 05 and 06 and the study of registration share it.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from lib.cameras import StereoRig
from lib.correspondences import LANDMARKS, Correspondences
from lib.geometry import RigidTransform
from lib.registration import Registration, register
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig
from notebooks.studies.simulated_rows import SimulatedSweep
from notebooks.studies.tracked import TrackedErrors

#: An estimator of the motion: (rig before the motion, Correspondences after it) -> Registration.
Estimator = Callable[[StereoRig, Correspondences], Registration]


def by_points(rig: StereoRig, data: Correspondences, loss: str = "norm") -> Registration:
    """Register the triangulated landmarks to the robot's report, by Eq. (7) or by least squares."""
    data = data.complete
    return register(rig.triangulate(data.u_left, data.u_right).x_mm, data.x_mm, loss=loss)


@dataclass(frozen=True)
class MotionErrors:
    """Errors of one estimator after 1, 2, ... frames, one trial a row; NaN if there is no trial or no estimate.

    Attributes
    ----------
    n_frames:
        (k,) frames used.
    translation_mm:
        (trials, k) error of a point in the middle of the workspace.
    euler_rad:
        (trials, k, 3) errors about the robot's x, y, z axes.
    stated_mm:
        (trials, k) standard deviation of that translation, as stated by the estimate.
    """

    n_frames: tuple[int, ...]
    translation_mm: np.ndarray
    euler_rad: np.ndarray
    stated_mm: np.ndarray

    @property
    def trials(self) -> np.ndarray:
        """(k,) number of trials with an estimate."""
        return np.isfinite(self.translation_mm).sum(axis=0)

    @property
    def translation_rms_um(self) -> np.ndarray:
        """(k,) RMS translation error over the trials."""
        return 1e3 * np.sqrt(np.nanmean(self.translation_mm**2, axis=0))

    @property
    def stated_rms_um(self) -> np.ndarray:
        """(k,) RMS over the trials of the stated standard deviations."""
        return 1e3 * np.sqrt(np.nanmean(self.stated_mm**2, axis=0))

    @property
    def euler_rms_deg(self) -> np.ndarray:
        """(k, 3) RMS errors of the angles over the trials."""
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
    outliers: float = 0.0,
    errors: TrackedErrors | None = None,
) -> SimulatedSweep:
    """A forceps in n poses of the field, seen by `rig` and reported by the robot: 3 n rows.

    Parameters
    ----------
    rig:
        The rig that sees the tool (a moved one in the experiment); None is the reference rig.
    half_size_mm:
        Half the size of the box of the base's positions in the microscope frame, within the field and depth of field.
    jaw_mm:
        Range of the jaws' length, which is drawn once.
    opening_rad:
        Range of the angle between the jaws, which is drawn for each frame.
    outliers:
        Share of detections that are shifted at random by up to 100 px per coordinate.
    errors:
        Errors of a detector and their stated covariances, instead of `sigma_u_px`; a random frame's for each frame.
    """
    rig = rig or reference_rig()
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
    x = ROBOT_FROM_MICROSCOPE.apply(np.einsum("nij,nkj->nki", turn, shape) + base[:, None]).reshape(-1, 3)
    covariance = None
    if errors is None:
        u_left, u_right = (u + rng.normal(0, sigma_u_px, u.shape) for u in rig.project(x))
    else:
        drawn = rng.choice(np.flatnonzero(np.isfinite(errors.error).all(axis=(1, 2, 3))), n)
        u_left, u_right = np.array(rig.project(x)) + errors.error[drawn].reshape(-1, 2, 2).swapaxes(0, 1)
        covariance = errors.covariance[drawn].reshape(-1, 2, 2, 2)
    x_reported = x + rng.normal(0, sigma_x_mm, x.shape)
    for u in (u_left, u_right):
        bad = rng.random(len(u)) < outliers
        u[bad] += rng.uniform(-100, 100, (int(bad.sum()), 2))
    rows = Correspondences.of_points(
        x_reported,
        u_left,
        u_right,
        frame=np.repeat(np.arange(n), len(LANDMARKS)),
        landmark=np.tile(np.arange(len(LANDMARKS)), n),
        covariance_px2=covariance,
    )
    return SimulatedSweep(**vars(rows), true_x_mm=x, true_rig=rig)


def random_motion(
    rng: np.random.Generator,
    *,
    centre_mm: np.ndarray = ROBOT_FROM_MICROSCOPE.t,
    rotation_rad: float = np.deg2rad(5.0),
    translation_mm: float = 1.0,
) -> RigidTransform:
    """A motion by up to the given angle about a random axis through `centre_mm`, and up to the given shift per axis."""
    axis = rng.normal(size=3)
    R = Rotation.from_rotvec(axis / np.linalg.norm(axis) * rng.uniform(0, rotation_rad)).as_matrix()
    return RigidTransform(R, centre_mm - R @ centre_mm + rng.uniform(-translation_mm, translation_mm, 3))


def motion_error(estimate: RigidTransform, truth: RigidTransform, centre_mm: np.ndarray) -> tuple[float, np.ndarray]:
    """Error of an estimated motion: (translation in mm, Euler angles (3,) in rad).

    The translation error is that of the point whose true position is `centre_mm`, in the workspace.  At the robot's
    origin, which may be far away, it would mainly show the rotation error.
    """
    residual = estimate.compose(truth.inverse())
    angles = Rotation.from_matrix(residual.R).as_euler("xyz")  # the paper's Phi_X, Phi_Y, Phi_Z
    return float(np.linalg.norm(residual.apply(centre_mm) - centre_mm)), angles


def simulated_errors(
    estimators: Mapping[str, Estimator],
    n_frames: Sequence[int],
    *,
    trials: int,
    rng: np.random.Generator,
    outliers: float = 0.0,
    **options: object,
) -> dict[str, MotionErrors]:
    """Errors of each estimator after 1, 2, ... frames of one moved rig, over many motions and tools.

    Parameters
    ----------
    estimators:
        Name -> estimator; all get the same data.
    n_frames:
        Numbers of frames, each taken from the start of the same sequence.
    outliers, options:
        As in `tool_frames`.
    """
    rig, centre_mm = reference_rig(), ROBOT_FROM_MICROSCOPE.t
    errors = _no_errors(estimators, n_frames, trials)
    for trial in range(trials):
        motion = random_motion(rng)
        data = tool_frames(max(n_frames), rng=rng, rig=rig.moved(motion), outliers=outliers, **options)
        for j, n in enumerate(n_frames):
            _estimate(errors, (trial, j), estimators, rig, data.of_frames(np.arange(n)), motion, centre_mm)
    return errors


def recorded_errors(
    estimators: Mapping[str, Estimator],
    n_frames: Sequence[int],
    *,
    rig: StereoRig,
    data: Correspondences,
    rng: np.random.Generator,
) -> dict[str, MotionErrors]:
    """Errors of each estimator in a recording without truth: the calibrated cameras are moved by a known motion.

    Every window of n consecutive frames is one trial, so a recording of m frames has m - n + 1 trials.  Overlapping windows
    have similar errors.

    Parameters
    ----------
    rig:
        Calibrated from other frames.
    data:
        Landmarks of the held-out frames: the detections and the robot's report.
    """
    frames, centre_mm = np.unique(data.frame), np.nanmean(data.x_mm, axis=0)
    if len(frames) < max(n_frames):
        raise ValueError(f"n_frames: up to {max(n_frames)} frames are asked for, the recording has {len(frames)}.")
    errors = _no_errors(estimators, n_frames, len(frames) - min(n_frames) + 1)
    for j, n in enumerate(n_frames):
        for first in range(len(frames) - n + 1):
            motion = random_motion(rng, centre_mm=centre_mm)
            window = data.of_frames(frames[first : first + n])
            _estimate(errors, (first, j), estimators, rig.moved(motion.inverse()), window, motion, centre_mm)
    return errors


def _no_errors(estimators: Mapping[str, Estimator], n_frames: Sequence[int], trials: int) -> dict[str, MotionErrors]:
    shape = (trials, len(n_frames))
    counts = tuple(int(n) for n in n_frames)
    return {
        name: MotionErrors(counts, *(np.full(s, np.nan) for s in (shape, (*shape, 3), shape))) for name in estimators
    }


def _estimate(errors, at, estimators, rig, data, motion, centre_mm) -> None:
    try:
        with warnings.catch_warnings(action="ignore", category=UserWarning):  # one frame may be too few: the errors tell
            motions = {name: estimator(rig, data) for name, estimator in estimators.items()}
    except ValueError:
        return  # too few landmarks for one of them: the errors of all stay NaN, which compares them on the same frames
    for name, found in motions.items():
        errors[name].translation_mm[at], errors[name].euler_rad[at] = motion_error(found.transform, motion, centre_mm)
        (stated,) = found.covariance_at(found.transform.inverse().apply(centre_mm[None]))
        errors[name].stated_mm[at] = np.sqrt(np.trace(stated))


def pushed_images(
    left: np.ndarray, right: np.ndarray, rig: StereoRig, motion: RigidTransform
) -> tuple[np.ndarray, np.ndarray]:
    """The stereo pair that cameras moved by `motion` would have taken, approximated by an affine warp of the images.

    For affine cameras this is exact for a shift in any direction, and for a rotation about a camera's own axis.  After other
    rotations parts of the scene would look different, which no warp can show.

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
