"""Everything that decides whether a recording's calibration may be believed, in one call; and a calibration in words."""

import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lib import paths
from lib.calibration import Calibration, calibrate, optics
from lib.correspondences import LANDMARKS, Correspondences
from lib.landmarks import Detector, detect
from lib.recordings import Recording
from lib.trust.diagnosis import Diagnosis, diagnose
from lib.trust.health import Health, feature_matches, health, spread
from lib.trust.verdict import Verdict, judge


@dataclass(frozen=True, eq=False)
class Assessment:
    """What `assess` found.

    Attributes:
        data: The correspondences assessed.
        calibration: None where it was refused; the verdict says why.
        verdict: With its reasons, the worst first.
        diagnosis, health: What is wrong, and each frame's score.
        epipolar_px: Median epipolar distance of features that both images share; NaN where too few are.
    """

    data: Correspondences
    calibration: Calibration | None
    verdict: Verdict
    diagnosis: Diagnosis
    health: Health
    epipolar_px: float = np.nan


def assess(
    recording: Recording, data: Correspondences | None = None, *, detector: Callable | None = None, **options: object
) -> Assessment:  # fmt: skip
    """Calibrate, diagnose, look at the detector's health and at a witness, and judge.

    Never raises for what a recording shows: what is refused is a reason of the verdict.

    Args:
        data: Its correspondences (detected, labelled); None runs the detector, the one that ships if none is given.
        detector: The one that made `data`; with it some frames are looked at again, mirrored and shifted.
        options: Of `lib.calibration.calibrate`, such as model="near_affine".
    """
    if data is None:
        detector = detector or Detector.load()
        data = detect(recording, detector)
    calibration, error, epipolar_px = None, None, np.nan
    try:
        calibration = calibrate(data, image_size_px=recording.image_size_px, **options)
    except ValueError as refused:
        error = refused
    if calibration is not None and len(y := feature_matches(recording, spread(len(recording), 3))):
        epipolar_px = float(np.median(np.abs(calibration.pair.epipolar_distance(y[:, :2], y[:, 2:]))))
    diagnosis = diagnose(
        data, kinematics=recording.kinematics, offset_s=recording.offset_s, readout_s=recording.readout_s,
        image_size_px=recording.image_size_px,
    )  # fmt: skip
    found = health(recording, data, calibration, detector=detector)
    verdict = judge(
        data, calibration, diagnosis=diagnosis, health=found, epipolar_px=epipolar_px, error=error,
        robot_accuracy_mm=recording.robot_accuracy_mm, doubts=recording.doubts,
    )  # fmt: skip
    where = shlex.quote(paths.shown(recording.folder))  # in the commands that cures name
    told = [replace(r, **{k: getattr(r, k).replace("RECORDING", where) for k in ("text", "cure")}) for r in verdict.reasons]
    return Assessment(data, calibration, Verdict(tuple(told)), diagnosis, found, epipolar_px)


def report(calibration: Calibration, *, verdict: Verdict | None = None, robot_accuracy_mm: float | None = None) -> str:
    """Several lines of text, with at most ten outliers, largest residual first.

    Args:
        verdict: Of `lib.trust.assess`; None judges by the calibration's own numbers alone.
        robot_accuracy_mm: As its maker states it (`Recording.robot_accuracy_mm`).
    """
    verdict = judge(None, calibration, robot_accuracy_mm=robot_accuracy_mm) if verdict is None else verdict
    c, seen = calibration, np.isfinite(calibration.residuals_px[:, ::2])
    outliers = np.argwhere(seen & ~c.view_inliers)
    rows, used, usable = len(c.inliers), int(c.inliers.sum()), int(c.usable.sum())
    value, freedom = c.chi_square
    left_out = "" if usable == rows else f", {rows - usable} without a detection, position or axes"
    lines = [
        str(verdict),
        f"Calibration: model {c.model}, weighting {c.weighting}, {len(c.parameter_names)} parameters",
        f"  rows          {used} of {rows} used{left_out}; they count as {c.effective_rows:.0f} independent ones",
        f"  detections    {c.view_inliers.sum()} of {seen.sum()} used, {len(outliers)} outliers "
        f"({100 * len(outliers) / seen.sum():.0f} %)",
        f"  noise         sigma_u {c.sigma_u_px:.2f} px, sigma_x {1e3 * c.sigma_x_mm:.1f} um",
        f"  reprojection  {c.reprojection_rms_px:.2f} px RMS, {c.press_rms_px:.2f} px cross-validated (leave one out)",
        f"  chi-square    {value:.0f} for {freedom} degrees of freedom",
        "  volume        {:.2f} x {:.2f} x {:.2f} mm RMS".format(*c.extents_mm),
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
    if outliers.size:
        distance = np.linalg.norm(c.residuals_px.reshape(rows, -1, 2)[tuple(outliers.T)], axis=1)
        sides = ("left", "right") if c.rig else ("",)
        worst = [(*outliers[i], distance[i]) for i in np.argsort(-distance)[:10]]
        lines.append(f"Outliers (row: residual), {len(worst)} of {len(outliers)}")
        lines += [f"  {row:6d}: {size:.1f} px {sides[side]}".rstrip() for row, side, size in worst]
    return "\n".join(lines)
