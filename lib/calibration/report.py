"""A calibration in words: numbers with units, plain verdicts, the list of outliers."""

import numpy as np
from scipy.stats import chi2

from lib.calibration.calibration import Calibration
from lib.calibration.optics import optics
from lib.correspondences import LANDMARKS

__all__ = ["report", "verdicts"]


def report(calibration: Calibration, *, robot_accuracy_mm: float | None = None, longest: int = 10) -> str:
    """Several lines of text, with at most `longest` outliers, largest residual first.

    `robot_accuracy_mm`, as its maker states it (`Recording.robot_accuracy_mm`), is compared with the estimated noise.
    """
    c, outliers = calibration, np.flatnonzero(calibration.usable & ~calibration.inliers)
    rows, used, usable = len(c.inliers), int(c.inliers.sum()), int(c.usable.sum())
    value, freedom = c.chi_square
    left_out = "" if usable == rows else f", {rows - usable} without a detection, position or axes"
    lines = [
        f"Calibration: model {c.model}, weighting {c.weighting}, {len(c.parameter_names)} parameters",
        f"  rows          {used} of {rows} used, {len(outliers)} outliers ({100 * len(outliers) / usable:.0f} %){left_out}",
        f"  noise         sigma_u {c.sigma_u_px:.2f} px, sigma_x {1e3 * c.sigma_x_mm:.1f} um",
        f"  reprojection  {c.reprojection_rms_px:.2f} px RMS, {c.press_rms_px:.2f} px cross-validated (leave one out)",
        f"  chi-square    {value:.0f} for {freedom} degrees of freedom",
    ]
    for name, resection in zip(["left", "right"] if c.rig else ["camera"], c.resections(), strict=True):
        (zoom_x, skew), (_, zoom_y) = resection.K
        at = ", ".join(f"{value:.3f}" for value in resection.t)
        lines.append(f"  {name:12s}  zoom {zoom_x:.3f} x {zoom_y:.3f} px/mm, skew {skew:.3f} px/mm, offset ({at}) mm")
    distance, sd = c.inverse_distance_per_mm
    if sd > 0:
        far = "not distinguishable from affine" if abs(distance) < 3 * sd else f"working distance {1 / distance:.0f} mm"
        lines.append(f"  1/distance    {distance:.5f} +- {sd:.5f} per mm: {far}")
    if c.rig is not None:
        o, x = optics(c), c.x_mm[c.inliers]
        alone, both = (1e3 * np.median(c.depth_sd_mm(x, detection=detection)) for detection in (False, True))
        at = ", ".join(f"{value:.1f}" for value in o.robot_from_microscope.t)
        lines.append(
            f"  head          convergence {np.rad2deg(o.convergence_rad):.2f} deg, right image rolled by "
            f"{np.rad2deg(o.roll_rad):.2f} deg, mirrored: {o.mirrored}; the images' centre is ({at}) mm"
        )
        lines.append(f"  depth         {both:.0f} um sd of one detected point, of which the calibration {alone:.1f} um")
    if c.offsets is not None:
        scale, unit = (1e3, "um along, across, normal") if c.offsets.offset.shape[1] == 3 else (1.0, "px, left and right")
        lines.append(f"  offsets       p = {c.offsets.p_value:.2g} without any; {unit}:")
        for k, (values, sds) in enumerate(zip(c.offsets.offset, c.offsets.standard_deviation, strict=True)):
            name = LANDMARKS[k] if k < len(LANDMARKS) else f"landmark {k}"
            numbers = [f"{scale * v:.1f} +- {scale * s:.1f}" for v, s in zip(values, sds, strict=True)]
            lines.append(f"    {name:10s}  {', '.join(numbers)}")
    lines.append("Verdicts")
    lines += [f"  {'ok  ' if fine else 'LOOK'}  {text}" for fine, text in verdicts(c, robot_accuracy_mm)]
    if outliers.size:
        distance = np.linalg.norm(c.residuals_px[outliers].reshape(len(outliers), -1, 2), axis=2).max(axis=1)
        lines.append(f"Outliers (row: largest residual of an image), {min(longest, outliers.size)} of {outliers.size}")
        lines += [f"  {outliers[i]:6d}: {distance[i]:.1f} px" for i in np.argsort(-distance)[:longest]]
    return "\n".join(lines)


def verdicts(calibration: Calibration, robot_accuracy_mm: float | None = None) -> list[tuple[bool, str]]:
    """(fine, sentence) for each question a user should ask."""
    c, used, usable = calibration, int(calibration.inliers.sum()), int(calibration.usable.sum())
    value, freedom = c.chi_square
    found = [
        (used >= 50, f"{used} correspondences" + ("" if used >= 50 else "; 50 or more make the noise estimate firm")),
        (usable - used <= 0.2 * usable, f"{100 * (usable - used) / usable:.0f} % outliers"),
    ]
    if freedom > 0:
        fits = chi2.sf(value, freedom) > 1e-3
        text = "residuals are as large as the noise levels say" if fits else "residuals exceed the noise levels"
        found.append((fits, text))
    if robot_accuracy_mm is not None:
        fine = c.sigma_x_mm <= 2.0 * robot_accuracy_mm
        text = f"robot noise {1e3 * c.sigma_x_mm:.1f} um, its stated accuracy is {1e3 * robot_accuracy_mm:.1f} um"
        found.append((fine, text if fine else text + ": check the time offset"))
    x = c.x_mm[c.inliers]
    extent = np.sqrt(np.linalg.eigvalsh(np.cov(x.T))[::-1])
    text = f"volume covered: RMS {extent[0]:.2f} x {extent[1]:.2f} x {extent[2]:.2f} mm"
    found.append((extent[2] > 10 * max(c.sigma_x_mm, 0.001), text))
    straight = _curvature(x, c.system[3]) > 1e-3
    curved = "residuals are curved: try model='near_affine' (finite working distance)"
    found.append((straight, "residuals show no curvature (the camera model fits)" if straight else curved))
    if c.rig is not None:
        depth_mm = float(np.median(c.depth_sd_mm(x, detection=True)))
        text = f"depth of one detected point known to {1e3 * depth_mm:.0f} um"
        seen = depth_mm < extent[0]
        found.append((seen, text if seen else text + ": the two views hardly differ (the same camera twice?)"))
        mirrored = optics(c).mirrored
        found.append((mirrored in ("no", "unknown"), f"mirrored optics: {mirrored}"))
    return found


def _curvature(x: np.ndarray, r: np.ndarray) -> float:
    """p-value of the six quadratic terms of x (n, 3) in the residuals r (n, m) (an F-like chi-square test).

    The fit takes any linear trend out of the residuals; a quadratic one means a wrong camera model.
    """
    S = r.T @ r / len(r)
    if len(x) < 30 or np.trace(S) < 1e-12:
        return 1.0
    x = (x - x.mean(axis=0)) / x.std(axis=0)
    i, j = np.triu_indices(3)
    Q = np.linalg.qr(np.column_stack([x, np.ones(len(x)), x[:, i] * x[:, j]]))[0][:, 4:]
    projected = Q.T @ r
    S = S - projected.T @ projected / len(r)
    statistic = float(np.einsum("ki,ij,kj->", projected, np.linalg.pinv(S), projected))
    # One test of the whole: Q has orthonormal columns, so each of its products with r has the covariance S.
    return float(chi2.sf(statistic, projected.size))
