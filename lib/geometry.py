"""Rigid transforms, pixel grids, covariances of pixel pairs, and argument checks that several modules use.

Conventions: points are rows, (n, 3) millimetres or (n, 2) pixels (x right, y down, integer coordinates are
pixel centres); a transform is named ``target_from_source``; angles are radians.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation


def points(values: ArrayLike, dimension: int, name: str) -> np.ndarray:
    """`values`, (n, dimension) or a single point, as a float64 array (n, dimension); NaN is allowed.

    A ValueError refuses other shapes and names the argument `name`.
    """
    array = np.atleast_2d(np.asarray(values, dtype=np.float64))
    if array.ndim != 2 or array.shape[1] != dimension:
        raise ValueError(f"{name}: expected one point a row, (n, {dimension}), got {np.shape(values)}.")
    return array


def finite_points(values: ArrayLike, dimension: int, name: str) -> np.ndarray:
    """`points`, but a ValueError refuses NaN and infinity and states the number of such rows and the first one."""
    array = points(values, dimension, name)
    bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if bad.size:
        found = f"{bad.size} of {len(array)} rows are not finite (the first is row {bad[0]})"
        raise ValueError(f"{name}: {found}. Drop the rows of missing landmarks first.")
    return array


def store_array(instance: object, name: str, shape: tuple[int, ...]) -> None:
    """Make a frozen dataclass's attribute a read-only float64 array; a ValueError if it is not finite or not of `shape`."""
    array = np.array(getattr(instance, name), dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers of shape {shape}, got {array}.")
    array.setflags(write=False)
    object.__setattr__(instance, name, array)


def check(settings: object, names: str, holds: Callable[[object], bool], rule: str) -> None:
    """Raise a ValueError for the first of the attributes `names` (separated by spaces) whose value violates the rule.

    >>> from types import SimpleNamespace
    >>> check(SimpleNamespace(gloss=-1), "gloss", lambda value: value >= 0, "must not be negative")
    Traceback (most recent call last):
    ValueError: gloss: must not be negative, got -1.
    """
    for name in names.split():
        value = getattr(settings, name)
        if not holds(value):
            raise ValueError(f"{name}: {rule}, got {value}.")


def pair_covariance(covariance_px2: ArrayLike | None, n: int, images: int = 2) -> np.ndarray:
    """Covariance of the stacked pixels (u_left, u_right) of n matches: (1, 4, 4) if it is the same for all, else (n, 4, 4).

    Args:
        covariance_px2: A number (the variance of each coordinate), (2, 2) for each image, (4, 4) for the pair, (n, 4, 4)
            for each match, or (n, 2, 2, 2) for each match and image.  None is 1 px^2.  NaN is allowed, for landmarks that
            are not seen; a ValueError refuses matrices that are not positive definite.
        images: 2, or 1 for a single camera; then (2, 2) and (n, 2, 2) replace (4, 4) and (n, 4, 4).

    >>> pair_covariance(4.0, 10)[0].diagonal()
    array([4., 4., 4., 4.])
    """
    m = 2 * images
    given = np.asarray(1.0 if covariance_px2 is None else covariance_px2, dtype=np.float64)
    if given.ndim == 0:
        if not 0 < given < np.inf:
            raise ValueError(f"covariance_px2: a variance must be positive and finite, got {given}.")
        covariance = given * np.eye(m)[None]
    elif given.shape == (2, 2):
        covariance = np.kron(np.eye(images), given)[None]
    elif given.shape == (n, images, 2, 2):
        covariance = np.zeros((n, m, m))
        for i in range(images):
            covariance[:, 2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = given[:, i]
    elif given.shape in ((m, m), (n, m, m)):
        covariance = given.reshape(-1, m, m)
    else:
        forms = f"a number, (2, 2), ({m}, {m}), ({n}, {m}, {m}) or ({n}, {images}, 2, 2)"
        raise ValueError(f"covariance_px2: expected {forms}, got {given.shape}.")
    known = np.where(np.isfinite(covariance), covariance, np.eye(m))
    try:  # the factorisation reads only one triangle, so average both to check both
        np.linalg.cholesky((known + known.mT) / 2)
    except np.linalg.LinAlgError:
        raise ValueError("covariance_px2: every covariance must be positive definite.") from None
    return covariance


def precision(covariance: np.ndarray, views: np.ndarray) -> np.ndarray:
    """Inverses (1 or n, m, m) of the blocks of covariances (1 or n, m, m) for the `views` (n, m / 2) bool; zero elsewhere.

    It is the limit of the inverse as the covariance of the other views goes to infinity.
    """
    if views.all():
        return np.linalg.inv(covariance)
    row = slice(None)
    if len(covariance) == 1:  # rows with the same views have the same inverse
        _, first, row = np.unique(views @ [1, 2][: views.shape[1]], return_index=True, return_inverse=True)
        views = views[first]
    used = np.repeat(views, 2, axis=1)
    both = used[:, :, None] & used[:, None, :]
    return np.where(both, np.linalg.inv(np.where(both, covariance, np.eye(used.shape[1]))), 0.0)[row]


def view_distances2(residual: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Squared Mahalanobis distances (n, m / 2) of residuals (n, m), for each view by its block of covariances (n, m, m)."""
    r = residual.reshape(len(residual), residual.shape[1] // 2, 2, 1)
    own = np.stack([covariance[:, i : i + 2, i : i + 2] for i in range(0, residual.shape[1], 2)], axis=1)
    return (r.mT @ np.linalg.solve(own, r))[..., 0, 0]


def align_rotation(moment: ArrayLike) -> np.ndarray:
    """The rotation R (..., 3, 3) nearest to `moment`; it maximises trace(R^T moment).

    With moment = sum y x^T of two centred point sets it is the least-squares alignment y = R x (Kabsch, 1976; Umeyama, 1991).

    >>> R = RigidTransform.from_rotation_vector((0.1, -0.2, 0.3)).R
    >>> x = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    >>> bool(np.allclose(align_rotation((x @ R.T).T @ x), R))
    True
    """
    U, _, Vt = np.linalg.svd(np.asarray(moment, dtype=np.float64))
    U[..., :, 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    return U @ Vt


@dataclass(frozen=True, eq=False)
class RigidTransform:
    """x_target = R @ x_source + t, named ``target_from_source``: rotation R (3, 3) and translation t (3,) in mm."""

    R: np.ndarray
    t: np.ndarray

    def __post_init__(self) -> None:
        store_array(self, "R", (3, 3))
        store_array(self, "t", (3,))
        if np.abs(self.R @ self.R.T - np.eye(3)).max() > 1e-5 or np.linalg.det(self.R) < 0:
            raise ValueError("R: it is not a rotation (orthonormal, determinant +1).")

    @classmethod
    def identity(cls) -> Self:
        """The transform that leaves all points unchanged."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_rotation_vector(cls, rotation_rad: ArrayLike, t_mm: ArrayLike = (0.0, 0.0, 0.0)) -> Self:
        """Rotation by the angle |rotation_rad| about its direction, then translation by t_mm."""
        return cls(Rotation.from_rotvec(np.asarray(rotation_rad, dtype=float)).as_matrix(), np.asarray(t_mm))

    def apply(self, x: ArrayLike) -> np.ndarray:
        """Points (n, 3) or one point (3,) transformed from the source to the target frame."""
        array = np.asarray(x, dtype=np.float64)
        if array.shape[-1:] != (3,):
            raise ValueError(f"x: expected 3 coordinates in the last axis, got shape {array.shape}.")
        return array @ self.R.T + self.t

    def inverse(self) -> Self:
        """source_from_target."""
        return RigidTransform(self.R.T, -self.R.T @ self.t)

    def compose(self, other: Self) -> Self:
        """``a_from_b.compose(b_from_c)`` is ``a_from_c``: `other` is applied first."""
        return RigidTransform(self.R @ other.R, self.R @ other.t + self.t)


def image_from_cell(u_cell: ArrayLike, stride: ArrayLike) -> np.ndarray:
    """Pixels of the finer grid from cells of the coarser grid: u = s * u_cell + (s - 1) / 2, per axis.

    Integer coordinates are centres on both grids.  `stride` is a number, not always an integer, or (s_x, s_y).
    """
    s = np.asarray(stride, dtype=np.float64)
    return s * np.asarray(u_cell, dtype=np.float64) + (s - 1.0) / 2.0


def cell_from_image(u: ArrayLike, stride: ArrayLike) -> np.ndarray:
    """The inverse of `image_from_cell`."""
    s = np.asarray(stride, dtype=np.float64)
    return (np.asarray(u, dtype=np.float64) - (s - 1.0) / 2.0) / s
