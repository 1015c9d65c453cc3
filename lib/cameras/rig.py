"""The calibrated stereo pair: projection, epipolar geometry, triangulation.

Two affine cameras stack to y = A x + t with y = (u_left, u_right), A (4, 3): four numbers that hold a 3D point and one
epipolar residual, so triangulation and epipolar geometry are one small constant matrix.  Near-affine pairs take
Gauss-Newton steps on the pixels.
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
from lib.files import write_json
from lib.geometry import RigidTransform, pair_covariance, points

FORMAT = "microstereo.stereo_rig"
UNITS = {"point": "mm", "image": "px"}
_Pair = tuple[MatrixCamera, MatrixCamera]
#: Points at a time: few enough for their arrays to stay in the processor's cache.
_BLOCK = 8192


@dataclass(frozen=True)
class Points:
    """Triangulated points: `x_mm` (n, 3), `covariance_mm2` (n, 3, 3), signed `epipolar_px` residual (n,)."""

    x_mm: np.ndarray
    covariance_mm2: np.ndarray
    epipolar_px: np.ndarray


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
        return float(np.arccos(np.clip(self.left.viewing_direction @ self.right.viewing_direction, -1.0, 1.0)))

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
        u_left, u_right = _matches(u_left, u_right)
        n, covariance = len(u_left), pair_covariance(covariance_px2, len(u_left))
        if not self.is_affine:
            y = np.hstack([u_left, u_right])
            return _triangulate_near_affine((self.left, self.right), y, covariance, self.epipolar_normal)
        # A row a coordinate: numpy works on long rows about twice as fast as on short ones.
        y = np.vstack([u_left.T, u_right.T]) - self.offset_px[:, None]
        weight_A = np.linalg.solve(covariance, np.broadcast_to(self.linear, (len(covariance), 4, 3)))
        covariance_mm2 = np.linalg.inv(self.linear.T @ weight_A)
        gain = covariance_mm2 @ weight_A.mT
        x = (gain[0] @ y).T if len(gain) == 1 else np.einsum("nij,jn->ni", gain, y)
        return Points(x, np.broadcast_to(covariance_mm2, (n, 3, 3)), self.epipolar_normal @ y)

    def jacobian(self, x: ArrayLike) -> np.ndarray:
        """Derivative of the four pixel coordinates, (n, 4, 3) px per mm."""
        return np.concatenate([self.left.jacobian(x), self.right.jacobian(x)], axis=1)

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
            why = f"{type(error).__name__}: {error}"
            raise ValueError(f"{path}: not a stereo rig written by StereoRig.save ({why}).") from None


def _matches(u_left: ArrayLike, u_right: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    u_left, u_right = points(u_left, 2, "u_left"), points(u_right, 2, "u_right")
    if len(u_left) != len(u_right):
        raise ValueError(f"u_left, u_right: {len(u_left)} and {len(u_right)} points; matches come in pairs.")
    return u_left, u_right


def _triangulate_near_affine(
    cameras: _Pair, y: np.ndarray, covariance: np.ndarray, affine_normal: np.ndarray, steps: int = 2
) -> Points:
    """Linear for each point (the projection's denominator multiplied out), then Gauss-Newton steps on the pixels.

    Args:
        y: (n, 4) left and right pixels; NaN rows stay NaN, and so does a match that only a point behind a camera
            explains.
        covariance: (1, 4, 4) or (n, 4, 4), as `lib.geometry.pair_covariance` gives it.
        affine_normal: (4,) of the pair of affine cameras, which says the sign of the epipolar residuals.
    """
    n = len(y)
    x, covariance_mm2, epipolar = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan), np.full(n, np.nan)
    known = np.flatnonzero(np.isfinite(y).all(axis=1))
    for start in range(0, len(known), _BLOCK):
        rows = known[start : start + _BLOCK]
        W = np.linalg.inv(covariance if len(covariance) == 1 else covariance[rows])
        found, in_front = _linear(cameras, y[rows]), np.ones(len(rows), dtype=bool)
        for _ in range(steps):
            J, r, ahead = _linearised(cameras, found, y[rows])
            in_front &= ahead
            found = found + _step(J, r, W)[0]
        J, r, ahead = _linearised(cameras, found, y[rows])
        in_front &= ahead
        x[rows[in_front]], covariance_mm2[rows[in_front]] = found[in_front], _step(J, r, W)[1][in_front]
        off = r - (J @ _step(J, r, np.eye(4))[0][:, :, None])[:, :, 0]  # what no point explains: along the epipolar normal
        epipolar[rows[in_front]] = (np.sign(off @ affine_normal) * np.linalg.norm(off, axis=1))[in_front]
    return Points(x, covariance_mm2, epipolar)


def _linear(cameras: _Pair, y: np.ndarray) -> np.ndarray:
    """x (n, 3) from P_i [x; 1] - u_i P_3 [x; 1] = 0 for undistorted pixels."""
    rows, right_hand = [], []
    for camera, u in zip(cameras, (y[:, :2], y[:, 2:]), strict=True):
        P, u = camera.projection_matrix, camera.undistort(u) if isinstance(camera, NearAffineCamera) else u
        rows.append(P[:2, :3] - u[:, :, None] * P[2, :3])
        right_hand.append(u * P[2, 3] - P[:2, 3])
    return _step(np.concatenate(rows, axis=1), np.concatenate(right_hand, axis=1), np.eye(4))[0]


def _linearised(cameras: _Pair, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Jacobian (n, 4, 3), residuals (n, 4), and which points lie before both cameras; the others stand at the centre."""
    in_front = np.all([camera.depth_ratio(x) > 0 for camera in cameras if isinstance(camera, NearAffineCamera)], axis=0)
    safe = np.where(in_front[:, None], x, getattr(cameras[0], "reference_mm", np.zeros(3)))
    J = np.concatenate([camera.jacobian(safe) for camera in cameras], axis=1)
    return J, y - np.hstack([camera.project(safe) for camera in cameras]), in_front


def _step(J: np.ndarray, r: np.ndarray, W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted least squares of r = J x: x (n, 3) and the inverse (n, 3, 3) of the normal matrix; NaN where it has none."""
    WJ = W @ J
    normal = J.mT @ WJ
    inverse = np.linalg.inv(np.where(np.linalg.det(normal)[:, None, None] == 0, np.nan, normal))
    return (inverse @ (WJ.mT @ r[..., None]))[..., 0], inverse
