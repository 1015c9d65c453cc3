"""`Calibration`: cameras and their uncertainty; `optics`: the pair's geometry; `OnlineCalibration`: updates by new rows."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from lib.calibration.checks import extents
from lib.calibration.models import Model
from lib.calibration.robust import gate
from lib.cameras import Camera, StereoRig
from lib.correspondences import Correspondences
from lib.geometry import points, precision, view_distances2
from lib.least_squares import Minimum, inverse


@dataclass(frozen=True, eq=False)
class LandmarkOffsets:
    """Constant offsets of the landmarks that the detector sees from those that the robot reports.

    Attributes:
        offset, standard_deviation: (k, 3) mm in the tool's axes (along, across, normal), or (k, m) px in the images.
        prior_sd: Standard deviation of an offset's coordinate in the prior, given or chosen by maximum evidence.
        p_value: Probability of offsets at least as large as the data show, if there are none (score test).
        turns: True if the axes are those of the landmarks as detected, False if those of the landmarks as reported.
    """

    offset: np.ndarray
    standard_deviation: np.ndarray
    prior_sd: float
    p_value: float
    turns: bool = False


@dataclass(frozen=True, eq=False)
class Calibration:
    """Cameras and their uncertainty, the result of `lib.calibration.calibrate`.

    Attributes:
        minimum: The fit to the inliers (`lib.calibration.models.fit`).
        joint_covariance: (q, q) covariance of the model's parameters and, behind them, of the offsets' coordinates.
        view_inliers: (n, cameras) bool: the views used, one row for each row of the data.
        sigma_u_px, sigma_x_mm: Noise levels, given or estimated; with `covariance_px2`, sigma_u_px is its `noise_rms_px`.
        model, weighting, image_size_px: As given to `calibrate`.
        x_mm, y_px, residuals_px: (n, 3), (n, m) and y - project(x), m = 2 per camera, with the offsets applied.  Residuals
            contain the robot's errors.  NaN in unusable rows: a landmark is missing, or a tool with shut jaws has no axes.
        covariance_px2: The detector's covariances, scaled: None, (1, m, m), or (n, m, m).
        effective_rows: The number of rows with independent errors that are as informative as the inliers; smaller where
            errors are correlated, of a landmark from frame to frame or of the landmarks in a frame (a robot that reports a
            pose errs alike in all of them).  The covariances allow for this and for estimated noise.
        detector_scale: Factor, 1 or more, on the detector's standard deviations; `covariance_px2` includes it.
        offsets: Constant offsets of the landmarks, None where they were not estimated.
        not_shown: (q + 1,) one standard deviation of what affine cameras leave unknown: the changes of the parameters of
            `joint_covariance`, then the 1/distance in 1/mm that causes them.  None unless by `calibrate_as_shown`.
    """

    minimum: Minimum
    joint_covariance: np.ndarray
    view_inliers: np.ndarray
    sigma_u_px: float
    sigma_x_mm: float
    residuals_px: np.ndarray
    model: str
    weighting: str
    x_mm: np.ndarray
    y_px: np.ndarray
    covariance_px2: np.ndarray | None
    image_size_px: tuple[int, int] | None
    effective_rows: float
    detector_scale: float
    offsets: LandmarkOffsets | None = None
    not_shown: np.ndarray | None = None

    @property
    def parameter_names(self) -> list[str]:
        """Names of the model's parameters, with units."""
        return self.minimum.state.model.parameter_names

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """The one or two cameras; they are near-affine if the model has 1/distance or radial distortion."""
        return self.minimum.state.cameras()

    @cached_property
    def rig(self) -> StereoRig | None:
        """The pair of cameras; None for a single one."""
        return StereoRig(*self.cameras) if len(self.cameras) == 2 else None

    @property
    def pair(self) -> StereoRig:
        """The same as `rig`, but a ValueError refuses a single camera."""
        if self.rig is None:
            raise ValueError("calibration: this needs a stereo pair, not a single camera; calibrate with [u_left, u_right].")
        return self.rig

    @property
    def cost(self) -> float:
        """The energy over the inliers (Eq. 3 as printed for ``paper``, else half the chi-square)."""
        return self.minimum.energy

    @property
    def parameter_covariance(self) -> np.ndarray:
        """(p, p) covariance of the model's parameters."""
        p = len(self.parameter_names)
        return self.joint_covariance[:p, :p]

    @property
    def variations(self) -> list[tuple[StereoRig, LandmarkOffsets | None]]:
        """Rigs and offsets that differ by one standard deviation along each principal axis of `joint_covariance`.

        The last one is at the finite distance that is `not_shown`.  For any result, the squares of its differences add up to
        its variance.
        """
        _ = self.pair  # a ValueError refuses a single camera
        values, vectors = np.linalg.eigh(self.joint_covariance)
        p, q, learnt, found = len(self.parameter_names), len(values), self.offsets, []
        steps = [*(vectors * np.sqrt(np.maximum(values, 0.0))).T, *([] if self.not_shown is None else [self.not_shown])]
        for step in steps:
            state = self.minimum.state.moved(step[:p])
            if len(step) > q:
                near = Model.parse(f"{self.model}+distance", len(self.cameras))
                state = replace(state, model=near, rho=state.rho + step[q])
            offsets = learnt and replace(learnt, offset=learnt.offset + step[p:q].reshape(learnt.offset.shape))
            found.append((StereoRig(*state.cameras()), offsets))
        return found

    @property
    def covariance(self) -> np.ndarray:
        """(8 c, 8 c): covariance of the entries of the c matrices M, row by row, left first; px^2, px^2/mm, px^2/mm^2."""
        G = self.minimum.state.matrix_jacobian()
        return G @ self.parameter_covariance @ G.T

    @property
    def inliers(self) -> np.ndarray:
        """(n,) bool: the rows used in at least one view."""
        return self.view_inliers.any(axis=1)

    @property
    def usable(self) -> np.ndarray:
        """(n,) bool: the rows that could be used in at least one view; usable rows that are not inliers are outliers."""
        return np.isfinite(self.residuals_px).any(axis=1)

    @property
    def extents_mm(self) -> np.ndarray:
        """(3,) RMS extents of the inliers' positions, the largest first; the last is their thickness."""
        return extents(self.x_mm[self.inliers])

    @property
    def reprojection_rms_px(self) -> float:
        """RMS of the distance |u - project(x)| in an image, over the views used."""
        return self._rms(self.residuals_px[self.inliers])

    @property
    def chi_square(self) -> tuple[float, int]:
        """Chi-square of the inliers and its degrees of freedom; the two are nearly equal if model and noise levels fit."""
        _, _, weight, r = self.system
        value = float((r[:, None] @ weight @ r[:, :, None]).sum())
        return value, 2 * int(self.view_inliers.sum()) - len(self.parameter_names)

    @property
    def inverse_distance_per_mm(self) -> tuple[float, float]:
        """1/distance in 1/mm (of the first camera, if each has its own) and its standard deviation; (0, 0) if affine."""
        for i, name in enumerate(self.parameter_names):
            if "1/distance" in name:
                return float(self.minimum.state.rho[0]), float(np.sqrt(self.parameter_covariance[i, i]))
        return 0.0, 0.0

    @property
    def noise_px2(self) -> np.ndarray:
        """(m, m) covariance assumed for a new detection of the pair."""
        return self.sigma_u_px**2 * np.eye(2 * len(self.cameras))

    def detection_covariance(self, data: Correspondences) -> np.ndarray:
        """(n, 4, 4) px^2 of new detections: those stated, scaled by `detector_scale`; `noise_px2` for rows without."""
        own = data.pair_covariance_px2
        stated = np.isfinite(own).all(axis=(1, 2), keepdims=True) & (self.covariance_px2 is not None)
        return np.where(stated, self.detector_scale**2 * own, self.noise_px2)

    def derivatives(self, x_mm: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of the projections of x (n, 3) by the points (n, m, 3) and by the model's parameters (n, m, p)."""
        return self.minimum.state.evaluate(points(x_mm, 3, "x_mm"))[1:]

    @cached_property
    def system(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives by points and by parameters, inverse covariances, residuals of the inliers; 0 in views not used."""
        _, J_x, J_c = self.minimum.state.evaluate(self.minimum.work.points)
        J = J_x[:1] if self.minimum.state.model.is_affine else J_x
        noise = self.noise_px2[None] if self.covariance_px2 is None else self.covariance_px2
        noise = noise if len(noise) == 1 else noise[self.inliers]
        weight = precision(noise + self.sigma_x_mm**2 * J @ J.mT, self.view_inliers[self.inliers])
        return J_x, J_c, weight, self.minimum.work.residuals

    def projection_covariance(self, x_mm: ArrayLike) -> np.ndarray:
        """(n, m, m) px^2: covariance of the projections of exact points, from the calibration's uncertainty alone."""
        J = self.derivatives(x_mm)[1]
        return J @ self.parameter_covariance @ np.swapaxes(J, 1, 2)

    def point_covariance(self, x_mm: ArrayLike, *, detection: bool | np.ndarray = True) -> np.ndarray:
        """(n, 3, 3) mm^2 of triangulated points, from the calibration's uncertainty and that of the detections.

        The latter is `noise_px2`, or a covariance (n, m, m) px^2; with False the detections are exact.
        """
        J = self.pair.jacobian(x_mm)
        gain = np.linalg.solve(J.mT @ J, J.mT)  # the noise is the same in every pixel coordinate
        noise_px2 = self.noise_px2 if detection is True else detection
        return gain @ (self.projection_covariance(x_mm) + noise_px2) @ np.swapaxes(gain, 1, 2)

    def depth_sd_mm(self, x_mm: ArrayLike, *, detection: bool | np.ndarray = False) -> np.ndarray:
        """(n,) standard deviation of triangulated points along the mean viewing direction, for maps of the workspace."""
        direction = sum(camera.viewing_direction for camera in self.cameras)
        direction = direction / np.linalg.norm(direction)
        return np.sqrt(np.einsum("i,nij,j->n", direction, self.point_covariance(x_mm, detection=detection), direction))

    @cached_property
    def leverage(self) -> np.ndarray:
        """(inliers, m, m): derivative of each inlier's projection by its own pixels."""
        _, J, weight, _ = self.system
        return J @ np.linalg.inv(self.minimum.information) @ np.swapaxes(J, 1, 2) @ weight

    @cached_property
    def leave_one_out_px(self) -> np.ndarray:
        """(inliers, m) residuals of each inlier about the cameras fitted without it, exact for DLT; NaN in views not used."""
        r = self.system[3]
        r = np.linalg.solve(np.eye(r.shape[1]) - self.leverage, r[:, :, None])[:, :, 0]
        return np.where(np.repeat(self.view_inliers[self.inliers], 2, axis=1), r, np.nan)

    @property
    def press_rms_px(self) -> float:
        """Cross-validated reprojection error: RMS distance in an image, with each row predicted from the others."""
        return self._rms(self.leave_one_out_px)

    def _rms(self, r: np.ndarray) -> float:
        """RMS over the views used of the distances in an image, from residuals (inliers, m)."""
        views = self.view_inliers[self.inliers]
        return float(np.sqrt((r[np.repeat(views, 2, axis=1)] ** 2).sum() / views.sum()))


@dataclass(frozen=True, eq=False)
class Optics:
    """Geometry of the stereo pair.

    Attributes:
        mirrored: "no"; "left", "right", "left or right" (an odd number of reflections in one channel); "both"; "unknown".
            Only perspective can distinguish two mirrored cameras from two unmirrored ones on the other side of the scene.
        convergence_rad: Angle between the viewing directions (of the unmirrored pair).
        roll_rad: Rotation of the right image's content relative to the left's, x towards y.
        centre_mm: (3,) where the rays of the two image centres come closest to each other.
    """

    mirrored: str
    convergence_rad: float
    roll_rad: float
    centre_mm: np.ndarray


def optics(calibration: Calibration) -> Optics:
    """Derives the pair's geometry; a ValueError refuses a single camera, in which a mirror cannot be noticed."""
    rig = calibration.pair
    cosine = float(rig.left.viewing_direction @ rig.right.viewing_direction)
    # Signs of 1/distance where it is at least three standard deviations; negative = mirrored.
    distance, sd = calibration.inverse_distance_per_mm
    signs = np.sign([getattr(c, "inverse_distance_per_mm", 0.0) * (abs(distance) >= 3 * sd) for c in calibration.cameras])
    if cosine < 0:
        mirrored = ("left" if signs[0] < 0 else "right") if signs.any() and signs.sum() == 0 else "left or right"
    else:
        mirrored = ("both" if signs.sum() < 0 else "no") if signs.any() else "unknown"
    rows = [camera.linear / np.linalg.norm(camera.linear, axis=1, keepdims=True) for camera in (rig.left, rig.right)]
    roll = float(np.arctan2(-rows[1][0] @ rows[0][1], rows[1][0] @ rows[0][0]))
    if calibration.image_size_px is not None:
        centre = (np.asarray(calibration.image_size_px, dtype=float) - 1) / 2
    else:
        centre = np.nanmean(calibration.y_px[calibration.inliers].reshape(-1, 2, 2), axis=(0, 1))
    angle = float(np.arccos(np.clip(abs(cosine), -1, 1)))
    return Optics(mirrored, angle, roll, rig.triangulate(centre[None], centre[None]).x_mm[0])


class OnlineCalibration:
    """Updates a calibration by new rows: an extended Kalman filter of the camera model's parameters.

    The filter starts with the calibration's parameters and Fisher information.  A new row is weighted by its own covariance,
    or by the calibration's noise level if it states none.  The robot's noise is the calibration's.  Views whose innovation
    is too large for these covariances are not used.  If the calibration has offsets, give rows `with_offsets`.

    >>> from lib.calibration import calibrate
    >>> rng, A = np.random.default_rng(0), np.array([[99.0, 0, -9], [0, 99, 0], [99, 0, 9], [0, 99, 0]])
    >>> x = rng.uniform(-4, 4, (60, 3))
    >>> y = x @ A.T + rng.normal(0, 1, (60, 4))
    >>> online = OnlineCalibration(calibrate(x[:30], [y[:30, :2], y[:30, 2:]]))
    >>> int(online.add(Correspondences.of_points(x[30:], y[30:, :2], y[30:, 2:])).sum())
    60
    >>> online.solve().linear[0].round().astype(int).tolist()
    [99, 0, -9]
    """

    def __init__(self, calibration: Calibration) -> None:
        _ = calibration.pair  # a ValueError refuses a single camera
        self._calibration, self._state = calibration, calibration.minimum.state
        self._information = calibration.minimum.information
        self._covariance = self._first = inverse(self._information)

    def add(self, data: Correspondences) -> np.ndarray:
        """Updates the cameras by the rows of a frame; returns the views (n, 2) bool that were used."""
        known, variance_x = self._calibration, self._calibration.sigma_x_mm**2
        used = data.seen & np.isfinite(data.x_mm).all(axis=1, keepdims=True)
        pixels, noise = data.stacked_px, known.detection_covariance(data)
        x = np.where(used.any(axis=1, keepdims=True), data.x_mm, self._state.reference)
        y, J_x, J = self._state.evaluate(x)
        r = np.where(np.repeat(used, 2, axis=1), pixels - y, 0.0)
        S = noise + variance_x * J_x @ J_x.mT
        used &= view_distances2(r, S + J @ self._covariance @ J.mT) < gate(100)  # with the rig's uncertainty
        if used.any():
            W = precision(S, used)
            # Take the derivatives at the corrected points, as in `fit`; at the noisy points they would bias the depth.
            moved = variance_x * np.einsum("nij,nik,nk->nj", J_x, W, r)
            y, J_x, J = self._state.evaluate(x + moved)
            r = np.where(np.repeat(used, 2, axis=1), pixels - y + np.einsum("nij,nj->ni", J_x, moved), 0.0)
            WJ = W @ J
            self._information = self._information + np.einsum("nip,niq->pq", J, WJ)
            self._covariance = inverse(self._information)
            self._state = self._state.moved(self._covariance @ np.einsum("nip,ni->p", WJ, r))
        return used

    def remains(self, x_mm: np.ndarray) -> np.ndarray:
        """(n,) variance of the projections of x_mm (n, 3) now, divided by the variance from the calibration alone."""
        J = self._state.evaluate(x_mm)[2]
        now, first = (np.einsum("nip,pq,niq->n", J, known, J) for known in (self._covariance, self._first))
        return now / first

    def solve(self) -> StereoRig:
        """The rig estimated from all rows so far."""
        return StereoRig(*self._state.cameras())
