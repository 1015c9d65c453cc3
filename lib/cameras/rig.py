"""The calibrated stereo pair: projection, epipolar geometry, triangulation.

Two affine cameras stack to y = A x + t with y = (u_left, u_right), A (4, 3): four numbers that hold a 3D point and one
epipolar residual, so triangulation and epipolar geometry are one small constant matrix.
"""

import json
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from lib.cameras.affine import AffineCamera, MatrixCamera
from lib.cameras.near_affine import NearAffineCamera
from lib.cameras.triangulation import Points, best_linear, triangulate_near_affine
from lib.files import write_json
from lib.geometry import RigidTransform, pair_covariance, points

__all__ = ["StereoRig"]

FORMAT = "microstereo.stereo_rig"
UNITS = {"point": "mm", "image": "px"}


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Two calibrated cameras that share the frame of their points (the robot's, unless a name says otherwise).

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
            pairs = [[np.vstack([np.delete(P, j, axis=0), np.delete(Q, i, axis=0)]) for j in range(3)] for i in range(3)]
            F = np.linalg.det(pairs) * [[1, -1, 1], [-1, 1, -1], [1, -1, 1]]
            return F / np.linalg.norm(F)
        n, e = self.epipolar_normal, -self.epipolar_normal @ self.offset_px
        return np.array([[0.0, 0.0, n[2]], [0.0, 0.0, n[3]], [n[0], n[1], e]])

    def moved(self, left: RigidTransform, right: RigidTransform | None = None) -> Self:
        """The rig after its cameras moved in the frame of their points, both alike or each by its own motion."""
        return StereoRig(self.left.moved(left), self.right.moved(left if right is None else right))

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
        return (np.hstack(_matches(u_left, u_right)) - self.offset_px) @ self.epipolar_normal

    def triangulate(self, u_left: ArrayLike, u_right: ArrayLike, covariance_px2: ArrayLike | None = None) -> Points:
        """Maximum-likelihood points of matches; NaN rows stay NaN.

        So does a match that only a point behind a near-affine camera would explain.

        Args:
            u_left, u_right: (n, 2) px.
            covariance_px2: Of the matches, in any form that `lib.geometry.pair_covariance` takes; None is 1 px^2.

        Returns:
            Points: With the covariance of each point from the noise of its match.
        """
        if self.is_affine and (covariance_px2 is None or np.ndim(covariance_px2) == 0):
            return self._triangulate_isotropic(u_left, u_right, 1.0 if covariance_px2 is None else covariance_px2)
        y = np.hstack(_matches(u_left, u_right))
        covariance = pair_covariance(covariance_px2, len(y))
        if not self.is_affine:
            return triangulate_near_affine((self.left, self.right), y, covariance, self.epipolar_normal)
        y = y - self.offset_px
        gain, covariance_mm2 = best_linear(self.linear, covariance)
        x = y @ gain[0].T if len(gain) == 1 else np.einsum("nij,nj->ni", gain, y)
        return Points(x, np.broadcast_to(covariance_mm2, (len(y), 3, 3)), y @ self.epipolar_normal)

    def jacobian(self, x: ArrayLike) -> np.ndarray:
        """Derivative of the four pixel coordinates, (n, 4, 3) px per mm."""
        return np.concatenate([self.left.jacobian(x), self.right.jacobian(x)], axis=1)

    @cached_property
    def _isotropic(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """P (4, 4) and c (4,) so that P y + c is (x, epipolar distance), and the covariance of x for 1 px^2."""
        gain, covariance_mm2 = best_linear(self.linear, np.eye(4))
        P = np.vstack([gain, self.epipolar_normal])
        return P, -P @ self.offset_px, covariance_mm2

    def _triangulate_isotropic(self, u_left: ArrayLike, u_right: ArrayLike, variance_px2: float) -> Points:
        if not variance_px2 > 0:
            raise ValueError(f"covariance_px2: a variance must be positive, got {variance_px2}.")
        P, c, covariance_mm2 = self._isotropic
        u_left, u_right = _matches(u_left, u_right)
        n = len(u_left)
        y = np.empty((4, n))  # a row a coordinate: numpy adds long rows about twice as fast as short ones
        y[:2], y[2:] = u_left.T, u_right.T
        z = P @ y
        z += c[:, None]
        return Points(z[:3].T, np.broadcast_to(covariance_mm2 * variance_px2, (n, 3, 3)), z[3])

    def save(self, path: str | Path) -> None:
        """Write the rig as JSON (matrices, units); the file appears whole or not at all."""

        def numbers(camera: MatrixCamera) -> dict:
            return {field.name: np.asarray(getattr(camera, field.name)).tolist() for field in fields(camera)}

        write_json(path, {"format": FORMAT, "units": UNITS, "left": numbers(self.left), "right": numbers(self.right)})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what `save` wrote.

        Raises:
            FileNotFoundError, ValueError: Naming the file.
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file; StereoRig.save writes one.")
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            for key, expected in (("format", FORMAT), ("units", UNITS)):
                if content.get(key, expected) != expected:
                    raise ValueError(f"{key} is {content[key]!r}, expected {expected!r}")
            left, right = (
                (NearAffineCamera if "inverse_distance_per_mm" in numbers else AffineCamera)(**numbers)
                for numbers in (content["left"], content["right"])
            )
            return cls(left, right)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise ValueError(
                f"{path}: not a stereo rig written by StereoRig.save ({type(error).__name__}: {error})."
            ) from None


def _matches(u_left: ArrayLike, u_right: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    u_left, u_right = points(u_left, 2, "u_left"), points(u_right, 2, "u_right")
    if len(u_left) != len(u_right):
        raise ValueError(f"u_left, u_right: {len(u_left)} and {len(u_right)} points; matches come in pairs.")
    return u_left, u_right
