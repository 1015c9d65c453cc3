"""Cameras at a finite working distance: one parameter beyond affine."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from lib.cameras.affine import AffineCamera, MatrixCamera
from lib.geometry import RigidTransform, points


@dataclass(frozen=True, eq=False)
class NearAffineCamera(MatrixCamera):
    """A camera at a finite working distance d, one parameter beyond affine: u = c + (M [x; 1] - c) / D.

    D = 1 + r3.(x - reference) / d.  Affine is 1/d = 0, a regular point, so 1/d can be estimated and tested where
    perspective resection is ill-conditioned.  r3 is the viewing direction of M, away from the camera; d is the
    distance along r3 from the camera to the plane through the reference point.  A mirrored image shows as a
    negative 1/d, since reflection turns the direction r3 that M implies round.

    Attributes:
        matrix: M (2, 4), the affine camera that touches this one in the plane r3.(x - reference) = 0.
        inverse_distance_per_mm: 1/d.
        centre_px: c, the principal point (2,), towards which distant points shrink.
        reference_mm: A point (3,) of the plane where the two touch; the origin unless given.
        radial_per_px2: k of radial distortion about c: the pixel above moves by k |u - c|^2 (u - c).
    """

    inverse_distance_per_mm: float
    centre_px: np.ndarray
    reference_mm: np.ndarray = (0.0, 0.0, 0.0)
    radial_per_px2: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
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

    def depth_ratio(self, x: np.ndarray) -> np.ndarray:
        """D (n,) of points (n, 3) mm: distance along the view over d; zero or less behind the camera."""
        return 1.0 + self.inverse_distance_per_mm * ((x - self.reference_mm) @ self.viewing_direction)

    def _undistorted(self, x: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (n, 2) relative to the centre and before distortion, and D (n, 1)."""
        x = points(x, 3, "x")
        ratio = self.depth_ratio(x)[:, None]
        if (ratio <= 0).any():
            raise ValueError("x: a point lies behind the camera; check the units (mm) and the frame.")
        return (x @ self.linear.T + self.offset_px - self.centre_px) / ratio, ratio

    def project(self, x: ArrayLike) -> np.ndarray:
        """Pixels (n, 2) of points (n, 3) in mm; NaN rows stay NaN.

        Raises:
            ValueError: If a point lies behind the camera.
        """
        v = self._undistorted(x)[0]
        return self.centre_px + v * (1.0 + self.radial_per_px2 * (v**2).sum(axis=1, keepdims=True))

    def jacobian(self, x: ArrayLike) -> np.ndarray:
        """Derivative of `project`, (n, 2, 3) px per mm."""
        v, ratio = self._undistorted(x)
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

    def moved(self, motion: RigidTransform) -> Self:
        """As of an affine camera, and the reference point moves along."""
        return replace(super().moved(motion), reference_mm=motion.apply(self.reference_mm))


def radial_derivative(v: np.ndarray, k: float) -> np.ndarray:
    """d/dv of v (1 + k |v|^2), (n, 2, 2), for v (n, 2)."""
    scale = 1.0 + k * (v**2).sum(axis=1)
    return scale[:, None, None] * np.eye(2) + 2.0 * k * v[:, :, None] * v[:, None, :]
