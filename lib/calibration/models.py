"""The ladder of camera models, their analytic Jacobians, and the constrained minimum of the same energy.

A model is a base and options joined by "+":

    affine        8 numbers a camera
    zero_skew     K diagonal (the paper's): rotation, two zooms, two offsets; 7 a camera
    square        one zoom a camera; 6
    common_zoom   one zoom for both; 11 a pair
    +distance     one 1/distance for all cameras (near-affine), +distances one a camera
    +radial       one radial distortion coefficient a camera

"near_affine" is short for "zero_skew+distance".  A state moves by increments; every model is a selection matrix
from its own increments to the increments of its free parameters, so one set of derivatives serves all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from lib.cameras import AffineCamera, Camera, NearAffineCamera, normal_to, radial_derivative
from lib.least_squares import minimise

__all__ = ["Fit", "Model", "State", "fit", "precision"]

BASES = ("affine", "zero_skew", "square", "common_zoom")
OPTIONS = ("distance", "distances", "radial")


@dataclass(frozen=True)
class Model:
    """A rung of the ladder for one or two cameras."""

    base: str
    distance: str | None
    radial: bool
    cameras: int

    @classmethod
    def parse(cls, name: str, cameras: int) -> Model:
        """The model called `name`; a ValueError for an unknown one lists the known ones."""
        base, *options = ("zero_skew+distance" if name == "near_affine" else str(name)).split("+")
        known = base in BASES and all(o in OPTIONS for o in options) and len(set(options)) == len(options)
        if not known or {"distance", "distances"} <= set(options):
            raise ValueError(
                f"model: unknown model {name!r}; take one of {', '.join(BASES)} or near_affine, and add +distance or "
                "+distances, +radial."
            )
        return cls(base, next((o for o in options if o != "radial"), None), "radial" in options, cameras)

    @property
    def is_affine(self) -> bool:
        """True where the projection is linear in the points."""
        return self.distance is None and not self.radial

    @cached_property
    def selection(self) -> np.ndarray:
        """(increments of all cameras, parameters), zeros and ones."""
        return np.array([[float(name == free) for free in self.parameter_names] for name in self._increment_names])

    @cached_property
    def parameter_names(self) -> list[str]:
        """Names of the free increments, with units."""
        return list(dict.fromkeys(name for name in self._increment_names if name))

    @cached_property
    def _increment_names(self) -> list[str]:
        """A name for each increment of all cameras; increments of one name are tied, those without one are fixed."""
        if self.base == "affine":
            names = [f"a{r}{s} (px/mm)" for r in (1, 2) for s in (1, 2, 3)]
        else:
            zoom = {"zero_skew": ["log zoom x", "log zoom y"], "square": ["log zoom"] * 2}
            names = [f"rotation {axis} (rad)" for axis in "xyz"] + zoom.get(self.base, ["both log zoom"] * 2)
        distance = {None: "", "distance": "both 1/distance (1/mm)", "distances": "1/distance (1/mm)"}[self.distance]
        names += ["offset x (px)", "offset y (px)", distance, "radial (1/px^2)" if self.radial else ""]
        sides = ["left ", "right "] if self.cameras == 2 else [""]
        return [n.removeprefix("both ") if n.startswith("both ") else n and side + n for side in sides for n in names]


@dataclass(frozen=True, eq=False)
class State:
    """Cameras about a reference point: u = c + v (1 + k |v|^2), v = (A (x - x0) + o - c) / (1 + rho r3.(x - x0)).

    Attributes:
        A, offset: (cameras, 2, 3), and o (cameras, 2), the pixel of the reference point.
        rho, radial: (cameras,) 1/mm and 1/px^2.
        rotation, zoom: (cameras, 3, 3) and (cameras, 2), A = diag(zoom) rotation[:2]; None for the affine base.
        reference, centre: x0 (3,) mm and c (cameras, 2) px, fixed.
    """

    A: np.ndarray
    offset: np.ndarray
    rho: np.ndarray
    radial: np.ndarray
    rotation: np.ndarray | None
    zoom: np.ndarray | None
    reference: np.ndarray
    centre: np.ndarray

    @classmethod
    def start(cls, model: Model, matrix: np.ndarray, reference: np.ndarray, centre: np.ndarray) -> State:
        """From affine cameras, `matrix` (2 cameras, 4), brought to the model's base."""
        c, zeros = model.cameras, np.zeros(model.cameras)
        A, offset = matrix[:, :3].reshape(c, 2, 3), (matrix[:, :3] @ reference + matrix[:, 3]).reshape(c, 2)
        if model.base == "affine":
            return cls(A, offset, zeros, zeros, None, None, reference, centre)
        rotation, zoom = np.empty((c, 3, 3)), np.empty((c, 2))
        for i in range(c):
            # Polar factors: the orthonormal rows nearest to A's, whichever axis the skew came from.
            left, sizes, right = np.linalg.svd(A[i], full_matrices=False)
            rows = left @ right
            rotation[i] = np.vstack([rows, np.cross(*rows)])
            zoom[i] = np.diag(left @ np.diag(sizes) @ left.T)
        if model.base == "square":
            zoom = np.repeat(zoom.mean(axis=1, keepdims=True), 2, axis=1)
        elif model.base == "common_zoom":
            zoom = np.full((c, 2), zoom.mean())
        return cls(zoom[:, :, None] * rotation[:, :2], offset, zeros, zeros, rotation, zoom, reference, centre)

    def moved(self, increments: np.ndarray) -> State:
        """The state after full increments (cameras * k,)."""
        d = increments.reshape(len(self.A), -1)
        common = {"rho": self.rho + d[:, -2], "radial": self.radial + d[:, -1], "offset": self.offset + d[:, -4:-2]}
        if self.rotation is None:
            return replace(self, A=self.A + d[:, :6].reshape(-1, 2, 3), **common)
        rotation = Rotation.from_rotvec(d[:, :3]).as_matrix() @ self.rotation
        zoom = self.zoom * np.exp(d[:, 3:5])
        return replace(self, A=zoom[:, :, None] * rotation[:, :2], rotation=rotation, zoom=zoom, **common)

    def cameras(self, model: Model) -> tuple[Camera, ...]:
        """The cameras of the public interface."""
        found = []
        for A, o, rho, k, c in zip(self.A, self.offset, self.rho, self.radial, self.centre, strict=True):
            M = np.column_stack([A, o - A @ self.reference])
            found.append(AffineCamera(M) if model.is_affine else NearAffineCamera(M, rho, c, self.reference, k))
        return tuple(found)

    def evaluate(self, x: np.ndarray, *, derivatives: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixels y (n, m), dy/dx (n, m, 3) and dy/d(all increments) (n, m, cameras k) at x - x0 = `x` (n, 3)."""
        n, c = len(x), len(self.A)
        if not (derivatives or self.rho.any() or self.radial.any()):
            A = self.A.reshape(-1, 3)
            return x @ A.T + self.offset.ravel(), np.tile(A, (n, 1, 1)), np.zeros((n, 2 * c, 0))
        k = 10 if self.rotation is None else 9
        y, J_x, J_c = np.empty((n, 2 * c)), np.empty((n, 2 * c, 3)), np.zeros((n, 2 * c, k * c if derivatives else 0))
        for i in range(c):
            rows = slice(2 * i, 2 * i + 2)
            A, centre = self.A[i], self.centre[i]
            normal = normal_to(A)
            size = np.linalg.norm(normal)
            r_3 = normal / size
            depth = x @ r_3
            ratio = (1.0 + self.rho[i] * depth)[:, None]
            v = (x @ A.T + (self.offset[i] - centre)) / ratio
            dv_dx = (A - self.rho[i] * v[:, :, None] * r_3) / ratio[:, :, None]
            bend = radial_derivative(v, self.radial[i]) if self.radial[i] else None
            square = (v**2).sum(axis=1, keepdims=True)
            y[:, rows] = centre + v * (1.0 + self.radial[i] * square)
            J_x[:, rows] = dv_dx if bend is None else bend @ dv_dx
            if not derivatives:
                continue
            dv = np.zeros((n, 2, k))
            if self.rotation is None:
                # d r3 = (I - r3 r3^T) (da1 x a2 + a1 x da2) / |a1 x a2|; v x (d q) = rho x.(d r3) v
                flat = (x - depth[:, None] * r_3) / size
                dv[:, 0, 0:3] = dv[:, 1, 3:6] = x
                tilt = np.hstack([np.cross(A[1], flat), np.cross(flat, A[0])])  # x.(d r3) per entry of A
                dv[:, :, :6] -= self.rho[i] * v[:, :, None] * tilt[:, None, :]
            else:
                R, zoom = self.rotation[i], self.zoom[i]
                p = x @ R.T  # camera axes; a left increment turns p by delta x p
                dv[:, 0, 1], dv[:, 0, 2] = zoom[0] * p[:, 2], -zoom[0] * p[:, 1]
                dv[:, 1, 0], dv[:, 1, 2] = -zoom[1] * p[:, 2], zoom[1] * p[:, 0]
                dv[:, 0, 3], dv[:, 1, 4] = zoom[0] * p[:, 0], zoom[1] * p[:, 1]
                turn = np.stack([p[:, 1], -p[:, 0], np.zeros(n)], axis=1)  # third component of delta x p
                dv[:, :, :3] -= self.rho[i] * v[:, :, None] * turn[:, None, :]
            dv[:, 0, k - 4] = dv[:, 1, k - 3] = 1.0
            dv[:, :, k - 2] = -v * depth[:, None]
            dv /= ratio[:, :, None]
            if bend is not None:
                dv = bend @ dv
            dv[:, :, k - 1] = v * square
            J_c[:, rows, i * k : (i + 1) * k] = dv
        return y, J_x, J_c

    def matrix_jacobian(self) -> np.ndarray:
        """Derivative of the matrices' entries (8 a camera, row by row, left first) by the full increments."""
        c = len(self.A)
        plain = replace(self, rho=np.zeros(c), radial=np.zeros(c), centre=np.zeros((c, 2)))
        J = plain.evaluate(np.vstack([np.eye(3), np.zeros(3)]))[2]
        k = J.shape[2] // c
        J[:, :, [i * k + j for i in range(c) for j in (k - 2, k - 1)]] = 0.0
        columns = J[:3] - J[3]
        offset = J[3] - np.tensordot(self.reference, columns, axes=1)
        return np.concatenate([columns, offset[None]]).transpose(1, 0, 2).reshape(8 * c, -1)


@dataclass(frozen=True, eq=False)
class Fit:
    """A minimum: the state, the energy `cost`, the corrected points x~ - x0 (n, 3), and what uncertainty needs.

    The `residuals` (n, m) px are linearised, y - f(x~) - J (x - x~), so that their covariance is Sigma + v_x J J^T;
    `information` (p, p) is the Gauss-Newton Hessian in the model's parameters.
    """

    state: State
    cost: float
    residuals: np.ndarray
    points: np.ndarray
    information: np.ndarray
    converged: bool


def precision(covariance: np.ndarray, views: np.ndarray) -> np.ndarray:
    """Inverses (k, m, m) of covariances (k, m, m) of which only the `views` (k, cameras) bool are known; zero elsewhere.

    It is the limit of the inverse where the covariance of the other views grows beyond all bounds.
    """
    if views.all():
        return np.linalg.inv(covariance)
    used = np.repeat(views, 2, axis=1)
    both = used[:, :, None] & used[:, None, :]
    return np.where(both, np.linalg.inv(np.where(both, covariance, np.eye(used.shape[1]))), 0.0)


def settle(
    state: State, x: np.ndarray, y: np.ndarray, noise: np.ndarray, variance_x: float, views: np.ndarray, linear: bool
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """Best corrected points of a state: cost, linearised residuals (zero in views not used), x~, S^-1."""
    points, rounds = x, 1 if linear or variance_x == 0 else 4
    kinds, kind = views, slice(None)
    if linear and len(noise) == 1:  # rows of equal covariance and equal views share one inverse
        _, first, kind = np.unique(views @ [1, 2][: views.shape[1]], return_index=True, return_inverse=True)
        kinds, kind = views[first], kind if len(first) > 1 else slice(None)
    for _ in range(rounds):
        f, J, _ = state.evaluate(points, derivatives=False)
        if linear:
            J = J[:1]
        r = y - f - np.einsum("nij,nj->ni", np.broadcast_to(J, (len(x), *J.shape[1:])), x - points)
        covariance = noise + variance_x * J @ np.swapaxes(J, 1, 2)
        weight = precision(np.broadcast_to(covariance, (len(kinds), *covariance.shape[1:])), kinds)[kind]
        white = (weight @ r[:, :, None])[:, :, 0]
        points = x + variance_x * (np.swapaxes(J, 1, 2) @ white[:, :, None])[:, :, 0]
    return 0.5 * float((r * white).sum()), np.where(np.repeat(views, 2, axis=1), r, 0.0), points, weight


def fit(
    model: Model, start: State, x: np.ndarray, y: np.ndarray, noise: np.ndarray, variance_x: float, views: np.ndarray
) -> Fit:
    """Minimum of 1/2 sum (y - f(x~))^T noise^-1 (y - f(x~)) + |x~ - x|^2 / variance_x by Levenberg-Marquardt.

    Every point is eliminated exactly, which leaves residuals of covariance S = noise + variance_x J J^T and a system in the
    camera parameters alone.  x (n, 3) is in mm from the state's reference, y (n, m) in px, noise (1 or n, m, m) in px^2; only
    the `views` (n, cameras) bool count.
    """
    T = model.selection
    y = np.where(np.repeat(views, 2, axis=1), y, 0.0)

    def evaluate(state: State) -> tuple[float, tuple] | None:
        for A, rho in zip(state.A, state.rho, strict=True):
            normal = normal_to(A)
            if rho and (1.0 + rho * (x @ normal) / np.linalg.norm(normal)).min() <= 0.05:
                return None  # a point lies behind the camera
        cost, *work = settle(state, x, y, noise, variance_x, views, model.is_affine)
        return (cost, work) if np.isfinite(cost) else None

    def normal_equations(state: State, work: tuple) -> tuple[np.ndarray, np.ndarray]:
        r, settled, weight = work
        J = state.evaluate(settled)[2] @ T
        WJ = (np.broadcast_to(weight, (len(x), *weight.shape[1:])) @ J).reshape(-1, J.shape[2])
        return J.reshape(WJ.shape).T @ WJ, WJ.T @ r.ravel()

    with np.errstate(all="ignore"):  # a first step may be far too long: its energy is not finite, and it is shortened
        found = minimise(start, evaluate, normal_equations, lambda state, step: state.moved(T @ step))
    r, settled, _ = found.work
    return Fit(found.state, found.energy, r, settled, found.information, found.converged)
