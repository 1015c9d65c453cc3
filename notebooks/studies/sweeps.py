"""Rendered calibration sweeps, correspondences from their labels, and calibrations compared with their truth."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass, replace

import numpy as np

from lib import paths
from lib.calibration import Calibration, calibrate
from lib.correspondences import Correspondences, of_recording
from lib.recordings import Recording
from lib.simulator import Design, Microscope, simulate
from notebooks.studies.cameras import rms

#: Estimator -> the option `offsets` of `calibrate`, and whether the rows are weighted by the detector's covariances.
ESTIMATORS = {
    "plain": (False, False),
    "covariances": (False, True),
    "offsets": ("tool", False),
    "image_offsets": ("image", False),
    "recommended": ("tool", True),
}


def sweep(seed: int = 75, *, inverse_distance_per_m: float = 0.0, frames: int = 75) -> Recording:
    """A calibration sweep of a tool and an eye on which no detector was trained, from the cache or rendered (100 CPU s).

    The tool moves at about 2 mm/s, slower than a surgeon's.  Seeds differ in tool, eye, path and noise; the microscope is
    the reference rig, affine or at a finite working distance.
    """
    optics = f"{1e3 / inverse_distance_per_m:.0f}-mm" if inverse_distance_per_m else "affine"
    name = f"sweep-{frames}-frames-{optics}-seed-{seed}"
    folder = paths.CACHE / "calibration" / name
    if not folder.is_dir():
        folder.parent.mkdir(parents=True, exist_ok=True)
        microscope = Microscope(inverse_distance_per_mm=1e-3 * inverse_distance_per_m)
        design = Design(microscope=microscope, motion="sweep", duration_s=1.2 * frames)
        own = folder.with_name(f"{name}-{os.getpid()}")  # several runs may render the same sweep at once
        simulate(own, design, seed=seed, n_frames=frames, name=name)
        try:
            own.rename(folder)
        except OSError:  # another run was faster
            shutil.rmtree(own)
    return Recording.open(folder)


def label_rows(recording: Recording, *, click_px: float, seed: int = 0) -> Correspondences:
    """Correspondences from the exact landmark pixels with Gaussian click noise, as careful labels would be.

    Raises
    ------
    ValueError
        If the recording has no truth.
    """
    if recording.truth is None:
        raise ValueError(f"{recording.name}: no truth; only a simulated recording has exact labels.")
    rng = np.random.default_rng(seed)
    u = [side + rng.normal(0, click_px, side.shape) for side in (recording.truth.u_left, recording.truth.u_right)]
    return of_recording(recording, *u)


def estimate(rows: Correspondences, estimator: str, **options: object) -> Calibration:
    """Calibrate from detections with one of `ESTIMATORS`; `options` as in `calibrate`."""
    offsets, weighed = ESTIMATORS[estimator]
    if not weighed:
        rows = replace(rows, covariance_px2=np.full_like(rows.covariance_px2, np.nan))
    return calibrate(rows, offsets=offsets, **options)


@dataclass(frozen=True)
class Judgement:
    """Errors of a calibration, measured by the truth of a simulated recording.

    The bounds are Cramer-Rao predictions: the covariance of the fitted model's parameters at the true cameras and
    positions of the rows used, for independent Gaussian noise of `sigma_u_px` in every pixel coordinate and of the robot's
    accuracy in every coordinate of a position.

    Attributes
    ----------
    triangulation_um:
        3D RMS error of the triangulated detections: the error of detector and calibration.
    calibration_um, calibration_bound_um:
        3D RMS error of the landmarks triangulated from exact pixels: the error of the calibration alone; and its bound.
    projection_px, projection_bound_px:
        RMS error of the projections of the true landmarks in an image, over both images; and its bound.  It also shows
        errors that are common to both images.
    sigma_u_px:
        RMS error of the used detections per coordinate, measured against truth: noise and bias.
    bias_px:
        (3, 4) mean error of each landmark's used detections, left x, y, right x, y.
    """

    triangulation_um: float
    calibration_um: float
    calibration_bound_um: float
    projection_px: float
    projection_bound_px: float
    sigma_u_px: float
    bias_px: np.ndarray

    @property
    def over_bound(self) -> float:
        """`calibration_um` over its bound."""
        return self.calibration_um / self.calibration_bound_um

    @property
    def projection_over_bound(self) -> float:
        """`projection_px` over its bound."""
        return self.projection_px / self.projection_bound_px


def exact_pixels(recording: Recording, rows: Correspondences) -> np.ndarray:
    """(n, 4) exact pixels, left and right, of the landmarks in `rows`.

    Raises
    ------
    ValueError
        If the recording has no truth.
    """
    truth = recording.truth
    if truth is None:
        raise ValueError(f"{recording.name}: no truth; only a simulated recording can be judged.")
    exact = of_recording(recording, truth.u_left, truth.u_right)
    return np.hstack([exact.u_left, exact.u_right])[3 * rows.frame + rows.landmark]


def judge(calibration: Calibration, recording: Recording, rows: Correspondences) -> Judgement:
    """Compare a calibration of a simulated recording, from correspondences `rows`, with the recording's truth.

    Raises
    ------
    ValueError
        If the recording has no truth.
    """
    exact = exact_pixels(recording, rows)
    known = rows.is_complete & np.isfinite(exact).all(axis=1)
    rows, exact, good = rows.subset(known), exact[known], calibration.view_inliers[known].all(axis=1)
    rig = recording.truth.rig
    x = rig.triangulate(exact[:, :2], exact[:, 2:]).x_mm
    exact = np.hstack(rig.project(x))
    found = calibration.rig.triangulate(rows.u_left, rows.u_right).x_mm
    own = calibration.rig.triangulate(exact[:, :2], exact[:, 2:]).x_mm
    error = np.hstack([rows.u_left, rows.u_right]) - exact
    sigma_u = float(np.sqrt((error[good] ** 2).mean()))
    ideal = calibrate(
        x[good], [exact[good, :2], exact[good, 2:]], model=calibration.model, sigma_u_px=sigma_u,
        sigma_x_mm=recording.robot_accuracy_mm, ransac_px=np.inf, image_size_px=recording.image_size_px,
    )  # fmt: skip
    points = np.trace(ideal.point_covariance(x, detection=False), axis1=1, axis2=2).mean()
    pixels = np.trace(ideal.projection_covariance(x), axis1=1, axis2=2).mean() / 2
    return Judgement(
        triangulation_um=1e3 * rms((found - x)[good]),
        calibration_um=1e3 * rms(own - x),
        calibration_bound_um=1e3 * float(np.sqrt(points)),
        projection_px=rms(np.hstack(calibration.rig.project(x)) - exact) / np.sqrt(2),
        projection_bound_px=float(np.sqrt(pixels)),
        sigma_u_px=sigma_u,
        bias_px=np.array([error[good & (rows.landmark == k)].mean(axis=0) for k in range(3)]),
    )
