"""Affine cameras: projection and resection.

An affine camera maps a point x (mm, robot frame unless said otherwise) to the pixel u = M [x; 1] with M (2, 4)
(paper Sec. IV-A).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from lib.geometry import RigidTransform, points


@dataclass(frozen=True)
class Resection:
    """M = K [r1 t1; r2 t2] (paper Eq. 5): intrinsics and pose, all but the shift along the optical axis.

    Attributes:
        K: (2, 2) upper triangular [[alpha_x, skew], [0, alpha_y]], px per mm.
        R: (3, 3) rotation camera_from_robot; its third row is the viewing direction, away from the camera.
        t: (2,) mm, so that u = K (R[:2] @ x + t).
        mirrored: True where the caller's `mirrored` hint says the optics flip the image, so that R's third row was
            turned round.  One affine camera alone cannot tell (a reflection only flips the unseen third row).
    """

    K: np.ndarray
    R: np.ndarray
    t: np.ndarray
    mirrored: bool = False


@runtime_checkable
class Camera(Protocol):
    """Anything that projects points.

    >>> isinstance(AffineCamera([[100, 0, 0, 960], [0, 100, 0, 540]]), Camera)
    True
    """

    def project(self, x: ArrayLike) -> np.ndarray:
        """Pixels (n, 2) of points (n, 3) in mm."""
        ...


@dataclass(frozen=True, eq=False)
class MatrixCamera:
    """What our cameras share: the matrix (2, 4), px per mm and px, of the affine camera that it is or that touches it.

    A model adds `project`, `jacobian` and `projection_matrix`.  A ValueError refuses a matrix that is not finite or whose
    linear part has rank below 2.
    """

    matrix: np.ndarray

    def __post_init__(self) -> None:
        matrix = np.array(self.matrix, dtype=np.float64)
        if matrix.shape != (2, 4) or not np.isfinite(matrix).all():
            raise ValueError(f"matrix: an affine camera is (2, 4) and finite, got {matrix}.")
        if np.linalg.svd(matrix[:, :3], compute_uv=False)[1] <= 1e-9 * np.abs(matrix[:, :3]).max():
            raise ValueError("matrix: its linear part has rank below 2, so it sees a line, not a plane.")
        matrix.setflags(write=False)
        object.__setattr__(self, "matrix", matrix)

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
        """Unit vector (3,) along which points share a pixel of `matrix`, away from the camera (unmirrored optics)."""
        direction = normal_to(self.linear)
        return direction / np.linalg.norm(direction)

    def moved(self, motion: RigidTransform) -> Self:
        """The camera after a rigid motion of itself: it sees motion.apply(x) where it saw x.

        >>> camera = AffineCamera([[100, 0, 0, 960], [0, 100, 0, 540]])
        >>> camera.moved(RigidTransform(np.eye(3), [1, 0, 0])).project([1, 0, 0]).tolist()
        [[960.0, 540.0]]
        """
        back = motion.inverse()
        return replace(self, matrix=np.column_stack([self.linear @ back.R, self.linear @ back.t + self.offset_px]))


def normal_to(A: np.ndarray) -> np.ndarray:
    """Cross product (3,) of the two rows of A (2, 3); numpy's own is far slower for single vectors."""
    (a, b, c), (d, e, f) = A.tolist()
    return np.array([b * f - c * e, c * d - a * f, a * e - b * d])


class AffineCamera(MatrixCamera):
    """u = matrix @ [x; 1], matrix (2, 4) in px per mm and px."""

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

        Args:
            mirrored: True for optics that flip the image (an odd number of reflections).  R then maps to the unflipped
                camera frame whose third axis still points away from the camera.
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
