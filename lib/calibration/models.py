"""The camera models, their analytic Jacobians, and the minimum of the energy under each model.

A step adds increments to a state.  Each model has a selection matrix from its free parameters to the increments of all
cameras, so all models share the same derivatives.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from scipy.spatial.transform import Rotation

from lib.cameras import AffineCamera, Camera, NearAffineCamera, radial_derivative
from lib.geometry import precision
from lib.least_squares import Minimum, minimise

BASES = ("affine", "zero_skew", "square", "common_zoom")
OPTIONS = ("distance", "distances", "radial")
_CROSS = np.cross(np.eye(3)[:, None], np.eye(3))  # (3, 3, 3): cross products of all pairs of unit vectors


@dataclass(frozen=True)
class Model:
    """A model of one or two cameras: a base and options joined by "+".

    affine        8 parameters a camera
    zero_skew     K diagonal (the paper's): rotation, two zooms, two offsets; 7 a camera
    square        one zoom a camera; 6
    common_zoom   one zoom for both; 11 a pair
    +distance     one 1/distance for all cameras (near-affine), +distances one a camera
    +radial       one radial distortion coefficient a camera
    """

    base: str
    distance: str | None
    radial: bool
    cameras: int

    @classmethod
    def parse(cls, name: str, cameras: int) -> Self:
        """The model called `name`; a ValueError refuses an unknown name and lists the known ones."""
        base, *options = str(name).replace("near_affine", "zero_skew+distance").split("+")
        known = base in BASES and all(o in OPTIONS for o in options) and len(set(options)) == len(options)
        if not known or {"distance", "distances"} <= set(options):
            names = f"{', '.join(BASES)} or near_affine, and add +distance or +distances, +radial"
            raise ValueError(f"model: unknown model {name!r}; take one of {names}.")
        return cls(base, next((o for o in options if o != "radial"), None), "radial" in options, cameras)

    @property
    def is_affine(self) -> bool:
        """True if the projection is affine: no distance, no distortion."""
        return self.distance is None and not self.radial

    @cached_property
    def selection(self) -> np.ndarray:
        """(cameras, increments a camera, parameters): 1 where a parameter moves an increment, else 0."""
        chosen = [[float(name == free) for free in self.parameter_names] for name in self._increment_names]
        return np.reshape(chosen, (self.cameras, -1, len(self.parameter_names)))

    @cached_property
    def parameter_names(self) -> list[str]:
        """Names of the free increments, with units."""
        return list(dict.fromkeys(name for name in self._increment_names if name))

    @cached_property
    def _increment_names(self) -> list[str]:
        """The parameter of each increment of all cameras; increments with the same name are tied, those with "" are fixed."""
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
        model: Defines the parameters that steps and derivatives refer to.
        A, offset: (cameras, 2, 3) px/mm, and o (cameras, 2), the pixel of the reference point.
        rho, radial: (cameras,) 1/distance in 1/mm, and the distortion k in 1/px^2.
        reference, centre: x0 (3,) mm and c (cameras, 2) px; both stay fixed.
    """

    model: Model
    A: np.ndarray
    offset: np.ndarray
    rho: np.ndarray
    radial: np.ndarray
    reference: np.ndarray
    centre: np.ndarray

    @classmethod
    def start(cls, model: Model, matrix: np.ndarray, reference: np.ndarray, centre: np.ndarray) -> Self:
        """A state from affine cameras, `matrix` (2 or 4, 4), constrained to the model's base."""
        A, zeros = matrix[:, :3].reshape(-1, 2, 3), np.zeros(model.cameras)
        offset = (matrix[:, :3] @ reference + matrix[:, 3]).reshape(-1, 2)
        if model.base != "affine":
            # Polar decomposition: the orthonormal rows nearest to those of A; it favours neither image axis.
            left, sizes, right = np.linalg.svd(A, full_matrices=False)
            zoom = np.einsum("cij,cj,cij->ci", left, sizes, left)
            tied = {"zero_skew": (), "square": 1, "common_zoom": (0, 1)}[model.base]
            A = np.mean(zoom, axis=tied, keepdims=True)[:, :, None] * (left @ right)
        return cls(model, A, offset, zeros, zeros, reference, centre)

    @cached_property
    def zoom(self) -> np.ndarray:
        """(cameras, 2) px/mm, for bases other than affine."""
        return np.linalg.norm(self.A, axis=2)

    @cached_property
    def rotation(self) -> np.ndarray:
        """(cameras, 3, 3), for bases other than affine: A = diag(zoom) rotation[:2]."""
        rows = self.A / self.zoom[:, :, None]
        return np.concatenate([rows, np.cross(rows[:, :1], rows[:, 1:])], axis=1)

    @cached_property
    def normals(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit normals r3 (cameras, 3) to the rows of A, away from the camera, and the lengths |a1 x a2| (cameras,)."""
        normal = np.cross(self.A[:, 0], self.A[:, 1])
        size = np.linalg.norm(normal, axis=1)
        return normal / size[:, None], size

    def moved(self, step: np.ndarray) -> Self:
        """The state after a step (p,) in the model's parameters."""
        d = self.model.selection @ step
        common = {"rho": self.rho + d[:, -2], "radial": self.radial + d[:, -1], "offset": self.offset + d[:, -4:-2]}
        if self.model.base == "affine":
            return replace(self, A=self.A + d[:, :6].reshape(-1, 2, 3), **common)
        rotation = Rotation.from_rotvec(d[:, :3]).as_matrix() @ self.rotation
        return replace(self, A=(self.zoom * np.exp(d[:, 3:5]))[:, :, None] * rotation[:, :2], **common)

    def cameras(self) -> tuple[Camera, ...]:
        """The state as camera objects of `lib.cameras`."""
        found = []
        for A, o, rho, k, c in zip(self.A, self.offset, self.rho, self.radial, self.centre, strict=True):
            M = np.column_stack([A, o - A @ self.reference])
            found.append(AffineCamera(M) if self.model.is_affine else NearAffineCamera(M, rho, c, self.reference, k))
        return tuple(found)

    def evaluate(self, x_mm: np.ndarray, *, derivatives: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixels y (n, m) of points (n, 3) mm, dy/dx (n, m, 3) and the derivatives by the model's parameters (n, m, p)."""
        x, n, c = x_mm - self.reference, len(x_mm), len(self.A)
        if not (self.rho.any() or self.radial.any() or (derivatives and not self.model.is_affine)):
            A, D = self.A.reshape(-1, 3), self._linear() if derivatives else np.empty((2 * c, 4, 0))
            J_c = (np.column_stack([x, np.ones(n)]) @ D.swapaxes(0, 1).reshape(4, -1)).reshape(n, 2 * c, D.shape[2])
            return x @ A.T + self.offset.ravel(), np.broadcast_to(A, (n, *A.shape)), J_c
        r_3, size = self.normals
        depth = x @ r_3.T
        ratio = (1.0 + self.rho * depth)[:, :, None]  # (n, cameras, 1)
        v = ((x @ self.A.reshape(-1, 3).T).reshape(n, c, 2) + (self.offset - self.centre)) / ratio
        bend, square = radial_derivative(v, self.radial), (v**2).sum(axis=2, keepdims=True)
        y = (self.centre + v * (1.0 + self.radial[:, None] * square)).reshape(n, 2 * c)
        J_x = bend @ ((self.A - self.rho[:, None, None] * v[:, :, :, None] * r_3[:, None]) / ratio[:, :, :, None])
        if not derivatives:
            return y, J_x.reshape(n, 2 * c, 3), np.empty((n, 2 * c, 0))
        # Derivatives by the entries of A: d r3 = (I - r3 r3^T) (da1 x a2 + a1 x da2) / |a1 x a2|
        flat = (x[:, None] - depth[:, :, None] * r_3) / size[:, None]
        turned = np.einsum("jks,crk->csrj", _CROSS, np.stack([self.A[:, 1], -self.A[:, 0]], axis=1)).reshape(c, 3, 6)
        dv = -self.rho[:, None, None] * v[:, :, :, None] * (flat[:, :, None] @ turned)  # x.(d r3)
        dv[:, :, 0, 0:3] += x[:, None]
        dv[:, :, 1, 3:6] += x[:, None]
        offset, distance = np.broadcast_to(np.eye(2), (n, c, 2, 2)), -(v * depth[:, :, None])[:, :, :, None]
        dv = np.concatenate([dv @ self._entries.reshape(c, 6, -1), offset, distance], axis=3) / ratio[:, :, :, None]
        dv = np.concatenate([bend @ dv, (v * square)[:, :, :, None]], axis=3)
        return y, J_x.reshape(n, 2 * c, 3), (dv @ self.model.selection).reshape(n, 2 * c, len(self.model.parameter_names))

    @cached_property
    def _entries(self) -> np.ndarray:
        """Derivatives of the entries of A by each camera's own 6 or 5 increments, (cameras, 2, 3, 6 or 5)."""
        c = len(self.A)
        if self.model.base == "affine":
            return np.tile(np.eye(6).reshape(2, 3, 6), (c, 1, 1, 1))
        result = np.zeros((c, 2, 3, 5))
        # R <- exp(delta) R: the derivative of R is delta x R.
        result[..., :3] = self.zoom[:, :, None, None] * np.einsum("jkr,cks->crsj", _CROSS, self.rotation)[:, :2]
        result[:, 0, :, 3], result[:, 1, :, 4] = self.A[:, 0], self.A[:, 1]
        return result

    def _linear(self) -> np.ndarray:
        """Derivatives of the matrices [A, o] about the reference point by the model's parameters, (2 cameras, 4, p)."""
        result = np.zeros((len(self.A), 2, 4, self.model.selection.shape[1]))
        result[..., :3, :-4], result[..., 3, -4:-2] = self._entries, np.eye(2)
        return (result @ self.model.selection[:, None]).reshape(2 * len(self.A), 4, -1)

    def matrix_jacobian(self) -> np.ndarray:
        """Derivatives of the matrices' entries (8 a camera, row by row, left first) by the model's parameters."""
        result = self._linear()
        result[:, 3] -= self.reference @ result[:, :3]
        return result.reshape(-1, result.shape[2])


class Corrected(NamedTuple):
    """What `settle` finds: the corrected points x~ (n, 3), residuals, and the inverse covariances S^-1 of the residuals.

    The `residuals` (n, m) px, 0 in unused views, are linearised, y - f(x~) - J (x - x~), so that S = noise + v_x J J^T.
    """

    residuals: np.ndarray
    points: np.ndarray
    weight: np.ndarray


def settle(
    state: State, x: np.ndarray, y: np.ndarray, noise: np.ndarray, variance_x: float, views: np.ndarray
) -> tuple[float, Corrected]:
    """The energy of a state, and the corrected points x~ that minimise it."""
    points, linear = x, state.model.is_affine
    for _ in range(1 if linear or variance_x == 0 else 4):
        f, J, _ = state.evaluate(points, derivatives=False)
        J = J[:1] if linear else J
        r = y - f - ((x - points)[:, None] @ J.mT)[:, 0]
        weight = precision(noise + variance_x * J @ J.mT, views)
        white = (weight @ r[:, :, None])[:, :, 0]
        points = x + variance_x * (white[:, None] @ J)[:, 0]
    return 0.5 * float((r * white).sum()), Corrected(np.where(np.repeat(views, 2, axis=1), r, 0.0), points, weight)


def fit(start: State, x: np.ndarray, y: np.ndarray, noise: np.ndarray, variance_x: float, views: np.ndarray) -> Minimum:
    """Minimum of 1/2 sum (y - f(x~))^T noise^-1 (y - f(x~)) + |x~ - x|^2 / variance_x by Levenberg-Marquardt.

    Eliminating every point exactly gives residuals of covariance S = noise + variance_x J J^T and a system in the camera
    parameters alone.  x (n, 3) is in mm, y (n, m) in px, noise (1 or n, m, m) in px^2; `views` (n, cameras) bool are used.
    The minimum's `work` is `Corrected`.
    """
    y = np.where(np.repeat(views, 2, axis=1), y, 0.0)

    def evaluate(state: State) -> tuple[float, Corrected] | None:
        if state.rho.any() and (1.0 + state.rho * ((x - state.reference) @ state.normals[0].T)).min() <= 0.05:
            return None  # a point lies behind a camera
        found = settle(state, x, y, noise, variance_x, views)
        return found if np.isfinite(found[0]) else None

    def normal_equations(state: State, work: Corrected) -> tuple[np.ndarray, np.ndarray]:
        J = state.evaluate(work.points)[2]
        WJ = (work.weight @ J).reshape(-1, J.shape[2])
        return J.reshape(WJ.shape).T @ WJ, WJ.T @ work.residuals.ravel()

    with np.errstate(all="ignore"):  # a first step may be so long that its energy is not finite; it is then shortened
        # With a tolerance of 1e-10 the error is about a ten-thousandth of a standard deviation.
        return minimise(start, evaluate, normal_equations, State.moved, tolerance=1e-10)
