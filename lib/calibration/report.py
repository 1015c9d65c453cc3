"""A calibration in words: figures with units, plain verdicts, the list of outliers."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from lib.calibration.estimate import Calibration
from lib.calibration.optics import optics

__all__ = ["report"]


def report(calibration: Calibration, *, longest: int = 10) -> str:
    """Several lines of text.

    Parameters
    ----------
    longest:
        Outliers listed at most, largest residual first.
    """
    c = calibration
    rows, used = len(c.inliers), int(c.inliers.sum())
    value, freedom = c.chi_square
    lines = [
        f"Calibration: model {c.model}, weighting {c.weighting}, {len(c.parameter_names)} parameters",
        f"  rows          {used} of {rows} used, {rows - used} outliers ({100 * (rows - used) / rows:.0f} %)",
        f"  noise         sigma_u {c.sigma_u_px:.2f} px, sigma_x {1e3 * c.sigma_x_mm:.1f} um",
        f"  reprojection  {c.reprojection_rms_px:.2f} px RMS, {c.press_rms_px:.2f} px cross-validated (leave one out)",
        f"  chi-square    {value:.0f} for {freedom} degrees of freedom",
    ]
    names = ["left", "right"] if len(c.cameras) == 2 else ["camera"]
    for name, resection in zip(names, c.resections(), strict=True):
        K = resection.K
        lines.append(
            f"  {name:12s}  zoom {K[0, 0]:.3f} x {K[1, 1]:.3f} px/mm, skew {K[0, 1]:.3f} px/mm, "
            f"offset ({resection.t[0]:.3f}, {resection.t[1]:.3f}) mm"
        )
    distance, sd = c.inverse_distance_per_mm
    if sd > 0:
        far = "not distinguishable from affine" if abs(distance) < 3 * sd else f"working distance {1 / distance:.0f} mm"
        lines.append(f"  1/distance    {distance:.5f} +- {sd:.5f} per mm: {far}")
    if c.rig is not None:
        o = optics(c)
        x = c.x_mm[c.inliers]
        alone, both = 1e3 * np.median(c.depth_sd_mm(x)), 1e3 * np.median(c.depth_sd_mm(x, detection=True))
        lines.append(f"  head          convergence {np.rad2deg(o.convergence_rad):.2f} deg, mirrored: {o.mirrored}")
        lines.append(f"  depth         {both:.0f} um sd of one detected point, of which the calibration {alone:.1f} um")
    lines.append("Verdicts")
    lines += [f"  {'ok  ' if fine else 'LOOK'}  {text}" for fine, text in verdicts(c)]
    outliers = np.flatnonzero(~c.inliers)
    if outliers.size:
        distance = np.linalg.norm(c.residuals_px[outliers].reshape(len(outliers), -1, 2), axis=2).max(axis=1)
        lines.append(f"Outliers (row: largest residual of an image), {min(longest, outliers.size)} of {outliers.size}")
        for i in np.argsort(-distance)[:longest]:
            lines.append(f"  {outliers[i]:6d}: {distance[i]:.1f} px")
    return "\n".join(lines)


def verdicts(calibration: Calibration) -> list[tuple[bool, str]]:
    """(fine, sentence) for each question a user should ask."""
    c = calibration
    rows, used = len(c.inliers), int(c.inliers.sum())
    value, freedom = c.chi_square
    found = [
        (used >= 50, f"{used} correspondences" + ("" if used >= 50 else "; 50 or more make the noise estimate firm")),
        (rows - used <= 0.2 * rows, f"{100 * (rows - used) / rows:.0f} % outliers"),
    ]
    if freedom > 0:
        fits = chi2.sf(value, freedom) > 1e-3
        found.append(
            (fits, "residuals are as large as the noise levels say" if fits else "residuals exceed the noise levels")
        )
    x = c.x_mm[c.inliers]
    extent = np.sqrt(np.linalg.eigvalsh(np.cov(x.T))[::-1])
    deep = extent[2] > 10 * max(c.sigma_x_mm, 0.001)
    found.append((deep, f"volume covered: RMS {extent[0]:.2f} x {extent[1]:.2f} x {extent[2]:.2f} mm"))
    # Residuals without structure: a linear trend was fitted away, a quadratic one would be a wrong model.
    curvature = _curvature(c)
    found.append(
        (
            curvature > 1e-3,
            "residuals show no curvature (the camera model fits)"
            if curvature > 1e-3
            else "residuals are curved: try model='near_affine' (finite working distance)",
        )
    )
    if c.rig is not None:
        depth_mm = float(np.median(c.depth_sd_mm(x, detection=True)))
        known = f"depth of one detected point known to {1e3 * depth_mm:.0f} um"
        seen = depth_mm < extent[0]
        found.append((seen, known if seen else known + ": the two views hardly differ (the same camera twice?)"))
        mirrored = optics(c).mirrored
        found.append((mirrored in ("no", "unknown"), f"mirrored optics: {mirrored}"))
    return found


def _curvature(c: Calibration) -> float:
    """p-value of the six quadratic terms of the position in the residuals (an F-like chi-square test)."""
    x = c.x_mm[c.inliers] - c.x_mm[c.inliers].mean(axis=0)
    r = c._fit.residuals
    if len(x) < 30:
        return 1.0
    x = x / x.std(axis=0)
    i, j = np.triu_indices(3)
    linear = np.column_stack([x, np.ones(len(x))])
    Q = np.linalg.qr(np.column_stack([linear, x[:, i] * x[:, j]]))[0][:, 4:]
    S = r.T @ r / len(r)
    if np.trace(S) < 1e-12:
        return 1.0
    projected = Q.T @ r
    S = S - projected.T @ projected / len(r)
    statistic = float(np.einsum("ki,ij,kj->", projected, np.linalg.pinv(S), projected))
    # One test of the whole: Q has orthonormal columns, so each of its products with r has the covariance S.
    return float(chi2.sf(statistic, projected.size))
