"""`Calibration`: cameras, how well they are known, what they tell of the optics, and how new frames move them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from lib.calibration.checks import extents
from lib.calibration.models import Fit
from lib.calibration.robust import gate
from lib.cameras import Camera, StereoRig
from lib.correspondences import Correspondences
from lib.geometry import RigidTransform, points, precision, view_distances2
from lib.least_squares import inverse


@dataclass(frozen=True, eq=False)
class LandmarkOffsets:
    """Where the landmarks are seen, relative to where the robot reports them.

    Attributes:
        offset, covariance: (k, 3) mm in the tool's axes (along, across, normal), or (k, m) px; (k, d, d) of each landmark.
        prior_sd: Of a coordinate before the data, given or chosen by the evidence.
        p_value: Probability of offsets as large as the data show if there are none (score test).
        turns: The axes are those of the landmarks where they are seen, not where the robot reports them.
    """

    offset: np.ndarray
    covariance: np.ndarray
    prior_sd: float
    p_value: float
    turns: bool = False

    @property
    def standard_deviation(self) -> np.ndarray:
        """(k, d) of the offsets."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


@dataclass(frozen=True, eq=False)
class Calibration:
    """Cameras, and how well they are known; `lib.calibration.calibrate` makes it.

    Attributes:
        minimum: The fit to the inliers.
        parameter_covariance: (p, p) of the model's own parameters.
        view_inliers: (n, cameras) bool, the views used, one row for each row given.
        sigma_u_px, sigma_x_mm: Noise levels, given or estimated; the RMS of the detector's scaled covariances where given.
        model, weighting, image_size_px: As asked for.
        x_mm, y_px, residuals_px: (n, 3), (n, m) and u - project(x), m = 2 cameras, robot error included; moved by the
            offsets.  NaN in rows that are not usable: a landmark is missing, or a tool with shut jaws has no axes.
        covariance_px2: Of the pixels: None, (1, m, m), or (n, m, m).
        effective_rows: As how many rows of independent errors the inliers count: fewer where a landmark's errors are alike
            from frame to frame.  The covariances allow for that, and for a noise level that is estimated.
        detector_scale: By how much more than it claims the detector errs, 1 or more; `covariance_px2` allows for that.
        offsets: Constant offsets of the landmarks, None where they were not estimated.
    """

    minimum: Fit
    parameter_covariance: np.ndarray
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

    @property
    def parameter_names(self) -> list[str]:
        """Names of the model's parameters, with units."""
        return self.minimum.state.model.parameter_names

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """One or two, near-affine if the model has 1/distance or radial distortion."""
        return self.minimum.state.cameras()

    @cached_property
    def rig(self) -> StereoRig | None:
        """The pair of cameras; None for a single one."""
        return StereoRig(*self.cameras) if len(self.cameras) == 2 else None

    @property
    def pair(self) -> StereoRig:
        """`rig`; a ValueError for a single camera."""
        if self.rig is None:
            raise ValueError("calibration: this needs a stereo pair, not a single camera; calibrate with [u_left, u_right].")
        return self.rig

    @property
    def cost(self) -> float:
        """The energy over the inliers (Eq. 3 as printed for ``paper``, else half the chi-square)."""
        return self.minimum.cost

    @property
    def covariance(self) -> np.ndarray:
        """(8 cameras, 8 cameras) of the entries of the matrices M, row by row, left first, in px^2, px^2/mm, px^2/mm^2."""
        G = self.minimum.state.matrix_jacobian()
        return G @ self.parameter_covariance @ G.T

    @property
    def inliers(self) -> np.ndarray:
        """(n,) bool: the rows used in at least one view."""
        return self.view_inliers.any(axis=1)

    @property
    def usable(self) -> np.ndarray:
        """(n,) bool: the rows that could be used in at least one view; those that are no inliers are outliers."""
        return np.isfinite(self.residuals_px).any(axis=1)

    @property
    def extents_mm(self) -> np.ndarray:
        """(3,) RMS extents of the inliers' positions, the largest first; the last is their thickness."""
        return extents(self.x_mm[self.inliers])

    @property
    def reprojection_rms_px(self) -> float:
        """RMS over the views used of the distance |u - project(x)| in an image."""
        return self._rms(self.residuals_px[self.inliers])

    @property
    def chi_square(self) -> tuple[float, int]:
        """Twice the likelihood energy over the inliers and its degrees of freedom; the two are alike where all is well."""
        _, _, weight, r = self.system
        value = float((r[:, None] @ weight @ r[:, :, None]).sum())
        return value, 2 * int(self.view_inliers.sum()) - len(self.parameter_names)

    @property
    def inverse_distance_per_mm(self) -> tuple[float, float]:
        """1/d and its standard deviation (the first, where each camera has its own); (0, 0) for affine models."""
        for i, name in enumerate(self.parameter_names):
            if "1/distance" in name:
                return float(self.minimum.state.rho[0]), float(np.sqrt(self.parameter_covariance[i, i]))
        return 0.0, 0.0

    @property
    def noise_px2(self) -> np.ndarray:
        """(m, m) covariance assumed for a new detection of the pair."""
        return self.sigma_u_px**2 * np.eye(2 * len(self.cameras))

    def detection_covariance(self, data: Correspondences) -> np.ndarray:
        """(n, 4, 4) px^2 of new detections of the pair: as stated and scaled; `noise_px2` of rows that state none."""
        own = data.pair_covariance_px2
        stated = np.isfinite(own).all(axis=(1, 2), keepdims=True) & (self.covariance_px2 is not None)
        return np.where(stated, self.detector_scale**2 * own, self.noise_px2)

    def derivatives(self, x_mm: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Of the projections at x (n, 3): by the points (n, m, 3) and by the model's parameters (n, m, p)."""
        return self.minimum.state.evaluate(points(x_mm, 3, "x_mm"))[1:]

    @cached_property
    def system(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Over the inliers: derivatives by points and parameters; inverse covariances and residuals, 0 in views not used."""
        _, J_x, J_c = self.minimum.state.evaluate(self.minimum.points)
        J = J_x[:1] if self.minimum.state.model.is_affine else J_x
        noise = self.noise_px2[None] if self.covariance_px2 is None else self.covariance_px2
        noise = noise if len(noise) == 1 else noise[self.inliers]
        weight = precision(noise + self.sigma_x_mm**2 * J @ J.mT, self.view_inliers[self.inliers])
        return J_x, J_c, weight, self.minimum.residuals

    def projection_covariance(self, x_mm: ArrayLike) -> np.ndarray:
        """(n, m, m) px^2 covariance of the projections of exact points, from the calibration's uncertainty alone."""
        J = self.derivatives(x_mm)[1]
        return J @ self.parameter_covariance @ np.swapaxes(J, 1, 2)

    def point_covariance(self, x_mm: ArrayLike, *, detection: bool = True) -> np.ndarray:
        """(n, 3, 3) mm^2 of triangulated points, from the calibration's own uncertainty and (`detection`) the detections'."""
        J = self.pair.jacobian(x_mm)
        gain = np.linalg.solve(J.mT @ J, J.mT)  # the noise is the same in every pixel coordinate
        return gain @ (self.projection_covariance(x_mm) + (self.noise_px2 if detection else 0.0)) @ np.swapaxes(gain, 1, 2)

    def depth_sd_mm(self, x_mm: ArrayLike, *, detection: bool = False) -> np.ndarray:
        """(n,) standard deviation along the mean viewing direction, for maps of the workspace."""
        direction = sum(camera.viewing_direction for camera in self.cameras)
        direction = direction / np.linalg.norm(direction)
        return np.sqrt(np.einsum("i,nij,j->n", direction, self.point_covariance(x_mm, detection=detection), direction))

    @cached_property
    def leverage(self) -> np.ndarray:
        """(inliers, m, m): by how much each inlier's own pixels move its projection."""
        _, J, weight, _ = self.system
        return J @ np.linalg.inv(self.minimum.information) @ np.swapaxes(J, 1, 2) @ weight

    @cached_property
    def leave_one_out_px(self) -> np.ndarray:
        """(inliers, m) residual of each inlier to the cameras fitted without it, exact for DLT; NaN in views not used."""
        r = self.system[3]
        r = np.linalg.solve(np.eye(r.shape[1]) - self.leverage, r[:, :, None])[:, :, 0]
        return np.where(np.repeat(self.view_inliers[self.inliers], 2, axis=1), r, np.nan)

    @property
    def press_rms_px(self) -> float:
        """Cross-validated reprojection error: RMS distance in an image, each row predicted by the others."""
        return self._rms(self.leave_one_out_px)

    def _rms(self, r: np.ndarray) -> float:
        """Of residuals (inliers, m) as distances in an image, over the views used."""
        views = self.view_inliers[self.inliers]
        return float(np.sqrt((r[np.repeat(views, 2, axis=1)] ** 2).sum() / views.sum()))


@dataclass(frozen=True, eq=False)
class Optics:
    """The pair as a piece of optics.

    Attributes:
        mirrored: "no"; "left", "right", "left or right" (an odd number of reflections in one channel); "both"; "unknown":
            only perspective can tell two cameras mirrored alike from unmirrored ones on the other side of the scene.
        convergence_rad: Angle between the viewing directions (of the unmirrored pair).
        roll_rad: Rotation of the right image's content relative to the left's, x towards y.
        robot_from_microscope: Pose of the stereo head: x right in the mean image, z along the mean viewing direction,
            origin where the image centres' rays come closest.
    """

    mirrored: str
    convergence_rad: float
    roll_rad: float
    robot_from_microscope: RigidTransform


def optics(calibration: Calibration) -> Optics:
    """Judge both channels together; a ValueError for a single camera, which cannot tell a mirror."""
    rig = calibration.pair
    directions = np.stack([rig.left.viewing_direction, rig.right.viewing_direction])
    cosine = float(directions[0] @ directions[1])
    # Where perspective is seen at three standard deviations; negative = mirrored.
    distance, sd = calibration.inverse_distance_per_mm
    signs = np.sign([getattr(c, "inverse_distance_per_mm", 0.0) * (abs(distance) >= 3 * sd) for c in calibration.cameras])
    if cosine < 0:
        mirrored = ("left" if signs[0] < 0 else "right") if signs.any() and signs.sum() == 0 else "left or right"
        directions[1] *= -1
    else:
        mirrored = ("both" if signs.sum() < 0 else "no") if signs.any() else "unknown"
    z = directions.sum(axis=0) * (-1.0 if mirrored in ("both", "left") else 1.0)
    z /= np.linalg.norm(z)
    rows = [camera.linear / np.linalg.norm(camera.linear, axis=1, keepdims=True) for camera in (rig.left, rig.right)]
    x = rows[0][0] if mirrored != "left" else rows[1][0]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    roll = float(np.arctan2(-rows[1][0] @ rows[0][1], rows[1][0] @ rows[0][0]))
    if calibration.image_size_px is not None:
        centre = (np.asarray(calibration.image_size_px, dtype=float) - 1) / 2
    else:
        centre = np.nanmean(calibration.y_px[calibration.inliers].reshape(-1, 2, 2), axis=(0, 1))
    origin = rig.triangulate(centre[None], centre[None]).x_mm[0]
    angle = float(np.arccos(np.clip(abs(cosine), -1, 1)))
    return Optics(mirrored, angle, roll, RigidTransform(np.column_stack([x, np.cross(z, x), z]), origin))


class OnlineCalibration:
    """A calibration's minimum, moved by all rows that came since: an extended Kalman filter of the model's parameters.

    It has the calibration's camera model, and its information from the calibration's rows; each new row counts by its own
    covariance, or the calibration's where it states none.  So it starts where the calibration ended, and the calibration's
    noise levels judge the new rows.

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
        self._calibration, self._state = calibration, calibration.minimum.state
        self._information = calibration.minimum.information
        self._covariance = self._first = inverse(self._information)

    def add(self, data: Correspondences) -> np.ndarray:
        """Fold in the rows of a frame; returns the views (n, 2) bool that were used, those the rig so far does not refuse."""
        known, variance_x = self._calibration, self._calibration.sigma_x_mm**2
        used = data.seen & np.isfinite(data.x_mm).all(axis=1, keepdims=True)
        pixels, noise = data.stacked_px, known.detection_covariance(data)
        x = np.where(used.any(axis=1, keepdims=True), data.x_mm, self._state.reference)
        y, J_x, J = self._state.evaluate(x)
        r = np.where(np.repeat(used, 2, axis=1), pixels - y, 0.0)
        S = noise + variance_x * J_x @ J_x.mT
        used &= view_distances2(r, S + J @ self._covariance @ J.mT) < gate(100, 2)  # the rig is uncertain itself
        if used.any():
            W = precision(S, used)
            # The derivatives belong to the corrected points, as in `fit`: those of noisy ones would flatten the depth.
            moved = variance_x * np.einsum("nij,nik,nk->nj", J_x, W, r)
            y, J_x, J = self._state.evaluate(x + moved)
            r = np.where(np.repeat(used, 2, axis=1), pixels - y + np.einsum("nij,nj->ni", J_x, moved), 0.0)
            WJ = W @ J
            self._information = self._information + np.einsum("nip,niq->pq", J, WJ)
            self._covariance = inverse(self._information)
            self._state = self._state.moved(self._covariance @ np.einsum("nip,ni->p", WJ, r))
        return used

    def remains(self, x_mm: np.ndarray) -> np.ndarray:
        """(n,) of the variance of the calibration's projections of x_mm (n, 3), what the rows since then have left."""
        J = self._state.evaluate(x_mm)[2]
        now, first = (np.einsum("nip,pq,niq->n", J, known, J) for known in (self._covariance, self._first))
        return now / first

    def solve(self) -> StereoRig:
        """The rig of the rows so far."""
        return StereoRig(*self._state.cameras())
