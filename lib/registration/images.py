"""Registration in the images: maximum likelihood, for both cameras together or each camera alone.

Triangulation amplifies pixel noise along the viewing direction, but Eq. (7) weights all directions equally.  In the images
every pixel is weighted by its own noise, and landmarks that only one camera sees are used, too.  With S = motion^-1, moved
cameras see u = project(S x); a small rotation and shift of S x change u by J [-[S x]_x, I], J = du / dx.
"""

import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from lib.cameras import StereoRig
from lib.correspondences import Correspondences
from lib.geometry import RigidTransform, pair_covariance, precision, view_distances2
from lib.least_squares import minimise
from lib.registration.rigid import Registration, check_spread, motion_jacobian, register, sandwich

_FREEDOM = 4.0  # degrees of freedom of Student's t for "robust": gross errors lose their weight, small ones keep it
_STATED_ROWS = 20  # number of rows that the stated noise counts for, against the residuals' scatter, in the covariance
_OUTLIER = 16.0  # chi-square of the two coordinates in an image above which it is an outlier (1 in 3,000 by chance)
_UNSURE_RAD = np.deg2rad(5.0)  # standard deviation of a rotation above which `register_images` warns
_UNDETERMINED = 1e-12  # relative curvature below which a direction is not determined
Loss = Literal["squared", "robust"]


def register_images(
    rig: StereoRig, data: Correspondences | ArrayLike, u_left: ArrayLike | None = None, u_right: ArrayLike | None = None, *,
    covariance_px2: ArrayLike | None = None, sigma_x_mm: float = 0.0, loss: Loss = "squared",
    variations: Sequence[tuple[StereoRig, Correspondences]] = (),
) -> Registration:  # fmt: skip
    """The motion of a rig whose cameras moved together; it maps points of the old rig to the robot frame.

    Minimises sum r^T C^-1 r, with r = u - rig.project(motion^-1 x) and C = covariance_px2 + sigma_x^2 A A^T.

    Args:
        rig: Calibrated before the motion; affine or near-affine cameras.
        data, u_left, u_right: Correspondences after the motion; or the landmarks (n, 3) mm as the robot reports them now,
            and their detections (n, 2) px.  If one image misses a landmark, the other is still used.
        covariance_px2: Covariance of (u_left, u_right): a number, (2, 2), (4, 4) or (n, 4, 4).  None: that of the
            correspondences; if they have none, the noise is equal in all pixels and estimated from the residuals.
        sigma_x_mm: Standard deviation of the robot's report, per coordinate.
        loss: "robust" assumes heavy tails (Student t with 4 degrees of freedom), so that gross errors lose their weight.
        variations: The calibration's uncertainty: other rigs, each with the correspondences after its own `with_offsets`
            (`Calibration.variations`).  Without them, the covariance is due to the errors of these detections alone.

    A ValueError refuses arrays of different lengths, and landmarks that do not determine the motion.  A warning says that
    a rotation is uncertain by more than 5 degrees (standard deviation), as in a single frame with shut jaws: then it may be
    wrong by far more than its covariance states.

    >>> from lib.cameras import AffineCamera
    >>> rig = StereoRig(*(AffineCamera([[99, 0, z, 900], [0, 99, 0, 500]]) for z in (9, -9)))
    >>> x = np.array([[0.0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, 1]])
    >>> register_images(rig, x + [0.2, 0.1, 0.5], *rig.project(x)).transform.t.round(6).tolist()
    [0.2, 0.1, 0.5]
    """
    observed = _Observed.of(rig, data, u_left, u_right, covariance_px2, sigma_x_mm)
    found = _register_both(rig, replace(observed, variations=variations), loss)
    sd_rad = np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3])[-1])
    if sd_rad > _UNSURE_RAD:
        what = f"the rotation about an axis has a standard deviation of {np.rad2deg(sd_rad):.0f} degrees, so it may be wrong"
        warnings.warn(f"x_mm: {what}; use more frames, or frames with open jaws.", stacklevel=2)
    return found


@dataclass(frozen=True, eq=False)
class MovedCameras:
    """The cameras that moved, and the current rig.

    `moved` is "none", "shifted" (together, without turning), "together", "left", "right" or "apart".  `left` and `right` are
    the motions of the cameras, None for one that stayed.  An affine camera alone does not show the shift along its viewing
    direction; the estimate of that is zero, and so is its variance.  `bic` is the information criterion of each hypothesis.
    """

    rig: StereoRig
    moved: str
    left: Registration | None
    right: Registration | None
    bic: dict[str, float]


def identify_motion(
    rig: StereoRig, data: Correspondences | ArrayLike, u_left: ArrayLike | None = None, u_right: ArrayLike | None = None, *,
    covariance_px2: ArrayLike | None = None, sigma_x_mm: float = 0.0,
) -> MovedCameras:  # fmt: skip
    """Finds which cameras moved, and how: the hypothesis with the smallest Bayesian information criterion.

    The hypotheses are: neither camera moved (0 parameters), only the left or only the right one (5; 6 if it is near-affine),
    both together (6, or 3 if they only shifted), each by its own motion.  If each has its own, triangulated points are no
    rigid copy of the true ones, so Eq. (7) has no exact solution, but registration in the images has one.

    Arguments and errors are those of `register_images`, and the loss is robust.  The noise must be known, from
    `covariance_px2` or from the correspondences, since it decides whether a hypothesis explains the data.
    """
    observed = _Observed.of(rig, data, u_left, u_right, covariance_px2, sigma_x_mm)
    if not observed.scale_known:
        raise ValueError("covariance_px2: give the noise of the detections; it decides which hypothesis explains them.")
    together = _register_both(rig, observed, "robust")
    shifted = _fit(rig, observed, [RigidTransform.identity()], "robust", 3)
    stay, rigs, bic = RigidTransform.identity(), {}, {}
    apart, alone, parameters = [], [], []  # for the left and the right camera
    for side, (name, camera) in enumerate((("left", rig.left), ("right", rig.right))):
        check_spread(observed.x[observed.seen[:, side]], f"x_mm (rows seen by the {name} camera)")
        image = replace(observed, seen=observed.seen & (np.arange(2) == side))
        parameters.append(6 if getattr(camera, "inverse_distance_per_mm", 0.0) else 5)  # affine: no shift along its axis
        squared = _fit(rig, image, [stay], "squared", parameters[side])
        apart.append(_fit(rig, image, [squared.transform], "robust", parameters[side]))
        # If the other camera stayed, its image helps: the robot's errors are the same in both images.
        both = replace(observed, moves=(side == 0, side == 1))
        alone.append(_fit(rig, both, [apart[side].transform], "robust", parameters[side]))
    hypotheses = {
        "none": (None, None, 0), "shifted": (shifted, shifted, 3), "together": (together, together, 6),
        "left": (alone[0], None, parameters[0]), "right": (None, alone[1], parameters[1]),
        "apart": (*apart, sum(parameters)),
    }  # fmt: skip
    for name, (*motions, free) in hypotheses.items():
        rigs[name] = rig.moved(*(stay if motion is None else motion.transform for motion in motions))
        bic[name] = 2 * _evaluate(rigs[name], observed, "robust", stay)[0] + free * np.log(2 * observed.seen.sum())
    best = min(bic, key=bic.__getitem__)
    return MovedCameras(rigs[best], best, *hypotheses[best][:2], bic)


@dataclass(frozen=True)
class _Observed:
    """Reported positions x (n, 3) mm, pixels y (n, 4), their covariance (n or 1, 4, 4), and the images to use (n, 2) bool.

    `moves`: True for the left and for the right camera if it has the unknown motion.  `variations`: other rigs and rows.
    """

    x: np.ndarray
    y: np.ndarray
    covariance: np.ndarray
    seen: np.ndarray
    scale_known: bool
    moves: tuple[bool, bool] = (True, True)
    variations: Sequence[tuple[StereoRig, Correspondences]] = ()

    @classmethod
    def of(cls, rig, data, u_left, u_right, covariance_px2, sigma_x_mm) -> Self:
        data = data if isinstance(data, Correspondences) else Correspondences.of_points(data, u_left, u_right)
        if not 0 <= sigma_x_mm < np.inf:
            raise ValueError(f"sigma_x_mm: must be finite and not negative, got {sigma_x_mm}.")
        seen = data.seen & np.isfinite(data.x_mm).all(axis=1, keepdims=True)
        check_spread(data.x_mm[seen.any(axis=1)], "x_mm (rows with a detection)")
        if covariance_px2 is None and np.isfinite(data.covariance_px2[seen]).all():
            covariance_px2 = np.where(np.isfinite(data.covariance_px2), data.covariance_px2, np.eye(2))
        covariance = pair_covariance(covariance_px2, len(data)) + sigma_x_mm**2 * rig.linear @ rig.linear.T
        used = np.repeat(seen, 2, axis=1)
        if not np.isfinite(np.where(used[:, :, None] & used[:, None], covariance, 0.0)).all():
            raise ValueError("covariance_px2: must be finite where an image shows a landmark; drop rows of unknown noise.")
        # Rows and images that are not used get no information; their values only have to be finite.
        x = np.where(seen.any(axis=1, keepdims=True), data.x_mm, data.x_mm[seen.any(axis=1)].mean(axis=0))
        return cls(x, np.nan_to_num(data.stacked_px), covariance, seen, covariance_px2 is not None)

    @cached_property
    def information(self) -> np.ndarray:
        """(n, 4, 4) inverse covariances; if only one image is used, the inverse of that image's own covariance."""
        return np.broadcast_to(precision(self.covariance, self.seen), (len(self.x), 4, 4))

    @cached_property
    def dimension(self) -> np.ndarray:
        """(n,) number of pixel coordinates that are used: 0, 2 or 4."""
        return 2 * self.seen.sum(axis=1)


def _register_both(rig: StereoRig, data: _Observed, loss: Loss) -> Registration:
    points = rig.triangulate(data.y[:, :2], data.y[:, 2:])
    both = data.seen.all(axis=1) & np.isfinite(points.x_mm).all(axis=1)
    starts = [RigidTransform.identity()]
    for kind in ("squared",) if loss == "squared" else ("squared", "norm"):
        with suppress(ValueError):  # too few landmarks in both images, or all on a line
            starts.append(register(points.x_mm[both], data.x[both], loss=kind).transform)
    found = _fit(rig, data, starts, loss, 6)
    if loss == "squared" or not data.scale_known:
        return found
    for _ in range(3):  # drop outliers in each image separately
        residual = data.y - np.hstack(rig.project(found.transform.inverse().apply(data.x)))
        seen = data.seen & (view_distances2(residual, data.covariance) < _OUTLIER)
        if 2 * seen.sum() < data.seen.sum():  # then the cameras did not move together
            return found
        with suppress(ValueError):  # the remaining rows do not determine the motion
            found = _fit(rig, replace(data, seen=seen), [found.transform], loss, 6)
    energy, (_, distance2, weights) = _evaluate(rig, data, loss, found.transform.inverse())
    distance, weights = np.where(data.dimension > 0, (np.sqrt(distance2), weights), [[np.nan], [0.0]])
    return replace(found, residuals=distance, weights=weights, cost=2 * energy)


def _evaluate(rig: StereoRig, data: _Observed, loss: Loss, stale: RigidTransform) -> tuple[float, tuple[np.ndarray, ...]]:
    """Negative log likelihood up to a constant; residuals (n, 4), chi-squares (n,) and weights (n,) of the rows."""
    try:
        moved, pair = stale.apply(data.x), zip((rig.left, rig.right), data.moves, strict=True)
        residual = data.y - np.hstack([camera.project(moved if moves else data.x) for camera, moves in pair])
    except ValueError:  # the landmarks would lie behind a near-affine camera
        return np.inf, ()
    distance2 = np.einsum("ni,nij,nj->n", residual, data.information, residual)
    cost, weights = distance2, np.ones(len(distance2))
    if loss == "robust":
        cost = (_FREEDOM + data.dimension) * np.log1p(distance2 / _FREEDOM)
        weights = (_FREEDOM + data.dimension) / (_FREEDOM + distance2)
    return 0.5 * float(cost.sum()), (residual, distance2, weights)


def _fit(rig: StereoRig, data: _Observed, starts: list[RigidTransform], loss: Loss, parameters: int) -> Registration:
    """The minimum near the best start, of 6, 5 or 3 parameters (3: no rotation); also estimates an unknown noise level."""
    if loss not in ("squared", "robust"):
        raise ValueError(f"loss: 'squared' or 'robust', got {loss!r}.")
    stale = min((start.inverse() for start in starts), key=lambda stale: _evaluate(rig, data, loss, stale)[0])
    if np.isinf(_evaluate(rig, data, loss, stale)[0]):
        raise ValueError("x_mm: landmarks lie behind the rig's cameras. Did these move that far? Then calibrate again.")
    found = _minimum(rig, data, stale, loss, parameters)
    for _ in range(0 if data.scale_known else 1 if loss == "squared" else 5):
        distance2, dimension = found.residuals[data.dimension > 0] ** 2, data.dimension[data.dimension > 0]
        mean = distance2.sum() / max(dimension.sum() - parameters, 1)
        # The median of chi^2 with 2 and 4 degrees of freedom is 1.386 and 3.357.
        scale2 = mean if loss == "squared" else np.median(distance2 / np.where(dimension > 2, 3.357, 1.386))
        data = replace(data, covariance=data.covariance * max(float(scale2), 1e-18))
        found = _minimum(rig, data, found.transform.inverse(), loss, parameters)
    return found


def _minimum(rig: StereoRig, data: _Observed, stale: RigidTransform, loss: Loss, parameters: int) -> Registration:
    # Rotations are about the centre of the data in the old rig's frame, which decorrelates them from translations.
    used, centre = data.dimension > 0, stale.apply(data.x[data.dimension > 0]).mean(axis=0)
    free = np.repeat([parameters > 3, True], 3)

    def gradients(stale: RigidTransform, work: tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Information (n, 6, 6) and gradient (n, 6) of each row."""
        x, (residual, _, weights) = stale.apply(data.x), work
        J = rig.jacobian(x) @ (motion_jacobian(x - centre) * free) * np.repeat(data.moves, 2)[:, None]
        JtW = np.swapaxes(J, 1, 2) @ (data.information * weights[:, None, None])
        return JtW @ J, np.einsum("nij,nj->ni", JtW, residual)

    def normal_equations(*at) -> tuple[np.ndarray, np.ndarray]:
        return tuple(rows.sum(axis=0) for rows in gradients(*at))

    def move(stale: RigidTransform, step: np.ndarray) -> RigidTransform:
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        return RigidTransform(turn @ stale.R, turn @ (stale.t - centre) + centre + step[3:])

    found = minimise(stale, partial(_evaluate, rig, data, loss), normal_equations, move, rank=parameters, tolerance=1e-11)
    information, (residual, distance2, weights) = found.information, found.work
    if np.linalg.matrix_rank(information, tol=_UNDETERMINED * np.trace(information), hermitian=True) < parameters:
        cure = "Add frames in other positions." if data.seen.any(axis=0).all() else "Both cameras must see the tool."
        raise ValueError(f"x_mm, u_left, u_right: these landmarks do not determine the motion. {cure}")
    # A row tells at most what its noise allows, but the robust weights of small residuals exceed 1.
    rows, gradient = gradients(found.state, found.work)
    stated = (rows / np.maximum(weights, 1.0)[:, None, None]).sum(axis=0)
    covariance = np.linalg.pinv(stated, rcond=_UNDETERMINED, hermitian=True)
    n, size = used.sum(), data.dimension.sum()
    own = covariance * distance2.sum() / max(size - parameters, 1)
    if loss == "robust":
        # The weights fall as a residual grows, so the Hessian is smaller than the weighted information.  If nothing fits,
        # the Hessian may be indefinite; then use the information.
        hessian = information - gradient.T @ (gradient * (2.0 / (_FREEDOM + data.dimension))[:, None])
        indefinite = np.linalg.eigvalsh(hessian)[-parameters] <= _UNDETERMINED * np.trace(information)
        own = sandwich(information if indefinite else hessian, gradient[used], parameters * n / size)
    covariance = (_STATED_ROWS * covariance + n * own) / (_STATED_ROWS + n)
    for other, own in data.variations:  # the step that another rig, with its offsets, would cause
        x = np.where(data.seen.any(axis=1, keepdims=True) & np.isfinite(own.x_mm), own.x_mm, data.x)
        change = np.nan_to_num(own.stacked_px) - np.hstack(other.project(found.state.apply(x))) - residual
        step = np.linalg.lstsq(information, gradients(found.state, (change, distance2, weights))[1].sum(axis=0))[0]
        covariance = covariance + np.outer(step, step)
    motion = found.state.inverse()
    turn = np.kron(np.eye(2), motion.R)
    distance, weights = np.where(used, (np.sqrt(distance2), weights), [[np.nan], [0.0]])
    return Registration(motion, turn @ covariance @ turn.T, motion.apply(centre), distance, weights, 2 * found.energy)
