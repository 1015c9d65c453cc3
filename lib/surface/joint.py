"""Calibration and dense matches together: thousands of matches know the epipolar geometry better than any calibration.

A calibration from a few hundred landmarks leaves its epipolar lines off by some tenths of a pixel.  A matcher that
searches along them then slides along oblique edges, which bends the surface.  But a match also tells how far off its
line it lies.  With true cameras (A*, t*) and n the unit normal of the calibrated rig, n.A = 0, that distance is

    r = n.(y - t) = n.((A* - A) x + (t* - t)) + noise,

linear in the point x: a robust regression over all matches measures four numbers of the calibration's error, and the
calibration's covariance carries them over to all sixteen entries of its matrices (the update of a Kalman filter, with
the calibration as the prior).  No truth, no target, nothing but the pair itself.
"""

from __future__ import annotations

import numpy as np

from lib.calibration import Calibration
from lib.cameras import AffineCamera, StereoRig
from lib.matching import Matches

__all__ = ["refine_rig"]

#: So many neighbouring matches count as one: their errors off the line are alike.
ALIKE = 10.0
#: Residuals from here on, in robust standard deviations, count less and less.
SOFT = 2.0


def refine_rig(calibration: Calibration, matches: Matches) -> StereoRig:
    """The calibrated rig, brought to agree with the epipolar geometry of dense matches.

    The cameras move only along what the calibration itself is unsure of, so few or poor matches change little; with the
    same weight for every landmark coordinate the correction is all off the epipolar lines.

    Parameters
    ----------
    calibration:
        Of an affine stereo pair.
    matches:
        Of `lib.matching.match` with the calibrated rig, or with one that this function returned: the result depends on
        where the matches are, not on the rig that found them.  Best are those on the static scene, tool masked.

    Raises
    ------
    ValueError
        If the calibration is not of an affine stereo pair.
    """
    rig = calibration.rig
    if rig is None or not rig.is_affine:
        raise ValueError("calibration: an affine stereo pair is needed, with both cameras.")
    if len(matches) < 5:
        return rig
    normal = rig.epipolar_normal
    points = rig.triangulate(matches.u_left, matches.u_right, matches.covariance_px2)
    distance = rig.epipolar_distance(matches.u_left, matches.u_right)
    sigma = np.sqrt(np.einsum("i,nij,j->n", normal, matches.covariance_px2, normal))
    centre = points.x_mm.mean(axis=0)
    measured, information = _regression(points.x_mm - centre, distance, sigma)

    # What a change of the matrices' entries, camera by camera and row by row, does to the four numbers.
    about_centre = np.eye(4)
    about_centre[3, :3] = centre
    effect = np.hstack([n * about_centre for n in normal])
    prior = calibration.covariance
    # In the information's form, since a flat scene does not tell how the distance changes with depth.
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
        scale = max(1.4826 * np.median(np.abs(residual)), 1.0)  # never surer than the matches say
        weight = 1 / (1 + (residual / (SOFT * scale)) ** 2) ** 2
    return found, information / (ALIKE * scale**2)
