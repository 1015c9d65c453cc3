"""Registration in the images: maximum likelihood, for both cameras together or each camera alone.

Triangulation stretches pixel noise along the viewing direction, and Eq. (7) weighs that direction like the others.
Aligning the projections weighs every pixel by its own noise, and uses landmarks that only one camera sees.  With
S = motion^-1, moved cameras see u = project(S x).  A small rotation and shift of S x change u by J [-[S x]_x, I], where
J is the derivative of the projection.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from lib.cameras import AffineCamera, NearAffineCamera, StereoRig
from lib.correspondences import Correspondences
from lib.geometry import RigidTransform, align_rotation, pair_covariance
from lib.least_squares import minimise
from lib.registration.rigid import Registration, check_spread, motion_jacobian, register, sandwich

__all__ = ["MovedCameras", "identify_motion", "register_images"]

_FREEDOM = 4.0  # of the Student t that "robust" assumes: gross errors lose their weight, small ones keep it
_OPEN = 1e-12  # relative curvature below which a direction is not determined
Loss = Literal["squared", "robust"]


def register_images(
    rig: StereoRig,
    data: Correspondences | ArrayLike,
    u_left: ArrayLike | None = None,
    u_right: ArrayLike | None = None,
    *,
    covariance_px2: ArrayLike | None = None,
    sigma_x_mm: float = 0.0,
    loss: Loss = "squared",
) -> Registration:
    """The motion of a rig whose cameras moved together, by maximum likelihood in the images.

    Minimises sum r^T C^-1 r over the six parameters of the motion, r = u - rig.project(motion^-1 x) and
    C = covariance_px2 + sigma_x^2 A A^T, by damped Gauss-Newton steps from the solution of Eq. (7).

    Parameters
    ----------
    rig:
        Calibrated before the motion; affine or near-affine cameras.
    data:
        Correspondences after the motion; or x_mm (n, 3), the landmarks as the robot reports them now.
    u_left, u_right:
        (n, 2) px as detected now, beside x_mm.  NaN in one image: the other still counts.  NaN in x_mm: the row does not.
    covariance_px2:
        Of (u_left, u_right): a number, (2, 2), (4, 4) or (n, 4, 4).  None: that of the correspondences; without one,
        equal and unknown, estimated from the residuals.
    sigma_x_mm:
        Standard deviation of the robot's report, per coordinate.
    loss:
        "robust" assumes heavy tails (Student t with 4 degrees of freedom), so that gross detection errors lose
        their weight.

    Returns
    -------
    Registration
        `transform` is the motion: stale rig's frame to robot frame, as with ``register(triangulated, x_mm)``.

    Raises
    ------
    ValueError
        For shapes that do not pair up, or landmarks that leave the motion open.
    """
    return _register_both(rig, _Observed.of(rig, data, u_left, u_right, covariance_px2, sigma_x_mm), loss)


@dataclass(frozen=True, eq=False)
class MovedCameras:
    """Which cameras moved, and the rig as it is now.

    Attributes
    ----------
    rig:
        Projections as they are now.
    moved:
        "none", "together", "left", "right" or "apart".
    left, right:
        Motion of each camera (the same one for "together"), None for one that stayed.  An affine camera alone does not
        show the shift along its viewing direction: that is left at zero, and its variance here is zero.
    bic:
        Bayesian information criterion of each hypothesis; the smallest is chosen.
    """

    rig: StereoRig
    moved: str
    left: Registration | None
    right: Registration | None
    bic: dict[str, float]


def identify_motion(
    rig: StereoRig,
    data: Correspondences | ArrayLike,
    u_left: ArrayLike | None = None,
    u_right: ArrayLike | None = None,
    *,
    covariance_px2: ArrayLike | None = None,
    sigma_x_mm: float = 0.0,
    loss: Loss = "robust",
) -> MovedCameras:
    """Which cameras moved, and how: the hypothesis with the smallest Bayesian information criterion.

    The hypotheses are: neither camera moved (0 parameters), the left or the right alone (5), both together (6), each by
    its own motion (10).  If the cameras moved apart, triangulated points are no rigid copy of the true ones, so Eq. (7)
    has no exact solution; the images have.  A near-affine camera alone has 6 parameters.

    Arguments and errors are those of `register_images`.  The noise must be known, by `covariance_px2` or from the
    correspondences: it decides whether a hypothesis explains the data.
    """
    observed = _Observed.of(rig, data, u_left, u_right, covariance_px2, sigma_x_mm)
    if not observed.scale_known:
        raise ValueError("covariance_px2: give the noise of the detections; it decides which hypothesis explains them.")
    together = _register_both(rig, observed, loss)
    left, right = (_register_one(rig, observed, side, loss) for side in (0, 1))
    n_left, n_right = (_parameters(camera) for camera in (rig.left, rig.right))
    hypotheses = {
        "none": (None, None, 0),
        "together": (together, together, 6),
        "left": (left, None, n_left),
        "right": (None, right, n_right),
        "apart": (left, right, n_left + n_right),
    }
    stay = RigidTransform.identity()
    rigs, bic = {}, {}
    for name, (*motions, parameters) in hypotheses.items():
        rigs[name] = rig.moved(*(stay if motion is None else motion.transform for motion in motions))
        energy, _ = _evaluate(rigs[name], observed, stay, loss)
        bic[name] = 2 * energy + parameters * np.log(2 * observed.seen.sum())
    best = min(bic, key=bic.__getitem__)
    return MovedCameras(rigs[best], best, *hypotheses[best][:2], bic)


@dataclass(frozen=True)
class _Observed:
    """What the images show while the robot reports: x (n, 3) mm, y (n, 4) px, which of the two images count (n, 2)."""

    x: np.ndarray
    y: np.ndarray
    covariance: np.ndarray
    seen: np.ndarray
    scale_known: bool

    @classmethod
    def of(cls, rig, data, u_left, u_right, covariance_px2, sigma_x_mm) -> _Observed:
        data = data if isinstance(data, Correspondences) else Correspondences.of_points(data, u_left, u_right)
        if not sigma_x_mm >= 0:
            raise ValueError(f"sigma_x_mm: must not be negative, got {sigma_x_mm}.")
        seen = data.seen & np.isfinite(data.x_mm).all(axis=1, keepdims=True)
        check_spread(data.x_mm[seen.any(axis=1)], "x_mm (rows with a detection)")
        if covariance_px2 is None and np.isfinite(data.covariance_px2[seen]).all():
            covariance_px2 = np.where(np.isfinite(data.covariance_px2), data.covariance_px2, np.eye(2))
        covariance = pair_covariance(covariance_px2, len(data)) + sigma_x_mm**2 * rig.linear @ rig.linear.T
        # Rows and images that do not count get no information; what stands in them must only be finite.
        x = np.where(seen.any(axis=1, keepdims=True), data.x_mm, data.x_mm[seen.any(axis=1)].mean(axis=0))
        y = np.where(np.repeat(seen, 2, axis=1), np.hstack([data.u_left, data.u_right]), 0.0)
        return cls(x, y, covariance, seen, covariance_px2 is not None)

    @cached_property
    def information(self) -> np.ndarray:
        """(n, 4, 4): where one image counts, the inverse of that image's own covariance."""
        known = np.repeat(self.seen, 2, axis=1)
        mask = known[:, :, None] & known[:, None, :]
        return np.linalg.inv(np.where(mask, self.covariance, np.eye(4))) * mask

    @cached_property
    def dimension(self) -> np.ndarray:
        """(n,) pixel coordinates that count, 0, 2 or 4."""
        return 2 * self.seen.sum(axis=1)


def _register_both(rig: StereoRig, data: _Observed, loss: Loss) -> Registration:
    points = rig.triangulate(data.y[:, :2], data.y[:, 2:])
    both = data.seen.all(axis=1) & np.isfinite(points.x_mm).all(axis=1)
    # No motion of the whole rig breaks the epipolar constraint, but wrong detections do.
    distance = np.abs(points.epipolar_px)
    gated = both & (distance <= (3.5 * 1.4826 * np.median(distance[both]) if both.any() else 0.0))
    starts = [RigidTransform.identity()]
    for rows, kind in ((both, "squared"), (gated, "norm"))[: 1 if loss == "squared" else 2]:
        if rows.sum() >= 3 and np.linalg.matrix_rank(data.x[rows] - data.x[rows].mean(axis=0), tol=1e-6) >= 2:
            starts.append(register(points.x_mm[rows], data.x[rows], loss=kind).transform)
    return _fit(rig, data, starts, loss, 6)


def _register_one(rig: StereoRig, data: _Observed, side: int, loss: Loss) -> Registration:
    camera, here = (rig.left, rig.right)[side], data.seen[:, side]
    check_spread(data.x[here], f"x_mm (rows seen by the {('left', 'right')[side]} camera)")
    # A motion from free least-squares camera rows: the nearest rotation, then the shift in the image plane.
    x, y, back = data.x[here], data.y[here, 2 * side : 2 * side + 2], np.linalg.pinv(camera.linear)
    centre_x, centre_y = x.mean(axis=0), y.mean(axis=0)
    free = np.linalg.lstsq(x - centre_x, y - centre_y, rcond=1e-3)[0].T
    normal = np.cross(*free)
    normal /= max(float(np.linalg.norm(normal)), 1e-12)
    S = align_rotation(back @ free + np.outer(camera.viewing_direction, normal))
    shift = back @ (centre_y - camera.offset_px - camera.linear @ S @ centre_x)
    starts = [RigidTransform.identity(), RigidTransform(S, shift).inverse()]
    return _fit(rig, replace(data, seen=data.seen & (np.arange(2) == side)), starts, loss, _parameters(camera))


def _parameters(camera: AffineCamera | NearAffineCamera) -> int:
    """Parameters of a motion that one camera shows: an affine one sees no shift along its own axis."""
    return 6 if getattr(camera, "inverse_distance_per_mm", 0.0) else 5


def _evaluate(
    rig: StereoRig, data: _Observed, stale: RigidTransform, loss: Loss, scale2: float = 1.0
) -> tuple[float, tuple[np.ndarray, np.ndarray]]:
    """Negative log likelihood but for a constant; residuals (n, 4) and chi-squares (n,) of the rows."""
    try:
        residual = data.y - np.hstack(rig.project(stale.apply(data.x)))
    except ValueError:  # the landmarks would lie behind a near-affine camera
        return np.inf, (np.empty(0), np.empty(0))
    distance2 = np.einsum("ni,nij,nj->n", residual, data.information, residual) / scale2
    cost = distance2 if loss == "squared" else (_FREEDOM + data.dimension) * np.log1p(distance2 / _FREEDOM)
    return 0.5 * float(cost.sum()), (residual, distance2)


def _fit(rig: StereoRig, data: _Observed, starts: list[RigidTransform], loss: Loss, parameters: int) -> Registration:
    """The minimum near the best start; an unknown noise level is estimated in turn with the motion."""
    if loss not in ("squared", "robust"):
        raise ValueError(f"loss: 'squared' or 'robust', got {loss!r}.")
    stale = min((start.inverse() for start in starts), key=lambda stale: _evaluate(rig, data, stale, loss)[0])
    # Rotations are about the centre of the data in the stale frame, where they do not mix with translations.
    centre, dimension = stale.apply(data.x[data.dimension > 0]).mean(axis=0), data.dimension

    def gradients(stale: RigidTransform, work: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, ...]:
        """Information (6, 6); of each row gradient (n, 6) and weight (n,)."""
        residual, distance2 = work
        weights = np.ones(len(data.x)) if loss == "squared" else (_FREEDOM + dimension) / (_FREEDOM + distance2)
        x = stale.apply(data.x)
        J = rig.jacobian(x) @ motion_jacobian(x - centre)
        JtW = np.swapaxes(J, 1, 2) @ (data.information * (weights / scale2)[:, None, None])
        return (JtW @ J).sum(axis=0), np.einsum("nij,nj->ni", JtW, residual), weights

    def normal_equations(stale: RigidTransform, work: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        information, gradient, _ = gradients(stale, work)
        return information, gradient.sum(axis=0)

    def move(stale: RigidTransform, step: np.ndarray) -> RigidTransform:
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        return RigidTransform(turn @ stale.R, turn @ (stale.t - centre) + centre + step[3:])

    scale2 = 1.0
    for _ in range(1 if data.scale_known else 20):
        if not data.scale_known:
            _, (_, distance2) = _evaluate(rig, data, stale, loss)
            # The median of chi^2 with 2 and 4 degrees of freedom is 1.386 and 3.357.
            median = np.median((distance2 / np.where(dimension > 2, 3.357, 1.386))[dimension > 0])
            mean = distance2.sum() / max(dimension.sum() - parameters, 1)
            before, scale2 = scale2, max(float(mean if loss == "squared" else median), 1e-18)
            if abs(scale2 - before) <= 1e-6 * before:
                break
        evaluate = partial(_evaluate, rig, data, loss=loss, scale2=scale2)
        stale = minimise(stale, evaluate, normal_equations, move, rank=parameters).state
    energy, work = _evaluate(rig, data, stale, loss, scale2)
    information, gradient, weights = gradients(stale, work)
    if np.linalg.matrix_rank(information, tol=_OPEN * np.trace(information), hermitian=True) < parameters:
        raise ValueError("x_mm, u_left, u_right: these landmarks leave the motion open. Add frames in other positions.")
    covariance = np.linalg.pinv(information, rcond=_OPEN, hermitian=True)
    if loss == "robust":
        # The weights fall with the residual, which bends the loss less than the weights alone say.  Where nothing fits,
        # the sum may curve the wrong way: then the weights alone.
        flatter = information - gradient.T @ (gradient * (2.0 / (_FREEDOM + dimension))[:, None])
        bent = np.linalg.eigvalsh(flatter)[-parameters] <= _OPEN * np.trace(information)
        covariance = sandwich(information if bent else flatter, gradient[dimension > 0], parameters)
    motion = stale.inverse()
    turn = np.kron(np.eye(2), motion.R)
    distance, weights = np.where(dimension > 0, (np.sqrt(work[1] * scale2), weights), [[np.nan], [0.0]])
    return Registration(motion, turn @ covariance @ turn.T, motion.apply(centre), distance, weights, 2 * energy)
