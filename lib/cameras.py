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


@runtime_checkable
class Camera(Protocol):
    """Anything that projects points (n, 3) in mm to pixels (n, 2)."""

    def project(self, x: ArrayLike) -> np.ndarray: ...


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
    if np.linalg.svd(matrix[:, :3], compute_uv=False)[1] < 1e-9 * np.abs(matrix[:, :3]).max():
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
    """A camera at a finite working distance d, one parameter beyond affine: u = c + (M [x; 1] - c) / (1 + r3.x / d).

    Affine is 1/d = 0, a regular point, so 1/d can be estimated and tested where perspective resection is
    ill-conditioned.  r3 is the viewing direction of M, away from the camera; d is the distance from the
    camera to the robot origin along r3.

    Attributes
    ----------
    matrix:
        M (2, 4), the affine camera that touches this one in the plane r3.x = 0.
    inverse_distance_per_mm:
        1/d.
    centre_px:
        c, the principal point (2,), towards which distant points shrink.
    """

    matrix: np.ndarray
    inverse_distance_per_mm: float
    centre_px: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", _matrix(self.matrix))
        centre = np.array(self.centre_px, dtype=np.float64)
        if centre.shape != (2,) or not np.isfinite(centre).all():
            raise ValueError("centre_px: expected two finite pixels, the principal point.")
        if not np.isfinite(self.inverse_distance_per_mm):
            raise ValueError("inverse_distance_per_mm: must be finite; 0 is the affine camera.")
        object.__setattr__(self, "inverse_distance_per_mm", float(self.inverse_distance_per_mm))
        object.__setattr__(self, "centre_px", centre)

    @property
    def affine(self) -> AffineCamera:
        """The affine camera that touches this one at the robot origin's depth."""
        return AffineCamera(self.matrix)

    def project(self, x: ArrayLike) -> np.ndarray:
        """Pixels (n, 2) of points (n, 3) in mm.

        Raises
        ------
        ValueError
            If a point lies behind the camera.
        """
        x = points(x, 3, "x")
        depth_ratio = 1.0 + self.inverse_distance_per_mm * (x @ self.affine.viewing_direction)
        if (depth_ratio <= 0).any():
            raise ValueError("x: a point lies behind the camera; check the units (mm) and the frame.")
        return self.centre_px + (self.affine.project(x) - self.centre_px) / depth_ratio[:, None]


@dataclass(frozen=True)
class Points:
    """Triangulated points: `x_mm` (n, 3), `covariance_mm2` (n, 3, 3), signed `epipolar_px` residual (n,)."""

    x_mm: np.ndarray
    covariance_mm2: np.ndarray
    epipolar_px: np.ndarray


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Two calibrated cameras that share the frame of their points (the robot's, unless a name says otherwise)."""

    left: AffineCamera
    right: AffineCamera

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
        """Affine fundamental matrix F (3, 3), [u_right; 1].F.[u_left; 1] = 0, scaled so that its value is px."""
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
        return (self._stack(u_left, u_right) - self.offset_px) @ self.epipolar_normal

    def triangulate(self, u_left: ArrayLike, u_right: ArrayLike, covariance_px2: ArrayLike | None = None) -> Points:
        """Maximum-likelihood points of matches; NaN rows stay NaN.

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
        y = self._stack(u_left, u_right) - self.offset_px
        A, n = self.linear, len(y)
        covariance = np.asarray(1.0 if covariance_px2 is None else covariance_px2, dtype=np.float64)
        if covariance.ndim == 0:
            covariance = covariance * np.eye(4)
        elif covariance.shape == (2, 2):
            covariance = np.kron(np.eye(2), covariance)
        if covariance.shape not in {(4, 4), (n, 4, 4)}:
            raise ValueError(
                f"covariance_px2: expected a number, (2, 2), (4, 4) or ({n}, 4, 4), got {covariance.shape}."
            )
        weight_A = np.linalg.solve(covariance, np.broadcast_to(A, covariance.shape[:-2] + (4, 3)))
        covariance_mm2 = np.linalg.inv(A.T @ weight_A)
        gain = covariance_mm2 @ np.swapaxes(weight_A, -1, -2)
        x = y @ gain.T if gain.ndim == 2 else np.einsum("nij,nj->ni", gain, y)
        return Points(x, np.broadcast_to(covariance_mm2, (n, 3, 3)), y @ self.epipolar_normal)

    def save(self, path: str | Path) -> None:
        """Write the rig as JSON (matrices, units); the file appears whole or not at all."""
        path = Path(path)
        text = json.dumps(
            {
                "format": "microstereo.stereo_rig",
                "units": {"point": "mm", "image": "px"},
                "left": {"matrix": self.left.matrix.tolist()},
                "right": {"matrix": self.right.matrix.tolist()},
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
            return cls(AffineCamera(content["left"]["matrix"]), AffineCamera(content["right"]["matrix"]))
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: not a stereo rig written by StereoRig.save ({error}).") from None

    @staticmethod
    def _stack(u_left: ArrayLike, u_right: ArrayLike) -> np.ndarray:
        u_left, u_right = points(u_left, 2, "u_left"), points(u_right, 2, "u_right")
        if len(u_left) != len(u_right):
            raise ValueError(f"u_left, u_right: {len(u_left)} and {len(u_right)} points; matches come in pairs.")
        return np.hstack([u_left, u_right])
