"""Affine cameras and the calibrated stereo pair: projection, resection, epipolar geometry, triangulation.

An affine camera maps a point x (mm, robot frame unless said otherwise) to the pixel u = M [x; 1] with M (2, 4)
(paper Sec. IV-A).  Two of them stack to y = A x + t with y = (u_left, u_right), A (4, 3): four numbers that hold
a 3D point and one epipolar residual, so triangulation and epipolar geometry are one small constant matrix.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from lib.geometry import points

__all__ = ["AffineCamera", "Camera", "NearAffineCamera", "Points", "Resection", "StereoRig"]

#: Points triangulated at a time by near-affine pairs: few enough for their arrays to stay in the processor's cache.
_BLOCK = 4096


@runtime_checkable
class Camera(Protocol):
    """Anything that projects points (n, 3) in mm to pixels (n, 2)."""

    def project(self, x: ArrayLike) -> np.ndarray: ...

    def jacobian(self, x: ArrayLike) -> np.ndarray: ...


@dataclass(frozen=True)
class Resection:
    """M = K [r1 t1; r2 t2] (paper Eq. 5): intrinsics and pose, all but the shift along the optical axis.

    Attributes
    ----------
    K:
        (2, 2) upper triangular [[alpha_x, skew], [0, alpha_y]], px per mm.
    R:
        (3, 3) rotation camera_from_robot; its third row is the viewing direction, away from the camera.
    t:
        (2,) mm, so that u = K (R[:2] @ x + t).
    mirrored:
        True where the caller's `mirrored` hint says the optics flip the image, so that R's third row was
        turned round.  One affine camera alone cannot tell (a reflection only flips the unseen third row).
    """

    K: np.ndarray
    R: np.ndarray
    t: np.ndarray
    mirrored: bool = False


def _matrix(values: ArrayLike) -> np.ndarray:
    matrix = np.array(values, dtype=np.float64)
    if matrix.shape != (2, 4):
        raise ValueError(f"matrix: an affine camera is (2, 4), got {matrix.shape}.")
    if not np.isfinite(matrix).all():
        raise ValueError("matrix: an affine camera must be finite.")
    if np.linalg.svd(matrix[:, :3], compute_uv=False)[1] <= 1e-9 * np.abs(matrix[:, :3]).max():
        raise ValueError("matrix: its linear part has rank below 2, so it sees a line, not a plane.")
    matrix.setflags(write=False)
    return matrix


@dataclass(frozen=True, eq=False)
class AffineCamera:
    """u = matrix @ [x; 1], matrix (2, 4) in px per mm and px."""

    matrix: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", _matrix(self.matrix))

    @property
    def linear(self) -> np.ndarray:
        """A, (2, 3) px per mm."""
        return self.matrix[:, :3]

    @property
    def offset_px(self) -> np.ndarray:
        """Pixel (2,) of the robot frame's origin."""
        return self.matrix[:, 3]

    @cached_property
    def viewing_direction(self) -> np.ndarray:
        """Unit vector (3,) along which points share a pixel, away from the camera (unmirrored optics)."""
        direction = np.cross(self.matrix[0, :3], self.matrix[1, :3])
        return direction / np.linalg.norm(direction)

    def project(self, x: ArrayLike) -> np.ndarray:
        """Pixels (n, 2) of points (n, 3) in mm; NaN rows stay NaN."""
        return points(x, 3, "x") @ self.linear.T + self.offset_px

    def jacobian(self, x: ArrayLike) -> np.ndarray:
        """Derivative of `project`, (n, 2, 3) px per mm; the same at every point."""
        return np.broadcast_to(self.linear, (len(points(x, 3, "x")), 2, 3))

    @property
    def projection_matrix(self) -> np.ndarray:
        """Homogeneous P (3, 4); an affine camera's last row is (0, 0, 0, 1)."""
        return np.vstack([self.matrix, [0.0, 0.0, 0.0, 1.0]])

    def resect(self, *, mirrored: bool = False) -> Resection:
        """K, R and t of the camera by RQ factorisation (paper Eq. 5).

        Parameters
        ----------
        mirrored:
            True for optics that flip the image (an odd number of reflections).  R then maps to the
            unflipped camera frame whose third axis still points away from the camera.
        """
        a_x, a_y = self.linear
        alpha_y = np.linalg.norm(a_y)
        r_2 = a_y / alpha_y
        skew = a_x @ r_2
        alpha_x = np.linalg.norm(a_x - skew * r_2)
        r_1 = (a_x - skew * r_2) / alpha_x
        K = np.array([[alpha_x, skew], [0.0, alpha_y]])
        if mirrored:
            r_1, K = -r_1, K @ np.diag([-1.0, 1.0])
        return Resection(K, np.stack([r_1, r_2, np.cross(r_1, r_2)]), np.linalg.solve(K, self.offset_px), mirrored)


@dataclass(frozen=True, eq=False)
class NearAffineCamera:
    """A camera at a finite working distance d, one parameter beyond affine: u = c + (M [x; 1] - c) / D.

    D = 1 + r3.(x - reference) / d.  Affine is 1/d = 0, a regular point, so 1/d can be estimated and tested where
    perspective resection is ill-conditioned.  r3 is the viewing direction of M, away from the camera; d is the
    distance along r3 from the camera to the plane through the reference point.  A mirrored image shows as a
    negative 1/d, since reflection turns the direction r3 that M implies round.

    Attributes
    ----------
    matrix:
        M (2, 4), the affine camera that touches this one in the plane r3.(x - reference) = 0.
    inverse_distance_per_mm:
        1/d.
    centre_px:
        c, the principal point (2,), towards which distant points shrink.
    reference_mm:
        A point (3,) of the plane where the two touch; the origin unless given.
    radial_per_px2:
        k of radial distortion about c: the pixel above moves by k |u - c|^2 (u - c).
    """

    matrix: np.ndarray
    inverse_distance_per_mm: float
    centre_px: np.ndarray
    reference_mm: np.ndarray = (0.0, 0.0, 0.0)
    radial_per_px2: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", _matrix(self.matrix))
        for name, size in (("centre_px", 2), ("reference_mm", 3)):
            vector = np.array(getattr(self, name), dtype=np.float64)
            if vector.shape != (size,) or not np.isfinite(vector).all():
                raise ValueError(f"{name}: expected {size} finite numbers, got {vector}.")
            vector.setflags(write=False)
            object.__setattr__(self, name, vector)
        for name in ("inverse_distance_per_mm", "radial_per_px2"):
            if not np.isfinite(getattr(self, name)):
                raise ValueError(f"{name}: must be finite; 0 is the affine camera.")
            object.__setattr__(self, name, float(getattr(self, name)))

    @property
    def affine(self) -> AffineCamera:
        """The affine camera that touches this one in the reference plane."""
        return AffineCamera(self.matrix)

    @property
    def linear(self) -> np.ndarray:
        """A, (2, 3) px per mm in the reference plane."""
        return self.matrix[:, :3]

    @property
    def offset_px(self) -> np.ndarray:
        """M's last column (2,)."""
        return self.matrix[:, 3]

    @cached_property
    def viewing_direction(self) -> np.ndarray:
        """r3, unit (3,)."""
        return self.affine.viewing_direction

    def _depth_ratio(self, x: np.ndarray) -> np.ndarray:
        ratio = 1.0 + self.inverse_distance_per_mm * ((x - self.reference_mm) @ self.viewing_direction)
        if (ratio <= 0).any():
            raise ValueError("x: a point lies behind the camera; check the units (mm) and the frame.")
        return ratio

    def project(self, x: ArrayLike) -> np.ndarray:
        """Pixels (n, 2) of points (n, 3) in mm; NaN rows stay NaN.

        Raises
        ------
        ValueError
            If a point lies behind the camera.
        """
        x = points(x, 3, "x")
        v = (x @ self.linear.T + self.offset_px - self.centre_px) / self._depth_ratio(x)[:, None]
        return self.centre_px + v * (1.0 + self.radial_per_px2 * (v**2).sum(axis=1, keepdims=True))

    def jacobian(self, x: ArrayLike) -> np.ndarray:
        """Derivative of `project`, (n, 2, 3) px per mm."""
        x = points(x, 3, "x")
        ratio = self._depth_ratio(x)[:, None]
        v = (x @ self.linear.T + self.offset_px - self.centre_px) / ratio
        J = (self.linear - self.inverse_distance_per_mm * v[:, :, None] * self.viewing_direction) / ratio[:, :, None]
        return radial_derivative(v, self.radial_per_px2) @ J if self.radial_per_px2 else J

    def undistort(self, u: ArrayLike) -> np.ndarray:
        """Pixels (n, 2) with the radial distortion taken out (Newton's method on the radius)."""
        u = points(u, 2, "u")
        if not self.radial_per_px2:
            return u
        w = u - self.centre_px
        distorted = np.linalg.norm(w, axis=1)
        radius = distorted.copy()
        for _ in range(20):
            step = (radius + self.radial_per_px2 * radius**3 - distorted) / (1 + 3 * self.radial_per_px2 * radius**2)
            radius = radius - step
            if not (np.abs(step) > 1e-13 * np.maximum(distorted, 1.0)).any():
                break
        return self.centre_px + w * np.divide(radius, distorted, out=np.ones_like(radius), where=distorted > 0)[:, None]

    @property
    def projection_matrix(self) -> np.ndarray:
        """Homogeneous P (3, 4) of the camera without its radial distortion; it is 1 in the reference plane."""
        last = self.inverse_distance_per_mm * np.append(self.viewing_direction, 0.0)
        last[3] = 1.0 - last[:3] @ self.reference_mm
        return np.vstack([self.matrix + np.outer(self.centre_px, last - [0, 0, 0, 1]), last])

    @classmethod
    def from_projection_matrix(cls, matrix: ArrayLike, radial_per_px2: float = 0.0) -> NearAffineCamera:
        """The camera of a homogeneous P (3, 4), scaled as `projection_matrix` writes it (depth grows along its third row).

        Raises
        ------
        ValueError
            If P is affine (the third row's first three entries vanish) or not finite.
        """
        P = np.array(matrix, dtype=np.float64)
        if P.shape != (3, 4) or not np.isfinite(P).all():
            raise ValueError("matrix: a projection matrix is (3, 4) and finite.")
        depth = P[2, :3]
        size = np.linalg.norm(depth)
        if size == 0:
            raise ValueError("matrix: its last row is (0, 0, 0, w), an affine camera; use AffineCamera.")
        reference = (1.0 - P[2, 3]) * depth / size**2
        centre = P[:2, :3] @ depth / size**2
        M = P[:2] - np.outer(centre, P[2] - [0, 0, 0, 1])
        sign = np.sign(np.cross(M[0, :3], M[1, :3]) @ depth)
        return cls(M, sign * size, centre, reference, radial_per_px2)


def radial_derivative(v: np.ndarray, k: float) -> np.ndarray:
    """d/dv of v (1 + k |v|^2), (n, 2, 2), for v (n, 2)."""
    scale = 1.0 + k * (v**2).sum(axis=1)
    return scale[:, None, None] * np.eye(2) + 2.0 * k * v[:, :, None] * v[:, None, :]


def camera_to_dict(camera: AffineCamera | NearAffineCamera) -> dict:
    """Plain numbers of a camera, for JSON."""
    content = {"matrix": camera.matrix.tolist()}
    if isinstance(camera, NearAffineCamera):
        content |= {
            "inverse_distance_per_mm": camera.inverse_distance_per_mm,
            "centre_px": camera.centre_px.tolist(),
            "reference_mm": camera.reference_mm.tolist(),
            "radial_per_px2": camera.radial_per_px2,
        }
    return content


def camera_from_dict(content: dict) -> AffineCamera | NearAffineCamera:
    """The inverse of `camera_to_dict`; KeyError or ValueError where an entry is missing or wrong."""
    if "inverse_distance_per_mm" not in content:
        return AffineCamera(content["matrix"])
    return NearAffineCamera(
        content["matrix"],
        content["inverse_distance_per_mm"],
        content["centre_px"],
        content.get("reference_mm", (0.0, 0.0, 0.0)),
        content.get("radial_per_px2", 0.0),
    )


@dataclass(frozen=True)
class Points:
    """Triangulated points: `x_mm` (n, 3), `covariance_mm2` (n, 3, 3), signed `epipolar_px` residual (n,)."""

    x_mm: np.ndarray
    covariance_mm2: np.ndarray
    epipolar_px: np.ndarray


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Two calibrated cameras that share the frame of their points (the robot's, unless a name says otherwise)."""

    left: AffineCamera | NearAffineCamera
    right: AffineCamera | NearAffineCamera

    @cached_property
    def is_affine(self) -> bool:
        """True where both cameras are affine, so that every formula below is one constant matrix."""
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
        """Fundamental matrix F (3, 3), [u_right; 1].F.[u_left; 1] = 0; of an affine pair scaled so that its value is px.

        Of near-affine cameras it holds for undistorted pixels and has unit Frobenius norm.
        """
        if not self.is_affine:
            P, Q = self.left.projection_matrix, self.right.projection_matrix
            F = np.empty((3, 3))
            for i in range(3):
                for j in range(3):
                    rows = np.vstack([np.delete(P, j, axis=0), np.delete(Q, i, axis=0)])
                    F[i, j] = (-1) ** (i + j) * np.linalg.det(rows)
            return F / np.linalg.norm(F)
        n, e = self.epipolar_normal, -self.epipolar_normal @ self.offset_px
        return np.array([[0.0, 0.0, n[2]], [0.0, 0.0, n[3]], [n[0], n[1], e]])

    @cached_property
    def convergence_rad(self) -> float:
        """Angle between the two viewing directions."""
        cosine = self.left.viewing_direction @ self.right.viewing_direction
        return float(np.arccos(np.clip(cosine, -1.0, 1.0)))

    def project(self, x: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """(u_left, u_right), (n, 2) px each, of points (n, 3) in mm."""
        return self.left.project(x), self.right.project(x)

    def epipolar_distance(self, u_left: ArrayLike, u_right: ArrayLike) -> np.ndarray:
        """Signed distance (n,) px of each match from the epipolar constraint.

        The distance is in the four pixel coordinates together, so independent noise of 1 px in each gives a
        distance of standard deviation 1 px (Hartley and Zisserman, Sec. 14.4).
        """
        if not self.is_affine:
            return self.triangulate(u_left, u_right).epipolar_px
        return (self._stack(u_left, u_right) - self.offset_px) @ self.epipolar_normal

    def triangulate(self, u_left: ArrayLike, u_right: ArrayLike, covariance_px2: ArrayLike | None = None) -> Points:
        """Maximum-likelihood points of matches; NaN rows stay NaN.

        So does a match that only a point behind a near-affine camera would explain.

        Parameters
        ----------
        u_left, u_right:
            (n, 2) px.
        covariance_px2:
            Covariance of the matches in px^2: a number (the variance of each coordinate), (2, 2) for both images,
            (4, 4) for the pair, or (n, 4, 4), one a match.  None is 1 px^2.

        Returns
        -------
        Points
            With the covariance of each point from the noise of its match.
        """
        if self.is_affine and (covariance_px2 is None or np.ndim(covariance_px2) == 0):
            return self._triangulate_isotropic(u_left, u_right, 1.0 if covariance_px2 is None else covariance_px2)
        y = self._stack(u_left, u_right)
        n = len(y)
        covariance = np.asarray(1.0 if covariance_px2 is None else covariance_px2, dtype=np.float64)
        if covariance.ndim == 0:
            covariance = covariance * np.eye(4)
        elif covariance.shape == (2, 2):
            covariance = np.kron(np.eye(2), covariance)
        if covariance.shape not in {(4, 4), (n, 4, 4)}:
            raise ValueError(
                f"covariance_px2: expected a number, (2, 2), (4, 4) or ({n}, 4, 4), got {covariance.shape}."
            )
        if not self.is_affine:
            return self._triangulate_near_affine(y, covariance)
        y = y - self.offset_px
        gain, covariance_mm2 = _gain(self.linear, covariance)
        x = y @ gain.T if gain.ndim == 2 else np.einsum("nij,nj->ni", gain, y)
        return Points(x, np.broadcast_to(covariance_mm2, (n, 3, 3)), y @ self.epipolar_normal)

    def jacobian(self, x: ArrayLike) -> np.ndarray:
        """Derivative of the four pixel coordinates, (n, 4, 3) px per mm."""
        return np.concatenate([self.left.jacobian(x), self.right.jacobian(x)], axis=1)

    @cached_property
    def _isotropic(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """P (4, 4) and c (4,) so that P y + c is (x, epipolar distance), and the covariance of x for 1 px^2."""
        gain, covariance_mm2 = _gain(self.linear, np.eye(4))
        P = np.vstack([gain, self.epipolar_normal])
        return P, -P @ self.offset_px, covariance_mm2

    def _triangulate_isotropic(self, u_left: ArrayLike, u_right: ArrayLike, variance_px2: float) -> Points:
        P, c, covariance_mm2 = self._isotropic
        u_left, u_right = _matches(u_left, u_right)
        n = len(u_left)
        y = np.empty((4, n))  # a row a coordinate: numpy adds long rows about twice as fast as short ones
        y[:2], y[2:] = u_left.T, u_right.T
        z = P @ y
        z += c[:, None]
        return Points(z[:3].T, np.broadcast_to(covariance_mm2 * variance_px2, (n, 3, 3)), z[3])

    def _triangulate_near_affine(self, y: np.ndarray, covariance: np.ndarray, steps: int = 2) -> Points:
        """Linear per point (the projection's denominator multiplied out), then Gauss-Newton steps on the pixels.

        A point's normal equations are 3 x 3: they are solved by cofactors, with an array a matrix entry and a block of
        points at a time, which is many times faster than stacks of small matrices.
        """
        n = len(y)
        x, covariance_mm2 = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan)
        epipolar = np.full(n, np.nan)
        ideal = y.copy()
        for camera, columns in ((self.left, slice(0, 2)), (self.right, slice(2, 4))):
            if isinstance(camera, NearAffineCamera):
                ideal[:, columns] = camera.undistort(y[:, columns])
        known = np.flatnonzero(np.isfinite(y).all(axis=1))
        root = np.linalg.cholesky(covariance)
        for start in range(0, len(known), _BLOCK):
            rows = known[start : start + _BLOCK]
            L = root if root.ndim == 2 else np.ascontiguousarray(np.moveaxis(root[rows], 0, -1))
            pixels = list(y[rows].T)
            found = _solve_normal(*self._linear_system(ideal[rows].T), np.eye(4))[0]
            for _ in range(steps):
                J, r, _ = self._linearised(found, pixels)
                step, inverse = _solve_normal(J, r, L)
                found = [a + b for a, b in zip(found, step, strict=True)]
            J, r, in_front = self._linearised(found, pixels)
            for k in range(3):
                x[rows, k] = np.where(in_front, found[k], np.nan)
                for j in range(3):
                    covariance_mm2[rows, j, k] = inverse[min(j, k)][max(j, k) - min(j, k)]
            covariance_mm2[rows[~in_front]] = np.nan
            # The residual lies along the left null vector of the Jacobian; its sign is that of the affine normal.
            epipolar[rows] = np.where(in_front, _along_null_vector(J, r, self.epipolar_normal), np.nan)
        return Points(x, covariance_mm2, epipolar)

    def _linear_system(self, u: np.ndarray) -> tuple[list[list[np.ndarray]], list[np.ndarray]]:
        """Rows and right-hand sides of the equations linear in x, for undistorted pixels u (4, n)."""
        P = [camera.projection_matrix for camera in (self.left, self.right)]
        rows = [[P[i // 2][i % 2, k] - u[i] * P[i // 2][2, k] for k in range(3)] for i in range(4)]
        return rows, [u[i] * P[i // 2][2, 3] - P[i // 2][i % 2, 3] for i in range(4)]

    def _linearised(
        self, x: list[np.ndarray], y: list[np.ndarray]
    ) -> tuple[list[list[np.ndarray]], list[np.ndarray], np.ndarray]:
        """Jacobian (4 rows of 3), residuals (4) at points x (3 coordinates), and which points lie before the cameras."""
        J, r, in_front = [], [], np.ones(len(x[0]), dtype=bool)
        for camera, pixels in ((self.left, y[:2]), (self.right, y[2:])):
            A, t = camera.linear, camera.offset_px
            if not isinstance(camera, NearAffineCamera):
                J += [list(A[i]) for i in range(2)]
                r += [pixels[i] - (A[i, 0] * x[0] + A[i, 1] * x[1] + A[i, 2] * x[2] + t[i]) for i in range(2)]
                continue
            c, k = camera.centre_px, camera.radial_per_px2
            slope = camera.inverse_distance_per_mm * camera.viewing_direction
            ratio = slope[0] * x[0] + slope[1] * x[1] + slope[2] * x[2] + (1.0 - slope @ camera.reference_mm)
            in_front &= ratio > 0
            inverse = 1.0 / ratio
            v = [(A[i, 0] * x[0] + A[i, 1] * x[1] + A[i, 2] * x[2] + (t[i] - c[i])) * inverse for i in range(2)]
            rows = [[(A[i, j] - slope[j] * v[i]) * inverse for j in range(3)] for i in range(2)]
            if k:
                scale, cross = 1.0 + k * (v[0] ** 2 + v[1] ** 2), 2.0 * k * v[0] * v[1]
                bend = [scale + 2.0 * k * v[i] ** 2 for i in range(2)]
                rows = [[bend[i] * a + cross * b for a, b in zip(rows[i], rows[1 - i], strict=True)] for i in range(2)]
                v = [scale * v[i] for i in range(2)]
            J += rows
            r += [pixels[i] - c[i] - v[i] for i in range(2)]
        return J, r, in_front

    def save(self, path: str | Path) -> None:
        """Write the rig as JSON (matrices, units); the file appears whole or not at all."""
        path = Path(path)
        text = json.dumps(
            {
                "format": "microstereo.stereo_rig",
                "units": {"point": "mm", "image": "px"},
                "left": camera_to_dict(self.left),
                "right": camera_to_dict(self.right),
            },
            indent=1,
        )
        partial = path.with_name(path.name + ".partial")
        partial.write_text(text + "\n", encoding="utf-8")
        os.replace(partial, path)

    @classmethod
    def load(cls, path: str | Path) -> StereoRig:
        """Read what `save` wrote.

        Raises
        ------
        FileNotFoundError, ValueError
            Naming the file.
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file; StereoRig.save writes one.")
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            return cls(camera_from_dict(content["left"]), camera_from_dict(content["right"]))
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"{path}: not a stereo rig written by StereoRig.save ({type(error).__name__}: {error})."
            ) from None

    @staticmethod
    def _stack(u_left: ArrayLike, u_right: ArrayLike) -> np.ndarray:
        return np.hstack(_matches(u_left, u_right))


def _matches(u_left: ArrayLike, u_right: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    u_left, u_right = points(u_left, 2, "u_left"), points(u_right, 2, "u_right")
    if len(u_left) != len(u_right):
        raise ValueError(f"u_left, u_right: {len(u_left)} and {len(u_right)} points; matches come in pairs.")
    return u_left, u_right


def _gain(A: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Best linear estimator (..., 3, 4) of x from y = A x + noise, and the estimate's covariance (..., 3, 3)."""
    shape = np.broadcast_shapes(A.shape[:-2], covariance.shape[:-2])
    weight_A = np.linalg.solve(covariance, np.broadcast_to(A, (*shape, 4, 3)))
    covariance_mm2 = np.linalg.inv(np.swapaxes(A, -1, -2) @ weight_A)
    return covariance_mm2 @ np.swapaxes(weight_A, -1, -2), covariance_mm2


def _solve_normal(
    J: list[list[np.ndarray]], r: list[np.ndarray], L: np.ndarray
) -> tuple[list[np.ndarray], list[list[np.ndarray]]]:
    """Least squares of L^-1 (r - J x), many points at once: x (3 arrays) and the inverse of the normal matrix.

    Parameters
    ----------
    J, r:
        Four rows of three arrays (n,) or numbers, and four arrays (n,).
    L:
        Cholesky root of the covariance, (4, 4) or (4, 4, n).

    Returns
    -------
    The upper triangle of the inverse comes row by row: three, two, one arrays.
    """
    rows = [[*J[i], r[i]] for i in range(4)]
    for i in range(4):
        for j in range(i):
            if L.ndim == 3 or L[i, j]:
                rows[i] = [a - L[i, j] * b for a, b in zip(rows[i], rows[j], strict=True)]
        if L.ndim == 3 or L[i, i] != 1:
            scale = 1.0 / L[i, i]
            rows[i] = [scale * a for a in rows[i]]

    def product(a: int, b: int) -> np.ndarray:
        return rows[0][a] * rows[0][b] + rows[1][a] * rows[1][b] + rows[2][a] * rows[2][b] + rows[3][a] * rows[3][b]

    n00, n01, n02, n11, n12, n22 = (product(a, b) for a, b in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    g = [product(k, 3) for k in range(3)]
    c00, c01, c02 = n11 * n22 - n12**2, n02 * n12 - n01 * n22, n01 * n12 - n02 * n11
    c11, c12, c22 = n00 * n22 - n02**2, n01 * n02 - n00 * n12, n00 * n11 - n01**2
    scale = 1.0 / (n00 * c00 + n01 * c01 + n02 * c02)
    c00, c01, c02, c11, c12, c22 = (scale * c for c in (c00, c01, c02, c11, c12, c22))
    x = [
        c00 * g[0] + c01 * g[1] + c02 * g[2],
        c01 * g[0] + c11 * g[1] + c12 * g[2],
        c02 * g[0] + c12 * g[1] + c22 * g[2],
    ]
    return x, [[c00, c01, c02], [c11, c12], [c22]]


def _along_null_vector(J: list[list[np.ndarray]], r: list[np.ndarray], along: np.ndarray) -> np.ndarray:
    """Component (n,) of r along the unit vectors orthogonal to the columns of J, turned to the side of `along` (4,)."""
    normal = []
    for i in range(4):
        a, b, c = (J[k] for k in range(4) if k != i)
        minor = (
            a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0])
        )
        normal.append(minor if i % 2 == 0 else -minor)

    def times(v: list[np.ndarray] | np.ndarray) -> np.ndarray:
        return normal[0] * v[0] + normal[1] * v[1] + normal[2] * v[2] + normal[3] * v[3]

    return times(r) * np.sign(times(along)) / np.sqrt(times(normal))
