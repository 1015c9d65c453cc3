"""`calibrate`: from correspondences to cameras with their covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from lib.calibration.affine import Moments, affine_minimum, estimate_noise, paper_variances
from lib.calibration.checks import (
    ROBOT_ACCURACY_MM,
    check_duplicates,
    check_images,
    check_order,
    check_spread,
    check_units,
    correspondences,
    pixel_covariance,
)
from lib.calibration.models import Fit, Model, State, fit
from lib.calibration.robust import consensus, gate
from lib.cameras import AffineCamera, NearAffineCamera, Points, Resection, StereoRig
from lib.geometry import points

__all__ = ["Calibration", "calibrate"]


@dataclass(frozen=True, eq=False)
class Calibration:
    """Cameras, and how well they are known.

    Attributes
    ----------
    cameras:
        One or two; affine unless the model has 1/distance or radial distortion.
    rig:
        The stereo pair, None for one camera.
    inliers:
        (n,) bool, the rows used.
    cost:
        The energy at the minimum over the inliers (Eq. 3 as printed for ``paper``, else half the chi-square).
    covariance:
        (8 cameras, 8 cameras) of the entries of the matrices M, row by row, left first; px^2, px^2/mm, px^2/mm^2.
    parameter_covariance:
        (p, p) of the model's own parameters, `parameter_names`.
    sigma_u_px, sigma_x_mm:
        Noise levels, given or estimated.  With `covariance_px2` given, sigma_u_px is the RMS of the detector's own.
    residuals_px:
        (n, 2 cameras) of all rows, u - project(x): what the eye would see, robot error included.
    model, weighting:
        As asked for.
    x_mm, y_px:
        The data, (n, 3) and (n, 2 cameras).
    """

    cameras: tuple[AffineCamera | NearAffineCamera, ...]
    rig: StereoRig | None
    inliers: np.ndarray
    cost: float
    covariance: np.ndarray
    parameter_covariance: np.ndarray
    parameter_names: list[str]
    sigma_u_px: float
    sigma_x_mm: float
    residuals_px: np.ndarray
    model: str
    weighting: str
    x_mm: np.ndarray
    y_px: np.ndarray
    covariance_px2: np.ndarray | None = None
    image_size_px: tuple[int, int] | None = None
    _model: Model = field(repr=False, default=None)
    _fit: Fit = field(repr=False, default=None)

    @property
    def reprojection_rms_px(self) -> float:
        """RMS over inliers of the distance |u - project(x)| in an image."""
        return float(np.sqrt((self.residuals_px[self.inliers] ** 2).sum() / (self.inliers.sum() * len(self.cameras))))

    @property
    def chi_square(self) -> tuple[float, int]:
        """Twice the likelihood energy over the inliers and its degrees of freedom; the two are alike where all is well."""
        S = self._residual_covariance(self._fit.points, self._inlier_noise)
        r = self._fit.residuals
        value = np.einsum("ni,nij,nj->", r, np.broadcast_to(np.linalg.inv(S), (len(r), *S.shape[1:])), r)
        return float(value), r.size - len(self.parameter_names)

    @property
    def inverse_distance_per_mm(self) -> tuple[float, float]:
        """1/d and its standard deviation (the first, where each camera has its own); (0, 0) for affine models."""
        for i, name in enumerate(self.parameter_names):
            if "1/distance" in name:
                return float(self._fit.state.rho[0]), float(np.sqrt(self.parameter_covariance[i, i]))
        return 0.0, 0.0

    @cached_property
    def standard_deviations(self) -> dict[str, float]:
        """Standard deviation of every parameter by name (names carry the unit; a log zoom is a relative zoom)."""
        return dict(zip(self.parameter_names, np.sqrt(np.diag(self.parameter_covariance)).tolist(), strict=True))

    def resections(self) -> tuple[Resection, ...]:
        """K, R, t of each camera (paper Eq. 5); mirrored optics are told by `optics`."""
        return tuple(AffineCamera(camera.matrix).resect() for camera in self.cameras)

    # ---- uncertainty -------------------------------------------------------------------------------------------------

    @property
    def noise_px2(self) -> np.ndarray:
        """(m, m) covariance assumed for a new detection of the pair."""
        m = 2 * len(self.cameras)
        return self.sigma_u_px**2 * np.eye(m)

    @property
    def _inlier_noise(self) -> np.ndarray:
        if self.covariance_px2 is None:
            return self.noise_px2[None]
        return self.covariance_px2[None] if self.covariance_px2.ndim == 2 else self.covariance_px2[self.inliers]

    def _residual_covariance(self, centred: np.ndarray, noise: np.ndarray) -> np.ndarray:
        J = self._fit.state.evaluate(centred, derivatives=False)[1]
        if self._model.is_affine:
            J = J[:1]
        return noise + self.sigma_x_mm**2 * J @ np.swapaxes(J, 1, 2)

    def projection_covariance(self, x_mm: ArrayLike) -> np.ndarray:
        """(n, m, m) px^2 covariance of the projections of exact points, from the calibration's uncertainty alone."""
        x = points(x_mm, 3, "x_mm") - self._fit.state.reference
        J = self._fit.state.evaluate(x)[2] @ self._model.selection
        return J @ self.parameter_covariance @ np.swapaxes(J, 1, 2)

    def leverage(self, x_mm: ArrayLike) -> np.ndarray:
        """(n,) how much a point's projection hangs on the calibration: its covariance in units of one row's noise.

        For the affine model it is h^T (H^T H)^-1 h with h = [x; 1], and averages 4/n over the data.
        """
        x = points(x_mm, 3, "x_mm")
        S = self._residual_covariance(x - self._fit.state.reference, self.noise_px2[None])
        return np.trace(np.linalg.solve(S, self.projection_covariance(x)), axis1=1, axis2=2) / S.shape[-1]

    def point_covariance(self, x_mm: ArrayLike, *, detection: bool = True) -> np.ndarray:
        """(n, 3, 3) mm^2 covariance of triangulated points, with the calibration's own uncertainty.

        Parameters
        ----------
        x_mm:
            Where, (n, 3).
        detection:
            False leaves out the noise of the detections: what more calibration data could still remove.
        """
        if self.rig is None:
            raise ValueError("point_covariance: needs a stereo pair; calibrate with [u_left, u_right].")
        x = points(x_mm, 3, "x_mm")
        J = self.rig.jacobian(x)
        weight = np.linalg.inv(self.noise_px2)
        gain = np.linalg.solve(np.swapaxes(J, 1, 2) @ weight @ J, np.swapaxes(J, 1, 2) @ weight)
        noise = self.projection_covariance(x)
        if detection:
            noise = noise + self.noise_px2
        return gain @ noise @ np.swapaxes(gain, 1, 2)

    def triangulate(self, u_left: ArrayLike, u_right: ArrayLike, covariance_px2: ArrayLike | None = None) -> Points:
        """`StereoRig.triangulate` whose covariance has the calibration's uncertainty and the estimated sigma_u in it."""
        if self.rig is None:
            raise ValueError("triangulate: needs a stereo pair; calibrate with [u_left, u_right].")
        found = self.rig.triangulate(u_left, u_right, self.noise_px2 if covariance_px2 is None else covariance_px2)
        known = np.isfinite(found.x_mm).all(axis=1)
        covariance = found.covariance_mm2.copy()
        covariance[known] += self.point_covariance(found.x_mm[known], detection=False)
        return Points(found.x_mm, covariance, found.epipolar_px)

    def depth_sd_mm(self, x_mm: ArrayLike, *, detection: bool = False) -> np.ndarray:
        """(n,) standard deviation along the mean viewing direction, for maps of the workspace."""
        direction = sum(camera.viewing_direction for camera in self.cameras)
        direction = direction / np.linalg.norm(direction)
        return np.sqrt(np.einsum("i,nij,j->n", direction, self.point_covariance(x_mm, detection=detection), direction))

    @cached_property
    def leave_one_out_px(self) -> np.ndarray:
        """(inliers, m) residual of each inlier to the cameras fitted without it, in closed form.

        (I - L)^-1 r with L the row's own share of its prediction: r / (1 - leverage) for the affine model, exact for DLT.
        """
        state, x = self._fit.state, self._fit.points
        J = state.evaluate(x)[2] @ self._model.selection
        S = self._residual_covariance(x, self._inlier_noise)
        own = J @ self.parameter_covariance @ np.swapaxes(J, 1, 2) @ np.linalg.inv(S)
        return np.linalg.solve(np.eye(own.shape[1]) - own, self._fit.residuals[:, :, None])[:, :, 0]

    @property
    def press_rms_px(self) -> float:
        """Cross-validated reprojection error: RMS distance in an image, each row predicted by the others."""
        return float(np.sqrt((self.leave_one_out_px**2).sum() / (len(self.leave_one_out_px) * len(self.cameras))))

    # ---- reports -----------------------------------------------------------------------------------------------------

    def report(self) -> str:
        """The calibration in words: figures with units, verdicts, outliers (see `lib.calibration.report`)."""
        from lib.calibration.report import report

        return report(self)


def calibrate(
    x_mm: ArrayLike,
    u: Sequence[ArrayLike],
    *,
    model: str = "zero_skew",
    weighting: str = "likelihood",
    sigma_u_px: float | None = None,
    sigma_x_mm: float | None = None,
    covariance_px2: ArrayLike | Sequence[ArrayLike] | None = None,
    ransac_px: float | None = None,
    seed: int = 0,
    image_size_px: tuple[int, int] | None = None,
    checks: bool = True,
) -> Calibration:
    """Cameras from robot positions and their detections: outliers out, then the exact minimum of Eq. (3).

    Parameters
    ----------
    x_mm:
        (n, 3) landmark positions in the robot frame.
    u:
        [u_left, u_right] or [u], (n, 2) px each, row by row with `x_mm`.
    model:
        "affine", "zero_skew" (the paper's), "square", "common_zoom"; with "+distance" (one 1/distance) or "+distances"
        (one a camera), and "+radial".  "near_affine" is "zero_skew+distance".
    weighting:
        "likelihood": Gaussian noise, inverse variances, exact projection.  "paper": Eq. (3) as printed, with weights
        1/sigma and a reprojection term of unit weight (its result depends on the unit of length).
    sigma_u_px, sigma_x_mm:
        Noise of a pixel coordinate and of a robot coordinate; None = estimated from the data.
    covariance_px2:
        The detector's own covariance in place of sigma_u: a number, (2, 2), (m, m), (n, m, m) or a list of one
        (n, 2, 2) a camera.
    ransac_px:
        Largest reprojection distance of an inlier in any image; None measures the noise and drops rows that Gaussian
        noise would not produce once in 10 000 data sets; infinity keeps all rows.
    seed:
        Of the random samples.
    image_size_px:
        (width, height); its centre is the principal point of near-affine models (else the middle of the detections is).
    checks:
        False skips the plausibility checks: units, repeated rows, swapped cameras.

    Raises
    ------
    ValueError
        For NaN rows, fewer than four points, coplanar or collinear points, wrong units, repeated rows, detections that stand
        still or are the same in both images, swapped cameras, no consensus, an unknown model or weighting.
    """
    x, y = correspondences(x_mm, u)
    n, m = y.shape
    plan = Model.parse(model, m // 2)
    if weighting not in ("likelihood", "paper"):
        raise ValueError(f"weighting: expected 'likelihood' or 'paper', got {weighting!r}.")
    for name, value in (("sigma_u_px", sigma_u_px), ("sigma_x_mm", sigma_x_mm), ("ransac_px", ransac_px)):
        if value is not None and not value >= 0:
            raise ValueError(f"{name}: must not be negative, got {value}.")
    if sigma_u_px == 0:
        raise ValueError("sigma_u_px: must be positive; None estimates it.")
    if 2 * n * (m // 2) < len(plan.parameter_names):
        raise ValueError(f"x_mm: {n} points are too few for the {len(plan.parameter_names)} parameters of '{model}'.")
    noise = pixel_covariance(covariance_px2, n, m // 2)
    if weighting == "paper" and noise is not None and noise.ndim == 3:
        raise ValueError("weighting: the paper's energy has one sigma_u; give sigma_u_px, or weighting='likelihood'.")
    if checks:
        check_duplicates(x, y)
        check_units(x, y)
    assumed_x = ROBOT_ACCURACY_MM if sigma_x_mm is None else sigma_x_mm
    check_spread(x, y, assumed_x if checks else 0.0)
    check_images(y)
    automatic = ransac_px is None
    if ransac_px is not None and np.isinf(ransac_px):
        inliers = np.ones(n, dtype=bool)
    else:
        inliers = consensus(x, y, ransac_px, np.random.default_rng(seed), sigma_x_mm=sigma_x_mm)
    check_spread(x[inliers], y[inliers], assumed_x if checks else 0.0)
    centre = (np.asarray(image_size_px, dtype=float) - 1) / 2 if image_size_px is not None else None

    known = {"sigma_u_px": sigma_u_px, "sigma_x_mm": sigma_x_mm}
    for _ in range(4):
        minimum, levels, variances = _minimise(plan, x, y, inliers, noise, weighting, known, centre)
        if not automatic or plan.is_affine:
            break
        # A curved projection looked like outliers to the affine consensus: judge again by the model itself.
        new = _judge(minimum, x, y, noise, *levels)
        if (new == inliers).all() or new.sum() < inliers.sum():
            break
        inliers = new

    sigma_u, sigma_x = levels
    T = plan.selection
    parameter_covariance = _parameter_covariance(plan, minimum, noise, inliers, sigma_u, sigma_x, variances)
    G = minimum.state.matrix_jacobian() @ T
    cameras = minimum.state.cameras(plan)
    result = Calibration(
        cameras=cameras,
        rig=StereoRig(*cameras) if len(cameras) == 2 else None,
        inliers=inliers,
        cost=minimum.cost,
        covariance=G @ parameter_covariance @ G.T,
        parameter_covariance=parameter_covariance,
        parameter_names=plan.parameter_names,
        sigma_u_px=sigma_u,
        sigma_x_mm=sigma_x,
        residuals_px=_reprojection(minimum.state, x, y),
        model=model,
        weighting=weighting,
        x_mm=x,
        y_px=y,
        covariance_px2=noise,
        image_size_px=None if image_size_px is None else tuple(image_size_px),
        _model=plan,
        _fit=minimum,
    )
    if checks and len(cameras) == 2:
        spread = np.sqrt(np.linalg.eigvalsh(np.cov(x[inliers].T))[0])
        zoom = np.sqrt(np.abs(np.linalg.det(cameras[0].linear @ cameras[0].linear.T)) ** 0.5)
        check_order(result.rig.linear, np.hypot(sigma_u / zoom, sigma_x) / (spread * np.sqrt(inliers.sum() / 2)))
    return result


def _minimise(
    plan: Model,
    x: np.ndarray,
    y: np.ndarray,
    inliers: np.ndarray,
    noise: np.ndarray | None,
    weighting: str,
    known: dict[str, float | None],
    centre: np.ndarray | None,
) -> tuple[Fit, tuple[float, float], tuple[np.ndarray, float]]:
    """The minimum over the inliers, the noise levels (sigma_u, sigma_x), and the variances that weighed it."""
    x, y = (x, y) if inliers.all() else (x[inliers], y[inliers])
    m = y.shape[1]
    per_point = noise is not None and noise.ndim == 3
    sigma = noise[inliers] if per_point else None if noise is None else noise[None]
    moments = Moments.of(x, y)
    reference = moments.mean[m:]
    middles = np.tile(centre, (m // 2, 1)) if centre is not None else ((y.max(0) + y.min(0)) / 2).reshape(-1, 2)
    start = affine_minimum(moments, 1.0, 0.0)
    residuals, A, used = y - x @ start.matrix[:, :3].T - start.matrix[:, 3], start.matrix[:, :3], 4 * m
    levels, minimum = None, None
    for _ in range(3):
        before, levels = levels, _levels(residuals, A, used, sigma, known)
        if before is not None and np.allclose(before, levels, rtol=1e-3, atol=1e-12):
            levels = before
            break
        if weighting == "paper":
            variance_u, variance_x = paper_variances(*levels)
        else:
            variance_u, variance_x = levels[0] ** 2, levels[1] ** 2
        weigh = variance_u * np.eye(m)[None] if sigma is None or weighting == "paper" else sigma
        if len(weigh) == 1 and np.allclose(weigh[0], variance_u * np.eye(m), rtol=1e-12, atol=0):
            start = affine_minimum(moments, variance_u, variance_x)
        state = State.start(plan, start.matrix, reference, middles)
        if plan.is_affine and len(weigh) == 1:
            # Eight weighted rows have the moments of all n: the energy of an affine model is a function of them.
            rows, h = _compressed(moments, reference)
            packed = fit(plan, state, rows[:, m:], rows[:, :m], weigh, variance_x, h)
            minimum = _unpacked(packed, x - reference, y, weigh, variance_x)
        else:
            minimum = fit(plan, state if minimum is None else minimum.state, x - reference, y, weigh, variance_x)
        if known["sigma_x_mm"] is not None and (sigma is not None or known["sigma_u_px"] is not None):
            break
        residuals, A = minimum.residuals, minimum.state.A.reshape(m, 3)
        used = len(plan.parameter_names)
    return minimum, levels, (weigh, variance_x)


def _levels(
    residuals: np.ndarray, A: np.ndarray, parameters: int, sigma: np.ndarray | None, known: dict[str, float | None]
) -> tuple[float, float]:
    """(sigma_u, sigma_x): given, or estimated from the residuals; the detector's covariances replace sigma_u."""
    if sigma is None:
        return estimate_noise(residuals, A, parameters, **known)
    n, m = residuals.shape
    sigma_u = float(np.sqrt(np.trace(sigma, axis1=1, axis2=2).mean() / m))
    if known["sigma_x_mm"] is not None:
        return sigma_u, float(known["sigma_x_mm"])
    # Maximum likelihood of one variance v in S_i = Sigma_i + v A A^T, by Fisher scoring.
    B, v = A @ A.T, 0.0
    inflate = n / max(n - parameters / m, 1.0)
    for _ in range(50):
        W = np.linalg.inv(sigma + v * B)
        WB = W @ B
        white = np.einsum("nij,nj->ni", np.broadcast_to(W, (n, m, m)), residuals)
        score = inflate * np.einsum("ni,ij,nj->", white, B, white) - np.trace(WB, axis1=1, axis2=2).sum() * (n / len(W))
        information = np.einsum("nij,nji->", WB, WB) * (n / len(W))
        new = max(v + score / information, 0.0)
        if abs(new - v) <= 1e-9 * max(v, 1e-12):
            break
        v = new
    return sigma_u, float(np.sqrt(new))


def _compressed(moments: Moments, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows (m + 4, m + 3) and their weights h of the constant, with the moments of the whole data about `reference`."""
    values, vectors = np.linalg.eigh(moments.scatter / np.outer(*(2 * [np.sqrt(np.diag(moments.scatter))])))
    root = (vectors * np.sqrt(np.maximum(values, 0.0))).T * np.sqrt(np.diag(moments.scatter))
    mean = moments.mean.copy()
    mean[-3:] -= reference
    rows = np.vstack([root, np.sqrt(moments.weight) * mean])
    return rows, np.append(np.zeros(len(root)), np.sqrt(moments.weight))


def _unpacked(packed: Fit, centred: np.ndarray, y: np.ndarray, weigh: np.ndarray, variance_x: float) -> Fit:
    """The fit of the compressed rows, with residuals and corrected points of the real ones."""
    state = packed.state
    m = y.shape[1]
    A = state.A.reshape(m, 3)
    r = y - centred @ A.T - state.offset.ravel()
    white = r @ np.linalg.inv(weigh[0] + variance_x * A @ A.T)
    corrected = centred + variance_x * white @ A
    return Fit(state, 0.5 * float((r * white).sum()), r, corrected, packed.information, packed.converged)


def _parameter_covariance(
    plan: Model,
    minimum: Fit,
    noise: np.ndarray | None,
    inliers: np.ndarray,
    sigma_u: float,
    sigma_x: float,
    variances: tuple[np.ndarray, float],
) -> np.ndarray:
    """Inverse information; where the weights were not the noise's, the sandwich H^-1 G H^-1."""
    weigh, variance_x = variances
    m = weigh.shape[-1]
    if noise is None:
        true = sigma_u**2 * np.eye(m)[None]
    else:
        true = noise[None] if noise.ndim == 2 else noise[inliers]
    scale = 1.0 / np.sqrt(np.diag(minimum.information))
    inverse = np.linalg.inv(minimum.information * np.outer(scale, scale)) * np.outer(scale, scale)
    if np.allclose(weigh, true, rtol=1e-9, atol=0) and np.isclose(variance_x, sigma_x**2, rtol=1e-9, atol=0):
        return inverse
    J = minimum.state.evaluate(minimum.points)[2] @ plan.selection
    J_x = minimum.state.evaluate(minimum.points, derivatives=False)[1]
    outer = J_x @ np.swapaxes(J_x, 1, 2)
    W = np.linalg.inv(weigh + variance_x * outer)
    WJ = W @ J
    meat = np.einsum("nip,nij,njq->pq", WJ, true + sigma_x**2 * outer, WJ)
    return inverse @ meat @ inverse


def _judge(
    minimum: Fit, x: np.ndarray, y: np.ndarray, noise: np.ndarray | None, sigma_u: float, sigma_x: float
) -> np.ndarray:
    """Rows within the gate of the fitted model."""
    f, J, _ = minimum.state.evaluate(x - minimum.state.reference, derivatives=False)
    sigma = sigma_u**2 * np.eye(y.shape[1])[None] if noise is None else noise if noise.ndim == 3 else noise[None]
    r = y - f
    distance2 = np.einsum("ni,nij,nj->n", r, np.linalg.inv(sigma + sigma_x**2 * J @ np.swapaxes(J, 1, 2)), r)
    return distance2 < gate(*y.shape)


def _reprojection(state: State, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return y - state.evaluate(x - state.reference, derivatives=False)[0]
