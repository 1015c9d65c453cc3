"""Affine and near-affine cameras, and the calibrated stereo pair: projection, epipolar geometry, triangulation.

An affine camera maps a point x (mm, robot frame unless stated otherwise) to the pixel u = M [x; 1] with M (2, 4)
(paper Sec. IV-A).  Two cameras together give y = A x + t with y = (u_left, u_right), A (4, 3).  These four numbers
determine a 3D point and one epipolar residual, so triangulation is a product with one small constant matrix.
"""

import json
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import rq

from lib.files import write_json
from lib.geometry import RigidTransform, pair_covariance, points, store_array

FORMAT = "microstereo.stereo_rig"
UNITS = {"point": "mm", "image": "px"}


@dataclass(frozen=True)
class Resection:
    """M = K [r1 t1; r2 t2] (paper Eq. 5): intrinsics and pose, except for the shift along the optical axis.

    Attributes:
        K: (2, 2) upper triangular [[alpha_x, skew], [0, alpha_y]], px per mm.
        R: (3, 3) rotation camera_from_robot; its third row is the viewing direction, away from the camera.
        t: (2,) mm, so that u = K (R[:2] @ x + t).
        mirrored: As given by the caller; a single affine camera does not show it (a reflection only flips R's third row).
    """

    K: np.ndarray
    R: np.ndarray
    t: np.ndarray
    mirrored: bool = False


@runtime_checkable
class Camera(Protocol):
    """Any object that projects points."""

    def project(self, x: ArrayLike) -> np.ndarray:
        """Pixels (n, 2) of points (n, 3) in mm."""


@dataclass(frozen=True, eq=False)
class MatrixCamera:
    """Base class of cameras: the matrix (2, 4), px per mm and px, of the affine camera or affine approximation.

    Subclasses add `project`, `jacobian` and `projection_matrix`.  A ValueError refuses a matrix that is not finite or whose
    linear part has rank below 2.
    """

    matrix: np.ndarray

    def __post_init__(self) -> None:
        store_array(self, "matrix", (2, 4))
        if np.linalg.svd(self.linear, compute_uv=False)[1] <= 1e-9 * np.abs(self.linear).max():
            raise ValueError("matrix: its linear part has rank below 2, so its image is a line, not a plane.")

    @property
    def linear(self) -> np.ndarray:
        """A, (2, 3) px per mm."""
        return self.matrix[:, :3]

    @property
    def offset_px(self) -> np.ndarray:
        """The matrix's last column (2,)."""
        return self.matrix[:, 3]

    @cached_property
    def viewing_direction(self) -> np.ndarray:
        """Unit vector (3,) along which `matrix` projects points to the same pixel, away from the (unmirrored) camera."""
        direction = np.cross(*self.linear)
        return direction / np.linalg.norm(direction)

    def moved(self, motion: RigidTransform) -> Self:
        """The camera after a rigid motion: it images motion.apply(x) where it imaged x before.

        >>> camera = AffineCamera([[100, 0, 0, 960], [0, 100, 0, 540]])
        >>> camera.moved(RigidTransform(np.eye(3), [1, 0, 0])).project([1, 0, 0]).tolist()
        [[960.0, 540.0]]
        """
        back = motion.inverse()
        return replace(self, matrix=np.column_stack([self.linear @ back.R, self.linear @ back.t + self.offset_px]))

    def resect(self, *, mirrored: bool = False) -> Resection:
        """K, R and t by RQ factorisation of `matrix` (paper Eq. 5), also for a near-affine camera.

        With optics that flip the image (`mirrored`: an odd number of reflections) R maps to the unflipped camera frame,
        whose third axis still points away from the camera.
        """
        K, R = rq(self.linear, mode="economic")  # (2, 2) and (2, 3), up to signs
        signs = np.sign(np.diag(K)) * [-1.0 if mirrored else 1.0, 1.0]
        K, R = K * signs, R * signs[:, None]
        return Resection(K, np.vstack([R, np.cross(*R)]), np.linalg.solve(K, self.offset_px), mirrored)


class AffineCamera(MatrixCamera):
    """u = matrix @ [x; 1], matrix (2, 4) in px per mm and px."""

    def project(self, x: ArrayLike) -> np.ndarray:
        """Pixels (n, 2) of points (n, 3) in mm; NaN rows stay NaN."""
        return points(x, 3, "x") @ self.linear.T + self.offset_px

    def jacobian(self, x: ArrayLike) -> np.ndarray:
        """Derivative of `project`, (n, 2, 3) px per mm; it is the same at every point."""
        return np.broadcast_to(self.linear, (len(points(x, 3, "x")), 2, 3))

    @property
    def projection_matrix(self) -> np.ndarray:
        """Homogeneous P (3, 4); an affine camera's last row is (0, 0, 0, 1)."""
        return np.vstack([self.matrix, [0.0, 0.0, 0.0, 1.0]])


@dataclass(frozen=True, eq=False)
class NearAffineCamera(MatrixCamera):
    """A camera at a finite working distance d, one parameter more than affine: u = c + (M [x; 1] - c) / D.

    D = 1 + r3.(x - reference) / d.  The affine camera is 1/d = 0, a regular point of the model, so 1/d can be estimated
    and tested even where perspective resection is ill-conditioned.  r3 is the viewing direction of M, away from the
    camera; d is the distance along r3 from the camera to the plane through the reference point.  A mirrored image has a
    negative 1/d, since a reflection reverses the direction r3 that follows from M.

    Attributes:
        matrix: M (2, 4), the affine camera that equals this one in the plane r3.(x - reference) = 0.
        inverse_distance_per_mm: 1/d.
        centre_px: c, the principal point (2,), towards which distant points shrink.
        reference_mm: A point (3,) of that plane; the origin unless given.
        radial_per_px2: k of radial distortion about c: the pixel u above moves by k |u - c|^2 (u - c).
    """

    inverse_distance_per_mm: float
    centre_px: np.ndarray
    reference_mm: np.ndarray = (0.0, 0.0, 0.0)
    radial_per_px2: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        store_array(self, "centre_px", (2,))
        store_array(self, "reference_mm", (3,))
        for name in ("inverse_distance_per_mm", "radial_per_px2"):
            if not np.isfinite(getattr(self, name)):
                raise ValueError(f"{name}: must be finite; 0 is the affine camera.")
            object.__setattr__(self, name, float(getattr(self, name)))

    def depth_ratio(self, x: np.ndarray) -> np.ndarray:
        """D (n,) of points (n, 3) mm: distance from the camera along the view, divided by d; at most 0 behind the camera."""
        return 1.0 + self.inverse_distance_per_mm * ((x - self.reference_mm) @ self.viewing_direction)

    def _undistorted(self, x: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Undistorted pixels (n, 2) relative to the centre, and D (n, 1)."""
        x = points(x, 3, "x")
        ratio = self.depth_ratio(x)[:, None]
        if (ratio <= 0).any():
            raise ValueError("x: a point lies behind the camera; check the units (mm) and the frame.")
        return (x @ self.linear.T + self.offset_px - self.centre_px) / ratio, ratio

    def project(self, x: ArrayLike) -> np.ndarray:
        """Pixels (n, 2) of points (n, 3) in mm; NaN rows stay NaN, and a ValueError refuses points behind the camera."""
        v = self._undistorted(x)[0]
        return self.centre_px + v * (1.0 + self.radial_per_px2 * (v**2).sum(axis=1, keepdims=True))

    def jacobian(self, x: ArrayLike) -> np.ndarray:
        """Derivative of `project`, (n, 2, 3) px per mm."""
        v, ratio = self._undistorted(x)
        J = (self.linear - self.inverse_distance_per_mm * v[:, :, None] * self.viewing_direction) / ratio[:, :, None]
        return radial_derivative(v, self.radial_per_px2) @ J if self.radial_per_px2 else J

    def undistort(self, u: ArrayLike) -> np.ndarray:
        """Pixels (n, 2) with the radial distortion removed.

        Barrel distortion (k < 0) has a largest distorted radius; pixels beyond it, where no point is imaged, become NaN.

        >>> camera = NearAffineCamera([[100, 0, 0, 0], [0, 100, 0, 0]], 0.01, [0, 0], radial_per_px2=-1e-6)
        >>> camera.undistort([[0, 351], [0, 400]]).round().tolist()
        [[0.0, 431.0], [nan, nan]]
        """
        u = points(u, 2, "u")
        if not self.radial_per_px2:
            return u
        w = u - self.centre_px
        distorted, size = np.linalg.norm(w, axis=1), 2 / np.sqrt(3 * abs(self.radial_per_px2))
        # Solve the cubic equation for the radius by the triple-angle formula of the sine (k < 0) or hyperbolic sine.
        sine, angle = (np.sin, np.arcsin) if self.radial_per_px2 < 0 else (np.sinh, np.arcsinh)
        with np.errstate(invalid="ignore"):  # pixels beyond the largest radius
            radius = size * sine(angle(3 * distorted / size) / 3)
        return self.centre_px + w * np.divide(radius, distorted, out=np.ones_like(radius), where=distorted != 0)[:, None]

    @property
    def projection_matrix(self) -> np.ndarray:
        """Homogeneous P (3, 4) without radial distortion; the third homogeneous coordinate is 1 in the reference plane."""
        last = self.inverse_distance_per_mm * np.append(self.viewing_direction, 0.0)
        last[3] = 1.0 - last[:3] @ self.reference_mm
        return np.vstack([self.matrix + np.outer(self.centre_px, last - [0, 0, 0, 1]), last])

    def moved(self, motion: RigidTransform) -> Self:
        """The camera after a rigid motion, as for an affine camera; the reference point moves with it."""
        return replace(super().moved(motion), reference_mm=motion.apply(self.reference_mm))


def radial_derivative(v: np.ndarray, k: ArrayLike) -> np.ndarray:
    """d/dv of v (1 + k |v|^2), (..., 2, 2), for v (..., 2) and k (...) or a number."""
    k = np.asarray(k)[..., None, None]
    return (1.0 + k * (v**2).sum(axis=-1)[..., None, None]) * np.eye(2) + 2.0 * k * v[..., :, None] * v[..., None, :]


@dataclass(frozen=True)
class Points:
    """Triangulated points: `x_mm` (n, 3), `covariance_mm2` (n, 3, 3), signed `epipolar_px` residual (n,)."""

    x_mm: np.ndarray
    covariance_mm2: np.ndarray
    epipolar_px: np.ndarray

    def keep(self, chosen: np.ndarray) -> Self:
        """The points of a mask (n,) or of indices."""
        return Points(self.x_mm[chosen], self.covariance_mm2[chosen], self.epipolar_px[chosen])


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Two calibrated cameras with a common frame of their points (the robot's, unless a name says otherwise).

    >>> left = AffineCamera([[100, 0, 0, 960], [0, 100, 0, 540]])
    >>> right = AffineCamera([[100, 0, 11, 960], [0, 100, 0, 540]])
    >>> rig = StereoRig(left, right)
    >>> found = rig.triangulate(*rig.project([[1.0, 2.0, 0.5]]))
    >>> found.x_mm.round(9).tolist(), found.epipolar_px.round(9).tolist()
    ([[1.0, 2.0, 0.5]], [0.0])
    """

    left: MatrixCamera
    right: MatrixCamera

    @cached_property
    def is_affine(self) -> bool:
        """True if both cameras are affine, so that projection and triangulation are constant matrices."""
        return isinstance(self.left, AffineCamera) and isinstance(self.right, AffineCamera)

    @cached_property
    def linear(self) -> np.ndarray:
        """A (4, 3), rows left x, left y, right x, right y."""
        return np.vstack([self.left.linear, self.right.linear])

    @cached_property
    def offset_px(self) -> np.ndarray:
        """t (4,), so that y = A x + t."""
        return np.concatenate([self.left.offset_px, self.right.offset_px])

    @cached_property
    def epipolar_normal(self) -> np.ndarray:
        """Unit n (4,) with n.A = 0: n.(y - t) = 0 is the affine epipolar constraint."""
        normal = np.linalg.svd(self.linear)[0][:, 3]
        return normal * (1.0 if normal[np.argmax(np.abs(normal))] > 0 else -1.0)

    @property
    def fundamental(self) -> np.ndarray:
        """Fundamental matrix F (3, 3), [u_right; 1].F.[u_left; 1] = 0; for an affine pair this product is in px.

        For near-affine cameras it refers to undistorted pixels and has unit Frobenius norm.
        """
        if not self.is_affine:
            P, Q = self.left.projection_matrix, self.right.projection_matrix
            pairs = [[np.vstack([np.delete(P, j, axis=0), np.delete(Q, i, axis=0)]) for j in range(3)] for i in range(3)]
            F = np.linalg.det(pairs) * [[1, -1, 1], [-1, 1, -1], [1, -1, 1]]
            return F / np.linalg.norm(F)
        n, e = self.epipolar_normal, -self.epipolar_normal @ self.offset_px
        return np.array([[0.0, 0.0, n[2]], [0.0, 0.0, n[3]], [n[0], n[1], e]])

    def moved(self, left: RigidTransform, right: RigidTransform | None = None) -> Self:
        """The rig after its cameras moved in the frame of their points, together or each by its own motion."""
        return StereoRig(self.left.moved(left), self.right.moved(left if right is None else right))

    @cached_property
    def convergence_rad(self) -> float:
        """Angle between the two viewing directions."""
        return float(np.arccos(np.clip(self.left.viewing_direction @ self.right.viewing_direction, -1.0, 1.0)))

    @cached_property
    def sees_depth(self) -> bool:
        """False if both viewing directions are parallel, so that the depth of a point changes no pixel."""
        return bool(np.linalg.norm(self.right.linear @ self.left.viewing_direction) > 1e-6 * np.linalg.norm(self.linear))

    def project(self, x: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """(u_left, u_right), (n, 2) px each, of points (n, 3) in mm."""
        return self.left.project(x), self.right.project(x)

    def jacobian(self, x: ArrayLike) -> np.ndarray:
        """Derivative of the four pixel coordinates, (n, 4, 3) px per mm."""
        return np.concatenate([self.left.jacobian(x), self.right.jacobian(x)], axis=1)

    def epipolar_distance(self, u_left: ArrayLike, u_right: ArrayLike) -> np.ndarray:
        """Signed epipolar distance (n,) px of each match.

        It is the distance in the space of the four pixel coordinates, so independent noise of 1 px in each gives a
        standard deviation of 1 px (Hartley and Zisserman, Sec. 14.4).
        """
        return self.triangulate(u_left, u_right).epipolar_px

    def triangulate(self, u_left: ArrayLike, u_right: ArrayLike, covariance_px2: ArrayLike | None = None) -> Points:
        """Maximum-likelihood points from matches (n, 2) px, with the covariance that follows from the noise of the matches.

        Point and covariance are NaN if the row is NaN, if no point in front of near-affine cameras explains it, or if affine
        cameras see no depth.  `covariance_px2` of the matches has any form that `lib.geometry.pair_covariance` accepts;
        None is 1 px^2.
        """
        u_left, u_right = points(u_left, 2, "u_left"), points(u_right, 2, "u_right")
        if len(u_left) != len(u_right):
            raise ValueError(f"u_left, u_right: {len(u_left)} and {len(u_right)} points; matches come in pairs.")
        y = np.hstack([u_left, u_right])
        covariance = pair_covariance(covariance_px2, len(y))
        if not self.is_affine:
            return self._triangulate_near_affine(y, covariance)
        y = y.T - self.offset_px[:, None]
        weight_A = np.linalg.solve(covariance, np.broadcast_to(self.linear, (len(covariance), 4, 3)))
        covariance_mm2 = np.linalg.inv(self.linear.T @ weight_A if self.sees_depth else np.full((1, 3, 3), np.nan))
        gain = covariance_mm2 @ weight_A.mT
        x = (gain[0] @ y).T if len(gain) == 1 else np.einsum("nij,jn->ni", gain, y)
        covariance_mm2 = np.broadcast_to(covariance_mm2, (len(x), 3, 3))
        if (missing := np.isnan(x[:, 0])).any():
            covariance_mm2 = np.where(missing[:, None, None], np.nan, covariance_mm2)
        return Points(x, covariance_mm2, self.epipolar_normal @ y)

    def _triangulate_near_affine(self, y: np.ndarray, covariance: np.ndarray) -> Points:
        """A linear solution (the projection times its denominator), then two Gauss-Newton steps on the reprojection error."""
        x, covariance_mm2, epipolar = (np.full((len(y), *shape), np.nan) for shape in ((3,), (3, 3), ()))
        rows = np.flatnonzero(np.isfinite(y).all(axis=1))
        near = [camera for camera in (self.left, self.right) if isinstance(camera, NearAffineCamera)]
        W = np.linalg.inv(covariance if len(covariance) == 1 else covariance[rows])
        equations = []  # P_i [x; 1] - u_i P_3 [x; 1] = 0 for undistorted pixels
        for camera, u in zip((self.left, self.right), (y[rows, :2], y[rows, 2:]), strict=True):
            P, u = camera.projection_matrix, camera.undistort(u) if isinstance(camera, NearAffineCamera) else u
            equations.append(P[:2] - u[:, :, None] * P[2])
        linear = np.concatenate(equations, axis=1)
        found = _least_squares(linear[:, :, :3], -linear[:, :, 3], np.eye(4))[0]
        step, seen = 0.0, np.ones(len(rows), dtype=bool)
        for _ in range(3):  # the third time gives the covariance at the result
            found = found + step
            in_front = np.all([camera.depth_ratio(found) > 0 for camera in near], axis=0)
            safe = np.where(in_front[:, None], found, near[0].reference_mm)  # placeholder for the others
            J, r = self.jacobian(safe), y[rows] - np.hstack(self.project(safe))
            step, inverse = _least_squares(J, r, W)
            seen &= in_front
        # Epipolar distance: the part of r that no change of the point explains, signed by the affine epipolar normal.
        rest = r - (J @ _least_squares(J, r, np.eye(4))[0][:, :, None])[:, :, 0]
        rest = np.sign(rest @ self.epipolar_normal) * np.linalg.norm(rest, axis=1)
        x[rows[seen]], covariance_mm2[rows[seen]], epipolar[rows[seen]] = found[seen], inverse[seen], rest[seen]
        return Points(x, covariance_mm2, epipolar)

    def save(self, path: str | Path) -> None:
        """Write the rig as JSON (matrices, units); the file is never left incomplete."""
        write_json(path, {"format": FORMAT, "units": UNITS} | self.to_json())

    def to_json(self) -> dict:
        """The attributes of both cameras, as `of_json` reads them."""
        return {
            side: {field.name: np.asarray(getattr(camera, field.name)).tolist() for field in fields(camera)}
            for side, camera in (("left", self.left), ("right", self.right))
        }

    @classmethod
    def of_json(cls, content: dict) -> Self:
        """The rig of `to_json`; another content raises a KeyError, TypeError or ValueError."""
        sides = content["left"], content["right"]
        return cls(*((NearAffineCamera if "inverse_distance_per_mm" in own else AffineCamera)(**own) for own in sides))

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file of `save`.  A FileNotFoundError or ValueError names the file; a rig that sees no depth is refused."""
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file; `python3 -m lib calibrate RECORDING` writes rig.json.")
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            for key, expected in (("format", FORMAT), ("units", UNITS)):
                if content.get(key, expected) != expected:
                    raise ValueError(f"{key} is {content[key]!r}, expected {expected!r}")
            rig = cls.of_json(content)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            why = f"{type(error).__name__}: {error}"
            raise ValueError(f"{path}: not a stereo rig written by StereoRig.save ({why}).") from None
        if not rig.sees_depth:
            raise ValueError(f"{path}: both cameras look along the same direction, so depth cannot be seen; calibrate again.")
        return rig


def _least_squares(J: np.ndarray, r: np.ndarray, W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted least squares of r = J x: x (n, 3) and the inverse (n, 3, 3) of the normal matrix; NaN if it is singular."""
    WJ = W @ J
    normal = J.mT @ WJ
    with np.errstate(invalid="ignore"):  # rows with NaN
        inverse = np.linalg.inv(np.where(np.linalg.det(normal)[:, None, None] == 0, np.nan, normal))
    return (inverse @ (WJ.mT @ r[..., None]))[..., 0], inverse
