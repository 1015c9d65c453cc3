"""Registration in the images: maximum likelihood, for both cameras together or each for itself.

Triangulation stretches pixel noise along the viewing direction, and Eq. (7) weighs that direction like the others.
Aligning projections instead weighs every pixel as what it is (and uses landmarks that only one camera sees).  A moved
rig sees u = A (S x) + t with S = motion^-1, so the residual is linear in S x and its Jacobian is A [-[S x]_x, I].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from lib.cameras import AffineCamera, StereoRig
from lib.geometry import RigidTransform, finite_points, points
from lib.registration.rigid import Registration, check_spread, motion_jacobian, register

__all__ = ["MovedCameras", "identify_motion", "perturb", "register_cameras", "register_images", "stack_covariance"]

_FREEDOM = 4.0  # of the Student t that "robust" supposes: gross errors lose their weight, small ones keep it
_ITERATIONS = 100
_OPEN = 1e-12  # curvature, relative to the largest, below which a direction is not determined
Loss = Literal["squared", "robust"]


def perturb(rig: StereoRig, motion: RigidTransform, right: RigidTransform | None = None) -> StereoRig:
    """The rig after its cameras moved by `motion` (robot frame); the paper's experiment in Sec. V.

    Parameters
    ----------
    motion:
        Of both cameras, or of the left one if `right` is given.
    """
    return StereoRig(_moved(rig.left, motion), _moved(rig.right, motion if right is None else right))


def _moved(camera: AffineCamera, motion: RigidTransform) -> AffineCamera:
    stale_from_robot = motion.inverse()
    offset = camera.linear @ stale_from_robot.t + camera.offset_px
    return AffineCamera(np.column_stack([camera.linear @ stale_from_robot.R, offset]))


def stack_covariance(covariance_px2: ArrayLike | None, n: int) -> np.ndarray:
    """Covariance of (u_left, u_right) as (n, 4, 4), from a number, (2, 2), (4, 4), (n, 4, 4) or None (1 px^2)."""
    covariance = np.asarray(1.0 if covariance_px2 is None else covariance_px2, dtype=np.float64)
    if covariance.ndim == 0:
        covariance = covariance * np.eye(4)
    elif covariance.shape == (2, 2):
        covariance = np.kron(np.eye(2), covariance)
    if covariance.shape not in {(4, 4), (n, 4, 4)}:
        raise ValueError(f"covariance_px2: expected a number, (2, 2), (4, 4) or ({n}, 4, 4), got {covariance.shape}.")
    return np.broadcast_to(covariance, (n, 4, 4))


def register_images(
    rig: StereoRig,
    x_mm: ArrayLike,
    u_left: ArrayLike,
    u_right: ArrayLike,
    *,
    covariance_px2: ArrayLike | None = None,
    sigma_x_mm: float = 0.0,
    loss: Loss = "squared",
) -> Registration:
    """The motion of a rig whose cameras moved together, by maximum likelihood in the images.

    Minimises sum r^T C^-1 r over the six parameters of the motion, r = u - rig.project(motion^-1 x) and
    C = covariance_px2 + sigma_x^2 A A^T, by Gauss-Newton from the solution of Eq. (7).

    Parameters
    ----------
    rig:
        Calibrated before the motion.
    x_mm:
        (n, 3) landmarks as the robot reports them now.
    u_left, u_right:
        (n, 2) px as detected now.  NaN in one image: the other still counts.
    covariance_px2:
        Of (u_left, u_right): a number, (2, 2), (4, 4) or (n, 4, 4).  None: equal and unknown, estimated from the
        residuals.
    sigma_x_mm:
        Standard deviation of the robot's report, per coordinate.
    loss:
        "robust" supposes heavy tails (Student t with 4 degrees of freedom), so that gross detection errors lose
        their weight.

    Returns
    -------
    Registration
        `transform` is the motion: stale rig's frame to robot frame, as with ``register(triangulated, x_mm)``.

    Raises
    ------
    ValueError
        For shapes that do not pair up, NaN in x_mm, or landmarks that leave the motion open.
    """
    data = _Data.of(rig, x_mm, u_left, u_right, covariance_px2, sigma_x_mm)
    both = data.seen.all(axis=1)
    check_spread(data.x[data.seen.any(axis=1)], "x_mm (rows with a detection)")
    starts = [RigidTransform.identity()]
    for rows, kind in ((both, "squared"), (both, "norm"), (_on_epipolar_line(rig, data), "norm")):
        if rows.sum() >= 3 and np.linalg.matrix_rank(data.x[rows] - data.x[rows].mean(axis=0), tol=1e-6) >= 2:
            x_stale = (data.y[rows] - rig.offset_px) @ np.linalg.pinv(rig.linear).T
            starts.append(register(x_stale, data.x[rows], loss=kind).transform)
    return _best_fit(rig.linear, rig.offset_px, data, starts, loss)


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
        Motion of each camera (the same one for "together"), None for one that stayed.  The shift along its own viewing
        direction shows in no affine image: it is left at zero, and its variance here is zero.
    bic:
        Bayesian information criterion of each hypothesis (smaller is better); one entry where none was tested.
    """

    rig: StereoRig
    moved: str
    left: Registration | None
    right: Registration | None
    bic: dict[str, float]


def register_cameras(
    rig: StereoRig,
    x_mm: ArrayLike,
    u_left: ArrayLike,
    u_right: ArrayLike,
    *,
    covariance_px2: ArrayLike | None = None,
    sigma_x_mm: float = 0.0,
    loss: Loss = "squared",
) -> MovedCameras:
    """Each camera's own motion, five parameters apiece, where the two did not move together.

    Triangulated points are then no rigid copy of the true ones, so Eq. (7) has no exact solution; the images have.
    Arguments and errors as in `register_images`.
    """
    data = _Data.of(rig, x_mm, u_left, u_right, covariance_px2, sigma_x_mm)
    left, right = (_fit_one(rig, data, side, loss) for side in (0, 1))
    return MovedCameras(perturb(rig, left.transform, right.transform), "apart", left, right, {"apart": np.nan})


def identify_motion(
    rig: StereoRig,
    x_mm: ArrayLike,
    u_left: ArrayLike,
    u_right: ArrayLike,
    *,
    covariance_px2: ArrayLike,
    sigma_x_mm: float = 0.0,
    loss: Loss = "robust",
) -> MovedCameras:
    """Which cameras moved, and how: the hypothesis with the least Bayesian information criterion.

    None (0 parameters), the left or the right alone (5), both together (6), both apart (10).  The covariance must be
    given: by it a hypothesis explains the data or does not.  Arguments and errors as in `register_images`.
    """
    options = {"covariance_px2": covariance_px2, "sigma_x_mm": sigma_x_mm, "loss": loss}
    data = _Data.of(rig, x_mm, u_left, u_right, covariance_px2, sigma_x_mm)
    together = register_images(rig, x_mm, u_left, u_right, **options)
    apart = register_cameras(rig, x_mm, u_left, u_right, **options)
    left, right = apart.left, apart.right
    candidates = {
        "none": (rig, None, None, 0),
        "together": (perturb(rig, together.transform), together, together, 6),
        "left": (perturb(rig, left.transform, RigidTransform.identity()), left, None, 5),
        "right": (perturb(rig, RigidTransform.identity(), right.transform), None, right, 5),
        "apart": (apart.rig, left, right, 10),
    }
    log_n = np.log(max(int(data.seen.sum()) * 2, 1))
    bic = {
        name: _loss(
            _distance2(candidate.linear, candidate.offset_px, data, RigidTransform.identity()), data, loss
        ).sum()
        + freedom * log_n
        for name, (candidate, _, _, freedom) in candidates.items()
    }
    best = min(bic, key=bic.__getitem__)
    chosen, left, right, _ = candidates[best]
    return MovedCameras(chosen, best, left, right, bic)


@dataclass(frozen=True)
class _Data:
    """Stacked observations: y (n, 4), 0 where unseen, its information (n, 4, 4), seen (n, 2), scale known or not."""

    x: np.ndarray
    y: np.ndarray
    information: np.ndarray
    seen: np.ndarray
    scale_known: bool

    @classmethod
    def of(cls, rig, x_mm, u_left, u_right, covariance_px2, sigma_x_mm) -> _Data:
        x = finite_points(x_mm, 3, "x_mm")
        u_left, u_right = points(u_left, 2, "u_left"), points(u_right, 2, "u_right")
        if not len(x) == len(u_left) == len(u_right):
            raise ValueError(
                f"x_mm, u_left, u_right: {len(x)}, {len(u_left)} and {len(u_right)} rows; give one of each a landmark."
            )
        if sigma_x_mm < 0:
            raise ValueError(f"sigma_x_mm: must not be negative, got {sigma_x_mm}.")
        seen = np.stack([np.isfinite(u_left).all(axis=1), np.isfinite(u_right).all(axis=1)], axis=1)
        covariance = stack_covariance(covariance_px2, len(x)) + sigma_x_mm**2 * rig.linear @ rig.linear.T
        # An unseen image gets no information, and must not leak NaN (its covariance may be NaN too).
        known = np.repeat(seen, 2, axis=1)
        mask = known[:, :, None] & known[:, None, :]
        information = np.linalg.inv(np.where(mask, covariance, np.eye(4))) * mask
        y = np.where(known, np.hstack([u_left, u_right]), 0.0)
        return cls(x, y, information, seen, covariance_px2 is not None)

    def side(self, side: int) -> _Data:
        """What one camera says; its information is that of its own marginal covariance."""
        rows = slice(2 * side, 2 * side + 2)
        both = self.seen.all(axis=1)
        covariance = np.linalg.inv(np.where(both[:, None, None], self.information, np.eye(4)))[:, rows, rows]
        alone = self.information[:, rows, rows]
        information = np.where(both[:, None, None], np.linalg.inv(covariance), alone)
        return _Data(self.x, self.y[:, rows], information, self.seen[:, [side]], self.scale_known)


def _on_epipolar_line(rig: StereoRig, data: _Data) -> np.ndarray:
    """Mask (n,) of the pairs that keep to the epipolar constraint, which no motion of the whole rig breaks."""
    both = data.seen.all(axis=1)
    distance = np.abs((data.y - rig.offset_px) @ rig.epipolar_normal)
    gate = 3.5 * 1.4826 * np.median(distance[both]) if both.any() else 0.0
    return both & (distance <= gate)


def _fit_one(rig: StereoRig, data: _Data, side: int, loss: Loss) -> Registration:
    camera = (rig.left, rig.right)[side]
    data = data.side(side)
    seen = data.seen[:, 0]
    check_spread(data.x[seen], f"x_mm (rows seen by the {('left', 'right')[side]} camera)")
    starts = [RigidTransform.identity(), _affine_start(camera, data.x[seen], data.y[seen])]
    return _best_fit(camera.linear, camera.offset_px, data, starts, loss)


def _affine_start(camera: AffineCamera, x: np.ndarray, y: np.ndarray) -> RigidTransform:
    """A motion from free least-squares camera rows: the nearest rotation, then the shift in the image plane."""
    centre_x, centre_y = x.mean(axis=0), y.mean(axis=0)
    free = np.linalg.lstsq(x - centre_x, y - centre_y, rcond=1e-3)[0].T
    U, _, Vt = np.linalg.svd(np.linalg.pinv(camera.linear) @ free + np.outer(camera.viewing_direction, _normal(free)))
    S = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    shift = np.linalg.pinv(camera.linear) @ (centre_y - camera.offset_px - camera.linear @ S @ centre_x)
    return RigidTransform(S, shift).inverse()


def _normal(rows: np.ndarray) -> np.ndarray:
    normal = np.cross(rows[0], rows[1])
    return normal / max(float(np.linalg.norm(normal)), 1e-12)


def _distance2(A: np.ndarray, offset: np.ndarray, data: _Data, motion: RigidTransform) -> np.ndarray:
    residual = data.y - (motion.inverse().apply(data.x) @ A.T + offset)
    return np.einsum("ni,nij,nj->n", residual, data.information, residual)


def _loss(distance2: np.ndarray, data: _Data, loss: Loss) -> np.ndarray:
    """-2 log likelihood (n,) but for a constant."""
    if loss == "squared":
        return distance2
    dimension = 2 * data.seen.sum(axis=1)
    return (_FREEDOM + dimension) * np.log1p(distance2 / _FREEDOM)


def _best_fit(A: np.ndarray, offset: np.ndarray, data: _Data, starts: list[RigidTransform], loss: Loss) -> Registration:
    """From the two starts that explain the data best."""
    if loss not in ("squared", "robust"):
        raise ValueError(f"loss: 'squared' or 'robust', got {loss!r}.")
    starts = sorted(starts, key=lambda start: _loss(_distance2(A, offset, data, start), data, loss).sum())
    return min((_fit(A, offset, data, start, loss) for start in starts[:2]), key=lambda fit: fit.cost)


def _fit(A: np.ndarray, offset: np.ndarray, data: _Data, start: RigidTransform, loss: Loss) -> Registration:
    """Levenberg-Marquardt over the motion; A is (4, 3) of the pair or (2, 3) of one camera."""
    dimension = 2 * data.seen.sum(axis=1)
    freedom = 6 if len(A) == 4 else 5
    seen = dimension > 0
    # Rotations are about the centre of the data in the stale frame, where they do not mix with translations.
    stale = start.inverse()
    centre = stale.apply(data.x[seen]).mean(axis=0)
    scale2 = 1.0 if data.scale_known else _scale2(_distance2(A, offset, data, start), dimension, freedom, loss)

    def evaluate(stale: RigidTransform) -> tuple[np.ndarray, np.ndarray, float]:
        residual = data.y - (stale.apply(data.x) @ A.T + offset)
        distance2 = np.einsum("ni,nij,nj->n", residual, data.information, residual) / scale2
        return residual, distance2, float(_loss(distance2, data, loss).sum())

    jacobian = A @ motion_jacobian(stale.apply(data.x) - centre)
    _check_determined((np.swapaxes(jacobian, 1, 2) @ data.information @ jacobian).sum(axis=0), freedom)
    residual, distance2, cost = evaluate(stale)
    damping, iterations = 1e-6, 0
    while iterations < _ITERATIONS:
        iterations += 1
        weights = np.ones(len(data.x)) if loss == "squared" else (_FREEDOM + dimension) / (_FREEDOM + distance2)
        information = (weights / scale2)[:, None, None] * data.information
        jacobian = A @ motion_jacobian(stale.apply(data.x) - centre)
        JtW = np.swapaxes(jacobian, 1, 2) @ information
        hessian, gradient = (JtW @ jacobian).sum(axis=0), np.einsum("nij,nj->i", JtW, residual)
        inverse = _pseudo_inverse(hessian + damping * np.diag(np.diag(hessian)), freedom)
        step = inverse @ gradient
        trial = _step(stale, step, centre)
        residual_t, distance2_t, cost_t = evaluate(trial)
        if cost_t <= cost:
            stale, residual, distance2 = trial, residual_t, distance2_t
            small = np.abs(step).max() < 1e-12
            done, cost = small or cost - cost_t <= 1e-13 * max(cost, 1e-12), cost_t
            damping = max(damping / 10, 1e-12)
            if not data.scale_known and loss == "robust" and not small:
                scale2 = _scale2(distance2 * scale2, dimension, freedom, loss)
                residual, distance2, cost = evaluate(stale)
                done = small
            if done:
                break
        else:
            damping = damping * 10
            if damping > 1e6:
                break
    if not data.scale_known:
        scale2 = _scale2(distance2 * scale2, dimension, freedom, loss)
    motion = stale.inverse()
    covariance = _covariance(A, data, stale, centre, residual, weights, scale2, freedom, loss)
    turn = np.kron(np.eye(2), motion.R)
    mahalanobis = np.where(seen, np.sqrt(np.einsum("ni,nij,nj->n", residual, data.information, residual)), np.nan)
    return Registration(
        motion,
        turn @ covariance @ turn.T,
        motion.apply(centre),
        mahalanobis,
        np.where(seen, weights, 0.0),
        cost,
        iterations,
    )


def _step(stale: RigidTransform, step: np.ndarray, centre: np.ndarray) -> RigidTransform:
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    return RigidTransform(turn @ stale.R, turn @ (stale.t - centre) + centre + step[3:])


def _scale2(distance2: np.ndarray, dimension: np.ndarray, freedom: int, loss: Loss) -> float:
    """The unknown variance in px^2: of all residuals, or from their median where a few may be gross."""
    seen = dimension > 0
    if loss == "squared":
        scale2 = distance2.sum() / max(int(dimension.sum()) - freedom, 1)
    else:  # the median of chi^2 with 2 and 4 degrees of freedom is 1.386 and 3.357
        scale2 = float(np.median(distance2[seen] / np.where(dimension[seen] > 2, 3.357, 1.386)))
    return max(float(scale2), 1e-18)


def _pseudo_inverse(hessian: np.ndarray, rank: int) -> np.ndarray:
    """Inverse over the `rank` observable directions; one that the data hardly hold gets no infinite step."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    values, vectors = np.linalg.eigh(scale[:, None] * hessian * scale)
    values, vectors = values[-rank:], vectors[:, -rank:]
    values = np.maximum(values, _OPEN * values[-1])
    return scale[:, None] * ((vectors / values) @ vectors.T) * scale


def _check_determined(hessian: np.ndarray, rank: int) -> None:
    """Refuse landmarks that leave more open than the shift that an affine camera never sees.

    Raises
    ------
    ValueError
        Naming the arguments.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    values = np.linalg.eigvalsh(scale[:, None] * hessian * scale)
    if values[-rank] <= _OPEN * values[-1]:
        raise ValueError("x_mm, u_left, u_right: these landmarks leave the motion open. Add frames in other positions.")


def _covariance(A, data, stale, centre, residual, weights, scale2, freedom, loss) -> np.ndarray:
    """Of (omega, tau) in the stale frame: the inverse information, or for the robust loss the sandwich."""
    jacobian = A @ motion_jacobian(stale.apply(data.x) - centre)
    JtW = np.swapaxes(jacobian, 1, 2) @ (data.information * (weights / scale2)[:, None, None])
    hessian = (JtW @ jacobian).sum(axis=0)
    if loss == "squared":
        return _pseudo_inverse(hessian, freedom)
    gradient = np.einsum("nij,nj->ni", JtW, residual)
    # The weights fall with the residual, which bends the loss less than the weights alone say.
    flatter = hessian - gradient.T @ (gradient * (2.0 / (_FREEDOM + 2 * data.seen.sum(axis=1)))[:, None])
    # Where nothing fits, the sum may curve the wrong way: then the weights alone.
    bent = np.linalg.eigvalsh(flatter)[-freedom] <= _OPEN * np.linalg.eigvalsh(hessian)[-1]
    inverse = _pseudo_inverse(hessian if bent else flatter, freedom)
    n = int(data.seen.any(axis=1).sum())
    return inverse @ (gradient.T @ gradient) @ inverse * (n / max(n - freedom, 1))
