"""`calibrate`: cameras and their covariance from correspondences."""

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from lib.calibration import checks as refuse
from lib.calibration.affine import affine_minimum, estimate_noise, noise_rms_px, paper_variances, regress
from lib.calibration.calibration import Calibration
from lib.calibration.models import Model, State, fit
from lib.calibration.offsets import Unsettled, estimate_offsets, further_step, rows_axes, start_of_turning, tool_axes
from lib.calibration.robust import NO_CONSENSUS_CURE, CompetingCamerasError, NoConsensusError, consensus
from lib.calibration.scatter import sandwich
from lib.correspondences import Correspondences, DataError
from lib.geometry import pair_covariance, precision, view_distances2
from lib.least_squares import Minimum, inverse
from lib.parallel import single_threaded_blas

#: Fewest rows with the tool's axes from which `offsets=None` estimates offsets.
_OFFSET_ROWS = 12
#: Turned axes are tried if the p-value of no offsets is below the first number, and landmarks move by more than the second.
_SURE_OFFSETS, _LEAST_TURN_MM = 1e-3, 0.005
_NARROW = 0.05  # quantile of the distance between the tips: offsets turn the axes most where the tips are close
#: Turned axes are preferred unless their log likelihood is lower by more than this.
_AS_LIKELY = 3.0
#: Standard deviations of 1/distance that count as a finite distance (1 of 2000 affine rigs exceeds them), or, if negative, as
#: mirrored images (a curved field may exceed three); step of its derivative.
_FINITE, _MIRRORED, _STEP_PER_MM = 3.0, 8.0, 1e-6
_USUAL_PER_MM = 1e-2  # standard deviation of 1/distance before any data: few microscopes are nearer than 100 mm
#: Largest noise of cameras at a finite distance relative to that of one of two cameras that compete.  It is 0.2 to 1.06 if
#: they are at such a distance, and 1.17 or more if the microscope zoomed while the tool was moved to another depth.
_AS_WELL = 1.1
_LINE = 0.01  # ratio of the singular values of a camera's linear part, below which its image is a line


@single_threaded_blas()
def calibrate(
    data: Correspondences | ArrayLike, u: Sequence[ArrayLike] | None = None, *,
    offsets: bool | Literal["tool", "image"] | None = None, offset_prior_sd: float | None = None,
    model: str = "zero_skew", weighting: str = "likelihood", sigma_u_px: float | None = None,
    sigma_x_mm: float | None = None, covariance_px2: ArrayLike | None = None,
    ransac_px: float | None = None, seed: int = 0, image_size_px: tuple[int, int] | None = None, checks: bool = True,
) -> Calibration:  # fmt: skip
    """Cameras from robot positions and detections: removes outliers, then finds the exact minimum of Eq. (3).

    Outliers are found in each camera separately, so a landmark that is lost in one image is still used in the other.  Noise
    levels are estimated from the inliers.  The covariances allow for that and, with `Correspondences`, for errors that are
    correlated from frame to frame, or shared by the landmarks of a frame (`Calibration.effective_rows`).

    Args:
        data, u: `Correspondences` alone (rows seen in only one image are used, too; their covariances weight the rows if all
            seen landmarks have one); or (n, 3) mm positions in the robot frame and [u_left, u_right] or [u], (n, 2) px each.
        offsets: Constant offsets of the landmarks (`lib.calibration.offsets`).  "tool" or True: in the tool's axes, from
            frames in which the robot reports three landmarks and open jaws.  The axes are those of the detected landmarks
            instead, if offsets turn them and that explains the detections as well (`LandmarkOffsets.turns`).  "image": in the
            images, for a constant error in pixels.  False: none.  None: "tool" if at least 12 rows and half of all have axes.
        offset_prior_sd: Standard deviation of an offset's coordinate in the prior, mm or px; None = chosen by the data.
        model: "affine", "zero_skew" (the paper's), "square", "common_zoom"; with "+distance" (one 1/distance) or
            "+distances" (one a camera), and "+radial".  "near_affine" is "zero_skew+distance".
        weighting: "likelihood": Gaussian noise, inverse variances, exact projection.  "paper": Eq. (3) as printed, with
            weights 1/sigma and a reprojection term of unit weight (its result depends on the unit of length).
        sigma_u_px, sigma_x_mm: Noise of a pixel coordinate and of a robot coordinate; None = estimated from the data.
        covariance_px2: The detector's covariance in place of sigma_u, in any form of `lib.geometry.pair_covariance`.  It is
            scaled up if the residuals are larger than it states (unless sigma_u_px is given, too).
        ransac_px: Largest reprojection error of an inlier.  None estimates the noise and drops detections that are more
            probably outliers than inliers, or whose error occurs in fewer than 1 of 10 000 data sets.  Infinity keeps all.
        seed: Seed of the random samples.
        image_size_px: (width, height); its centre is the principal point of near-affine models, else the detections' centre.
        checks: False skips the plausibility checks: units, repeated rows, swapped cameras, pixels outside the image.

    A `NoConsensusError` (a ValueError) is raised if the detections in an image fit no camera, or two cameras that neither
    offsets nor a finite distance (if the model has one) explain.  A ValueError refuses rows that determine no camera, offsets
    if too few rows have axes, and what `checks` finds.

    >>> from lib.cameras import AffineCamera
    >>> rng = np.random.default_rng(0)
    >>> left, right = AffineCamera([[99, 0, -9, 900], [0, 99, 0, 500]]), AffineCamera([[99, 0, 9, 900], [0, 99, 0, 500]])
    >>> x = rng.uniform(-4, 4, (60, 3))
    >>> found = calibrate(x, [c.project(x) + rng.normal(0, 1, (60, 2)) for c in (left, right)])
    >>> bool(np.allclose(found.rig.left.linear, left.linear, atol=0.5)), int(found.inliers.sum())
    (True, 60)
    """
    if isinstance(data, Correspondences):
        if u is not None:
            raise ValueError("u: Correspondences have their own pixels; leave u out.")
        data.check_detections()
        usable, axes = _usable_rows(data, offsets, weighting)
        rows = data.subset(usable)
        x, y, noise = rows.x_mm, rows.stacked_px, None
        if covariance_px2 is not None:
            noise = pair_covariance(covariance_px2, len(data))
            if len(noise) > 1:
                seen = np.repeat(rows.seen, 2, axis=1)
                noise = np.where(seen[:, :, None] & seen[:, None], noise[usable], np.eye(4))
        elif weighting == "likelihood" and sigma_u_px is None and np.isfinite(rows.covariance_px2[rows.seen]).all():
            noise = pair_covariance(np.where(rows.seen[:, :, None, None], rows.covariance_px2, np.eye(2)), len(rows))
    else:
        if u is None:
            raise ValueError("u: give [u_left, u_right] with plain positions, or Correspondences alone.")
        if offsets or offset_prior_sd is not None:
            raise ValueError("offsets: they need to know which landmark a row is; give Correspondences.of_points(...).")
        x, y = refuse.stacked_rows(data, u)
        usable, axes = None, None
        noise = None if covariance_px2 is None else pair_covariance(covariance_px2, len(x), y.shape[1] // 2)
    if offset_prior_sd is not None and not offset_prior_sd > 0:
        raise ValueError(f"offset_prior_sd: must be positive, got {offset_prior_sd}.")
    fitted = partial(
        _calibrate, noise=noise, model=model, weighting=weighting, known={"sigma_u_px": sigma_u_px, "sigma_x_mm": sigma_x_mm},
        ransac_px=ransac_px, seed=seed, image_size_px=image_size_px, checks=checks,
    )  # fmt: skip
    if axes is None and offsets != "image":
        found = fitted(x, y)
        if weighting == "likelihood" and None in (sigma_u_px, sigma_x_mm):
            # Allow for the estimated noise level and for errors correlated in time.
            J_x, J, weight, r = found.system
            order = () if usable is None else (rows.frame[found.inliers], rows.landmark[found.inliers])
            known, effective = sandwich(J, weight, r, J_x, *order)
            found = replace(found, joint_covariance=known, effective_rows=effective)
    else:
        estimate = partial(estimate_offsets, fitted, x, y, rows.landmark, rows.frame, prior_sd=offset_prior_sd)
        found = estimate(axes=axes)
        if axes is not None:
            found = _turned(found, estimate, data, usable, axes, sure=offset_prior_sd is not None)
    for chosen in found.view_inliers.T if checks else ():  # again, with the noise of this robot
        refuse.check_spread(found.x_mm[chosen], found.sigma_x_mm)
    if usable is None:
        return found
    # Insert the rows that are not usable, so that the results have one entry for each row of the data.
    fillers = {"view_inliers": False, "residuals_px": np.nan, "x_mm": np.nan, "y_px": np.nan}
    if found.covariance_px2 is not None and len(found.covariance_px2) > 1:
        fillers["covariance_px2"] = np.nan
    missing = np.flatnonzero(~usable)
    places = missing - np.arange(len(missing))  # index of the usable row that follows
    return replace(found, **{name: np.insert(getattr(found, name), places, fill, axis=0) for name, fill in fillers.items()})


def calibrate_as_shown(
    data: Correspondences, *, models: tuple[str, str] = ("zero_skew", "near_affine"), **options: object
) -> Calibration:  # fmt: skip
    """`calibrate` with affine cameras, or with cameras at a finite distance if the detections show a significant one.

    It is significant if a Gauss-Newton step from the affine cameras makes 1/distance (1/mm) larger than three of its standard
    deviations; or if the detections agree on two affine cameras, and on one at such a distance.  `models` names the affine
    model and the one with a distance; other options and errors are `calibrate`'s.  If 1/distance is negative by eight
    standard deviations, a warning says that the images look mirrored.

    >>> from lib.simulator.rig import reference_rig
    >>> rng = np.random.default_rng(0)
    >>> x = rng.uniform(-4, 4, (60, 3))
    >>> u = [v + rng.normal(0, 1, v.shape) for v in reference_rig(inverse_distance_per_mm=1 / 190).project(x)]
    >>> calibrate_as_shown(Correspondences.of_points(x, *u)).model
    'near_affine'
    """
    try:
        found = calibrate(data, model=models[0], **options)
    except CompetingCamerasError as error:  # perspective and offsets together may look like two cameras
        with suppress(DataError, np.linalg.LinAlgError):
            near = calibrate(data, model=models[1], **options)
            value, sd = near.inverse_distance_per_mm
            if value > _FINITE * sd and near.reprojection_rms_px < _AS_WELL * np.sqrt(2) * error.sigma_px:
                return near
        raise
    state, x = found.minimum.state, found.minimum.work.points
    far, near = (replace(state, rho=state.rho + h).evaluate(x, derivatives=False)[0] for h in (0.0, _STEP_PER_MM))
    with suppress(DataError, np.linalg.LinAlgError):  # too few rows for one more parameter
        value, sd, follow = further_step(found, data, (near - far) / _STEP_PER_MM)
        if value > _FINITE * sd:
            return calibrate(data, model=models[1], **options)
        known = _USUAL_PER_MM**2 / (_USUAL_PER_MM**2 + sd**2)
        found = replace(found, not_shown=np.hypot(known * value, np.sqrt(known) * sd) * np.append(follow, 1.0))
        if value < -_MIRRORED * sd:
            what = "farther things look larger, so the images look mirrored, and depths would have the wrong sign"
            warnings.warn(f"u_left, u_right: {what}; flip both images, or use a right-handed robot frame.", stacklevel=2)
    return found


def _usable_rows(data: Correspondences, offsets: bool | str | None, weighting: str) -> tuple[np.ndarray, np.ndarray | None]:
    """Mask of the rows to calibrate with (seen in at least one view), and the tool's axes in these rows or None."""
    if offsets not in (None, False, True, "tool", "image"):
        raise ValueError(f"offsets: expected 'tool', 'image', True, False or None, got {offsets!r}.")
    if offsets and weighting != "likelihood":
        raise ValueError("weighting: offsets can only be estimated with weighting='likelihood'.")
    usable = data.seen.any(axis=1) & np.isfinite(data.x_mm).all(axis=1)
    if offsets not in (None, True, "tool") or weighting != "likelihood":
        return usable, None
    axes = rows_axes(data)
    open_jaws = usable & np.isfinite(axes).all(axis=(1, 2))
    count = open_jaws.sum()
    if offsets is None and count < max(_OFFSET_ROWS, 0.5 * usable.sum()):
        return usable, None
    if count < 4:
        raise DataError(f"offsets: {count} rows have the tool's axes; the robot must report landmarks with open jaws.")
    return open_jaws, axes[open_jaws]


def _turned(
    found: Calibration, estimate: Callable[..., Calibration], data: Correspondences, usable: np.ndarray, axes: np.ndarray, *,
    sure: bool,
) -> Calibration:  # fmt: skip
    """The calibration with the axes of the detected landmarks, unless those of the reported ones explain the data better.

    If the robot's model of the tool is wrong, its landmarks have constant offsets in the axes of the true tool, and the axes
    computed from the reported landmarks are turned.  Large turns are more often errors of the robot than of the detector.
    `sure`: the caller knows that there are offsets, so their p-value does not count.
    """
    x_mm = data.grid("x_mm")
    row = np.unique(data.frame, return_inverse=True)[1][usable]

    def turned(offset: np.ndarray) -> np.ndarray:
        own = tool_axes(x_mm, offset)[..., row, :, :]
        return np.where(np.isfinite(own), own, axes)

    opening = np.linalg.norm(x_mm[row, 2] - x_mm[row, 1], axis=1)
    usual_mm = found.offsets.prior_sd**2 / np.quantile(opening, _NARROW)  # an offset times the angle that another one turns
    if (found.offsets.p_value >= _SURE_OFFSETS and not sure) or usual_mm < _LEAST_TURN_MM:
        return found
    try:
        begin = start_of_turning(found, axes, turned, data.landmark[usable])
        turn_mm = np.einsum("nij,nj->ni", turned(begin) - axes, begin[data.landmark[usable]]).std()
        if turn_mm < _LEAST_TURN_MM:
            return found
        with warnings.catch_warnings(action="ignore", category=Unsettled):
            other = estimate(axes=turned, start=replace(found, offsets=replace(found.offsets, offset=begin)))
    except (DataError, np.linalg.LinAlgError):  # no cameras fit the turned axes
        return found
    used = np.repeat(found.view_inliers | other.view_inliers, 2, axis=1)
    most = 2 * found.reprojection_rms_px  # clipped: larger residuals are of frames with unknown axes
    norm = [np.linalg.norm(np.clip(one.residuals_px[used], -most, most)) for one in (other, found)]
    if used.sum() * np.log(norm[0] / norm[1]) > _AS_LIKELY:
        return found
    return replace(other, offsets=replace(other.offsets, turns=True))


def _calibrate(
    x: np.ndarray, y: np.ndarray, *, noise: np.ndarray | None, model: str, weighting: str,
    known: dict[str, float | None], ransac_px: float | None, seed: int, image_size_px: tuple[int, int] | None, checks: bool,
    views: np.ndarray | None = None,
) -> Calibration:  # fmt: skip
    """`calibrate` of x (n, 3), y (n, m), NaN = not seen, `noise` (1 or n, m, m); inlier `views` (n, cameras), None = find."""
    n, m = y.shape
    plan = Model.parse(model, m // 2)
    if weighting not in ("likelihood", "paper"):
        raise ValueError(f"weighting: expected 'likelihood' or 'paper', got {weighting!r}.")
    for name, value in (*known.items(), ("ransac_px", ransac_px)):
        endless = value == np.inf and name != "ransac_px"
        if value is not None and (endless or not (value > 0 or (value == 0 and name != "sigma_u_px"))):
            rule = "must be finite and not negative, and sigma_u_px not zero (ransac_px may be infinite)"
            raise ValueError(f"{name}: {rule}, got {value}; None estimates it.")
    if np.isfinite(y).sum() < len(plan.parameter_names):
        raise DataError(f"x_mm: {n} points are too few for the {len(plan.parameter_names)} parameters of '{model}'.")
    if noise is not None and not np.isfinite(noise).all():
        raise ValueError("covariance_px2: must be finite in every row.")
    if weighting == "paper" and noise is not None and len(noise) > 1:
        raise ValueError("weighting: the paper's energy has one sigma_u; give sigma_u_px, or weighting='likelihood'.")
    if checks:
        refuse.check_duplicates(x, y)
        refuse.check_units(x, y)
    sigma_x_mm = known["sigma_x_mm"]
    assumed_x = 0.0 if not checks else refuse.ROBOT_ACCURACY_MM if sigma_x_mm is None else sigma_x_mm
    refuse.check_spread(x, assumed_x)
    refuse.check_images(y, image_size_px if checks else None)
    final = views is not None or ransac_px is not None or (plan.is_affine and (noise is None or len(noise) == 1))
    if views is None and ransac_px == np.inf:
        views = np.isfinite(y).reshape(n, -1, 2).all(axis=2)
    elif views is None:
        rng = np.random.default_rng(seed)
        views, gates = consensus(x, y, ransac_px, rng, sigma_x_mm=sigma_x_mm, near=not plan.is_affine)
    for rows in views.T:
        refuse.check_spread(x[rows], assumed_x)
    claimed = np.eye(m)[None] if noise is None else noise
    for last in (False, False, False, True):
        inliers = views.any(axis=1)
        rows_noise = noise if noise is None or len(noise) == 1 else noise[inliers]
        used = x[inliers], y[inliers], views[inliers], rows_noise
        minimum, (sigma_u, sigma_x) = _minimise(plan, *used, weighting, known, image_size_px)
        scale = sigma_u / noise_rms_px(claimed if rows_noise is None else rows_noise)
        f, J, _ = minimum.state.evaluate(x, derivatives=False)
        residuals = y - f
        if final:
            break
        # An outlier under an affine camera and equal noise may be an inlier under the full model: test again with that.
        new = view_distances2(residuals, scale**2 * claimed + sigma_x**2 * J @ J.mT) < gates  # False for NaN (not seen)
        if last or (new == views).all() or new.sum() < views.sum():  # keep the views that the minimum was fitted to
            break
        views = new

    widest, narrowest = np.linalg.svd(minimum.state.A, compute_uv=False).T
    if (narrowest < _LINE * widest).any():
        what = "the camera that agrees best shows all positions on a line"
        raise NoConsensusError(f"u: no consensus, {what}; {NO_CONSENSUS_CURE}.")
    covariance = inverse(minimum.information)
    if weighting == "paper":  # its weights are not the inverse noise covariances: the sandwich H^-1 G H^-1
        variance_u, variance_x = paper_variances(sigma_u, sigma_x)
        _, J_x, J_c = minimum.state.evaluate(minimum.work.points)
        outer = J_x @ J_x.mT
        WJ = precision(variance_u * np.eye(m) + variance_x * outer, views[inliers]) @ J_c
        G = np.einsum("nip,nij,njq->pq", WJ, scale**2 * claimed + sigma_x**2 * outer, WJ)
        covariance = covariance @ G @ covariance
    found = Calibration(
        minimum=minimum, joint_covariance=covariance, view_inliers=views, sigma_u_px=sigma_u,
        sigma_x_mm=sigma_x, residuals_px=residuals, model=model, weighting=weighting, x_mm=x, y_px=y,
        image_size_px=None if image_size_px is None else tuple(image_size_px), effective_rows=float(inliers.sum()),
        covariance_px2=None if noise is None else scale**2 * noise, detector_scale=1.0 if noise is None else scale,
    )  # fmt: skip
    if found.rig is not None and checks:
        spread, A = found.extents_mm[2], found.rig.left.linear
        zoom = np.sqrt(np.abs(np.linalg.det(A @ A.T)) ** 0.5)
        sd_rad = np.hypot(sigma_u / zoom, sigma_x) / (spread * np.sqrt(views.sum(axis=0).min() / 2))
        if refuse.eyes_exchanged(found.rig.linear, sd_rad):
            degrees = np.rad2deg(-refuse.sides(found.rig.linear)[0])
            what = f"the cameras are swapped, the left one is {degrees:.1f} degrees to the right of the right one"
            cure = "exchange left and right images (if mirrored flip both, or one axis of x_mm; if upside down turn both)"
            raise DataError(f"u: {what}; {cure}.")
    return found


def _minimise(
    plan: Model, x: np.ndarray, y: np.ndarray, views: np.ndarray, noise: np.ndarray | None, weighting: str,
    known: dict[str, float | None], image_size_px: tuple[int, int] | None,
) -> tuple[Minimum, tuple[float, float]]:  # fmt: skip
    """The minimum for the inlier views (n, cameras) bool, and the noise levels (sigma_u, sigma_x)."""
    m, whole = y.shape[1], bool(views.all())
    used = np.repeat(views, 2, axis=1)
    if image_size_px is not None:
        centre = np.tile((np.asarray(image_size_px, dtype=float) - 1) / 2, (m // 2, 1))
    else:
        seen = np.where(used, y, np.nan)
        centre = ((np.nanmax(seen, axis=0) + np.nanmin(seen, axis=0)) / 2).reshape(-1, 2)
    start = np.vstack([regress(x[rows], y[rows, 2 * c : 2 * c + 2]) for c, rows in enumerate(views.T)])
    residuals = np.where(used, y - x @ start[:, :3].T - start[:, 3], 0.0)
    A, parameters = start[:, :3], 4 * m
    levels, minimum = None, None
    for _ in range(3):
        before, levels = levels, estimate_noise(residuals, A, parameters, views, noise, **known)
        if before is not None and np.allclose(before, levels, rtol=1e-3, atol=1e-12):
            levels = before
            break
        variance_u, variance_x = paper_variances(*levels) if weighting == "paper" else np.square(levels).tolist()
        claimed = np.eye(m)[None] if noise is None or weighting == "paper" else noise
        weigh = variance_u * claimed / noise_rms_px(claimed) ** 2
        anew = minimum is None or (plan.base == "affine" and plan.is_affine and whole and len(weigh) == 1)
        if anew and whole and len(weigh) == 1 and np.allclose(weigh[0], variance_u * np.eye(m), rtol=1e-12, atol=0):
            start = affine_minimum(x, y, variance_u, variance_x).matrix
        state = State.start(plan, start, x.mean(axis=0), centre) if anew else minimum.state
        minimum = fit(state, x, y, weigh, variance_x, views)
        residuals, A, parameters = minimum.work.residuals, minimum.state.A.reshape(m, 3), len(plan.parameter_names)
    return minimum, levels
