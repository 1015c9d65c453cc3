"""Refine a calibrated rig by the epipolar geometry of dense matches.

A calibration from a few hundred landmarks leaves its epipolar lines off by some tenths of a pixel, and matches along
them slide on oblique edges.  But each match also measures its own distance from the line.  With true cameras (A*, t*)
and n the unit normal of the calibrated rig, n.A = 0, that distance is

    r = n.(y - t) = n.((A* - A) x + (t* - t)) + noise.

It is linear in the point x.  A robust regression over all matches therefore measures four numbers of the calibration's
error, and the covariance of the calibration carries them over to all sixteen entries of its matrices: the update of a
Kalman filter whose prior is the calibration.
"""

import numpy as np

from lib.cameras import AffineCamera, StereoRig
from lib.matching import Matches

__all__ = ["refine_rig"]

#: Neighbouring matches share their errors off the line; this many count as one.
ALIKE = 10.0
#: Residuals beyond this many robust standard deviations lose their weight.
SOFT = 2.0


def refine_rig(rig: StereoRig, covariance: np.ndarray, matches: Matches) -> StereoRig:
    """The rig that agrees best with its own calibration and with the epipolar geometry of dense matches.

    The cameras move only along directions that the calibration leaves uncertain, so few or poor matches change little.

    Args:
        rig: A calibrated affine pair.
        covariance: (16, 16) of the entries of its matrices, row by row, left first (`Calibration.covariance`).
        matches: Of `lib.matching.match` with this rig, best of the static scene with the tool masked.

    Raises:
        ValueError: If the rig is not affine, or the covariance has another shape.
    """
    if rig is None or not rig.is_affine:
        raise ValueError("rig: only an affine stereo pair can be refined; reconstruct with refine=False.")
    prior = np.asarray(covariance, dtype=np.float64)
    if prior.shape != (16, 16):
        raise ValueError(f"covariance: expected (16, 16), the entries of both matrices, got {prior.shape}.")
    if len(matches) < 5:
        return rig
    normal = rig.epipolar_normal
    points = rig.triangulate(matches.u_left, matches.u_right, matches.covariance_px2)
    centre = points.x_mm.mean(axis=0)
    measured, information = _regression(points.x_mm - centre, points.epipolar_px, matches.sigma_along(normal))

    # The effect (4, 16) of a change of the entries on the four measured numbers.
    about_centre = np.eye(4)
    about_centre[3, :3] = centre
    effect = np.hstack([n * about_centre for n in normal])
    # In information form, because a flat scene does not measure how the distance changes with depth.
    innovation = np.linalg.solve(np.eye(4) + information @ effect @ prior @ effect.T, information @ measured)
    matrices = np.vstack([rig.left.matrix, rig.right.matrix]) + (prior @ effect.T @ innovation).reshape(4, 4)
    return StereoRig(AffineCamera(matrices[:2]), AffineCamera(matrices[2:]))


def _regression(x: np.ndarray, value: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Robust coefficients (4,) of value (n,) on [x; 1], and their information, by iteratively reweighted least squares."""
    design = np.column_stack([x, np.ones(len(x))]) / sigma[:, None]
    target, weight = value / sigma, np.ones(len(x))
    for _ in range(20):
        weighted = design * weight[:, None]
        information = weighted.T @ design
        found = np.linalg.lstsq(information, weighted.T @ target, rcond=1e-12)[0]
        residual = target - design @ found
        scale = max(1.4826 * np.median(np.abs(residual)), 1.0)  # not below what the matches state
        weight = 1 / (1 + (residual / (SOFT * scale)) ** 2) ** 2
    return found, information / (ALIKE * scale**2)
