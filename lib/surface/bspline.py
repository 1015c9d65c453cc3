"""Uniform bicubic B-splines over an image: basis, exact bending energy, and surfaces R^2 -> R^3 (paper Sec. IV-B).

The parameter is the left image point u = (x, y) px.  A grid of ``control = (n_x, n_y)`` control points covers the
domain (x0, y0, x1, y1) with (n_x - 3) x (n_y - 3) cells, so the control points reach one cell beyond it on each side.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from lib.geometry import points

if TYPE_CHECKING:
    from lib.cameras import AffineCamera
    from lib.surface.fitting import SurfaceFit

__all__ = ["BSplineSurface", "Curvature", "SplineGrid", "ToolDistance", "cubic_basis"]

# Element matrices of one span of width 1: integrals over it of products of the four cubic basis functions that live
# there, and of their first and second derivatives.  Summed over the spans they give the Gram matrices exactly.
_ELEMENT = (
    np.array([[20, 129, 60, 1], [129, 1188, 933, 60], [60, 933, 1188, 129], [1, 60, 129, 20]]) / 5040.0,
    np.array([[6, 7, -12, -1], [7, 34, -29, -12], [-12, -29, 34, 7], [-1, -12, 7, 6]]) / 120.0,
    np.array([[2, -3, 0, 1], [-3, 6, -3, 0], [0, -3, 6, -3], [1, 0, -3, 2]]) / 6.0,
)


def cubic_basis(t: np.ndarray, derivative: int = 0) -> np.ndarray:
    """The four uniform cubic B-splines that live on a span, (..., 4), at t in [0, 1], or a derivative in t."""
    s = 1.0 - t
    if derivative == 0:
        return np.stack([s**3, (3 * t - 6) * t**2 + 4, (3 * s - 6) * s**2 + 4, t**3], axis=-1) / 6
    if derivative == 1:
        return np.stack([-(s**2), (3 * t - 4) * t, (4 - 3 * s) * s, t**2], axis=-1) / 2
    if derivative == 2:
        return np.stack([s, 3 * t - 2, 3 * s - 2, t], axis=-1)
    raise ValueError(f"derivative: 0, 1 or 2, got {derivative}.")


def _gram(n: int, derivative: int) -> sparse.csr_matrix:
    """Integrals (n, n) over the domain of products of the basis functions' derivatives, spans of width 1."""
    cell = np.arange(n - 3)[:, None, None]
    row, column = np.broadcast_arrays(cell + np.arange(4)[:, None], cell + np.arange(4))
    values = np.broadcast_to(_ELEMENT[derivative], row.shape)
    return sparse.csr_matrix((values.ravel(), (row.ravel(), column.ravel())), shape=(n, n))


@dataclass(frozen=True)
class SplineGrid:
    """Where the control points of a bicubic spline lie.

    Coefficients are flat vectors (n_x n_y,) whose fast axis is the shorter side of the grid: this makes every matrix
    of the fit as narrow-banded as can be.

    Attributes
    ----------
    domain:
        (x0, y0, x1, y1) px.
    control:
        (n_x, n_y), each at least 4.
    """

    domain: tuple[float, float, float, float]
    control: tuple[int, int]

    def __post_init__(self) -> None:
        domain = np.asarray(self.domain, dtype=np.float64)
        if domain.shape != (4,) or not np.isfinite(domain).all() or not (domain[:2] < domain[2:]).all():
            raise ValueError(f"domain: expected (x0, y0, x1, y1) px with x0 < x1 and y0 < y1, got {self.domain}.")
        control = np.asarray(self.control)
        if control.shape != (2,) or not np.issubdtype(control.dtype, np.integer) or control.min() < 4:
            raise ValueError(f"control: expected (n_x, n_y) control points, 4 or more each, got {self.control}.")
        object.__setattr__(self, "domain", tuple(float(v) for v in domain))
        object.__setattr__(self, "control", tuple(int(v) for v in control))

    @property
    def size(self) -> int:
        """Number of control points."""
        return self.control[0] * self.control[1]

    @property
    def cells(self) -> tuple[int, int]:
        """(n_x - 3, n_y - 3)."""
        return self.control[0] - 3, self.control[1] - 3

    @property
    def cell_px(self) -> np.ndarray:
        """Width and height (2,) of a cell."""
        x0, y0, x1, y1 = self.domain
        return np.array([x1 - x0, y1 - y0]) / self.cells

    @property
    def stride(self) -> tuple[int, int]:
        """Steps of the flat index for one control point to the right, and for one down."""
        n_x, n_y = self.control
        return (1, n_x) if n_x <= n_y else (n_y, 1)

    @property
    def bandwidth(self) -> int:
        """Number of diagonals below the main one that matrices of this grid fill."""
        return 3 * sum(self.stride)

    def inside(self, u: np.ndarray) -> np.ndarray:
        """Which of the points (n, 2) lie in the domain, borders included; NaN does not."""
        x0, y0, x1, y1 = self.domain
        return (u[:, 0] >= x0) & (u[:, 0] <= x1) & (u[:, 1] >= y0) & (u[:, 1] <= y1)

    def locate(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cell (n, 2) int of each point, and its place (n, 2) in that cell, in [0, 1] for points inside."""
        position = (u - self.domain[:2]) / self.cell_px
        cell = np.clip(np.floor(position), 0, np.array(self.cells) - 1).astype(np.intp)
        return cell, position - cell

    def design(self, u: np.ndarray, derivative: tuple[int, int] = (0, 0)) -> sparse.csr_matrix:
        """B (n, size) with 16 entries a row: B @ coefficients is the spline, or its derivative per px, at u (n, 2)."""
        cell, t = self.locate(u)
        scale = self.cell_px ** -np.array(derivative, dtype=float)
        along_x = cubic_basis(t[:, 0], derivative[0]) * scale[0]
        along_y = cubic_basis(t[:, 1], derivative[1]) * scale[1]
        step_x, step_y = self.stride
        offset = np.arange(4, dtype=np.int32)[:, None] * step_y + np.arange(4, dtype=np.int32) * step_x
        columns = (cell @ self.stride).astype(np.int32)[:, None, None] + offset
        values = along_y[:, :, None] * along_x[:, None, :]
        indptr = np.arange(0, 16 * len(u) + 1, 16, dtype=np.int32)
        return sparse.csr_matrix((values.ravel(), columns.ravel(), indptr), shape=(len(u), self.size))

    @cached_property
    def bending(self) -> sparse.csr_matrix:
        """R (size, size): c.R.c = integral over the domain of s_xx^2 + 2 s_xy^2 + s_yy^2, exact (per px^2, over px^2).

        Its null space is the linear functions, of dimension 3.
        """
        (n_x, n_y), (h_x, h_y) = self.control, self.cell_px
        gram_x = [_gram(n_x, k) * h_x ** (1 - 2 * k) for k in range(3)]
        gram_y = [_gram(n_y, k) * h_y ** (1 - 2 * k) for k in range(3)]
        slow, fast = (gram_y, gram_x) if self.stride[0] == 1 else (gram_x, gram_y)
        terms = ((1.0, 2, 0), (2.0, 1, 1), (1.0, 0, 2))
        bending = sum(factor * sparse.kron(slow[p], fast[q], format="csr") for factor, p, q in terms).tocsr()
        bending.eliminate_zeros()  # kron stores whole blocks
        return bending

    def flatten(self, control_points: np.ndarray) -> np.ndarray:
        """Coefficients (size, k) of control points (n_y, n_x, k)."""
        array = control_points if self.stride[0] == 1 else control_points.swapaxes(0, 1)
        return array.reshape(self.size, -1)

    def unflatten(self, coefficients: np.ndarray) -> np.ndarray:
        """Control points (n_y, n_x, k) of coefficients (size, k)."""
        n_x, n_y = self.control
        if self.stride[0] == 1:
            return coefficients.reshape(n_y, n_x, -1)
        return coefficients.reshape(n_x, n_y, -1).swapaxes(0, 1)

    @property
    def sites(self) -> np.ndarray:
        """Image points (n_y, n_x, 2) of the control points: f(sites) as control points reproduce a linear f exactly."""
        (n_x, n_y), cell = self.control, self.cell_px
        x = self.domain[0] + (np.arange(n_x) - 1) * cell[0]
        y = self.domain[1] + (np.arange(n_y) - 1) * cell[1]
        return np.stack(np.meshgrid(x, y), axis=-1)


@dataclass(frozen=True)
class Curvature:
    """Principal curvatures (n,) per mm, `minimum` <= `maximum`; positive where the surface is a bowl to the camera."""

    minimum: np.ndarray
    maximum: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """Mean curvature (n,) per mm."""
        return (self.minimum + self.maximum) / 2

    @property
    def gaussian(self) -> np.ndarray:
        """Gaussian curvature (n,) per mm^2."""
        return self.minimum * self.maximum


@dataclass(frozen=True)
class ToolDistance:
    """Distance of points to a surface; positive on the camera's side of it, NaN outside the domain.

    Attributes
    ----------
    along_view_mm:
        (n,) to the surface point that the camera sees behind the tool.
    along_normal_mm:
        (n,) to the nearest surface point.
    nearest_mm, nearest_u:
        That nearest point (n, 3) and its parameter (n, 2).
    """

    along_view_mm: np.ndarray
    along_normal_mm: np.ndarray
    nearest_mm: np.ndarray
    nearest_u: np.ndarray


@dataclass(frozen=True, eq=False)
class BSplineSurface:
    """x = Psi(u), a bicubic B-spline from left image points (px) to points (mm, the frame of the fitted points).

    Attributes
    ----------
    grid:
        Domain and number of control points.
    control_points_mm:
        (n_y, n_x, 3).
    fit:
        How it was found: data term, smoothness, inliers, certificate (`lib.surface.fitting.SurfaceFit`); None for a
        surface that was not fitted.
    """

    grid: SplineGrid
    control_points_mm: np.ndarray
    fit: SurfaceFit | None = None

    def __post_init__(self) -> None:
        control_points = np.array(self.control_points_mm, dtype=np.float64)
        n_x, n_y = self.grid.control
        if control_points.shape != (n_y, n_x, 3) or not np.isfinite(control_points).all():
            raise ValueError(f"control_points_mm: expected finite ({n_y}, {n_x}, 3), got {control_points.shape}.")
        control_points.setflags(write=False)
        object.__setattr__(self, "control_points_mm", control_points)

    def __call__(self, u: ArrayLike) -> np.ndarray:
        """Points (n, 3) mm at image points (n, 2) px; NaN outside the domain."""
        return self.derivative(u, (0, 0))

    def derivative(self, u: ArrayLike, order: tuple[int, int]) -> np.ndarray:
        """d^(p+q) Psi / dx^p dy^q, (n, 3) mm per px^(p+q), for order (p, q), each up to 2; NaN outside the domain."""
        u = points(u, 2, "u")
        result = np.full((len(u), 3), np.nan)
        inside = self.grid.inside(u)
        result[inside] = self.grid.design(u[inside], order) @ self.grid.flatten(self.control_points_mm)
        return result

    def on_grid(self, x_px: ArrayLike, y_px: ArrayLike) -> np.ndarray:
        """Points (len(y), len(x), 3) on the lattice of columns `x_px` and rows `y_px`: fast for whole images."""
        bases, outside = [], []
        axes = zip((x_px, y_px), self.grid.domain[:2], self.grid.cell_px, self.grid.control, strict=True)
        for values, low, cell, n in axes:
            position = (np.asarray(values, dtype=np.float64) - low) / cell
            index = np.clip(np.floor(np.nan_to_num(position)), 0, n - 4).astype(np.intp)
            basis = np.zeros((len(position), n))
            basis[np.arange(len(position))[:, None], index[:, None] + np.arange(4)] = cubic_basis(position - index)
            bases.append(basis)
            outside.append(~((position >= 0) & (position <= n - 3)))
        rows = np.tensordot(bases[1], self.control_points_mm, axes=(1, 0))
        result = np.matmul(bases[0], rows)
        result[outside[1]] = np.nan
        result[:, outside[0]] = np.nan
        return result

    def normal(self, u: ArrayLike) -> np.ndarray:
        """Unit normals (n, 3), towards the camera (for an unmirrored camera in a right-handed frame)."""
        normal = np.cross(self.derivative(u, (0, 1)), self.derivative(u, (1, 0)))
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def curvature(self, u: ArrayLike) -> Curvature:
        """Principal curvatures from the first and second fundamental forms (do Carmo, Sec. 3-3), analytic."""
        d_x, d_y = self.derivative(u, (1, 0)), self.derivative(u, (0, 1))
        normal = np.cross(d_y, d_x)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        E, F, G = (np.einsum("nk,nk->n", a, b) for a, b in ((d_x, d_x), (d_x, d_y), (d_y, d_y)))
        L, M, N = (np.einsum("nk,nk->n", self.derivative(u, order), normal) for order in ((2, 0), (1, 1), (0, 2)))
        area = E * G - F * F
        mean = (E * N - 2 * F * M + G * L) / (2 * area)
        spread = np.sqrt(np.maximum(mean**2 - (L * N - M * M) / area, 0.0))
        return Curvature(mean - spread, mean + spread)

    def bending_energy(self) -> float:
        """Integral of |d^2 Psi / du^2|^2 over the domain in mm^2 / px^2, the regulariser of paper Eq. (6)."""
        coefficients = self.grid.flatten(self.control_points_mm)
        return float(np.sum(coefficients * (self.grid.bending @ coefficients)))

    def covariance(self, u: ArrayLike) -> np.ndarray:
        """Covariance (n, 3, 3) mm^2 of Psi(u) from the scatter of the fitted points; see `SurfaceFit.covariance`.

        Raises
        ------
        ValueError
            For a surface that was not fitted.
        """
        if self.fit is None:
            raise ValueError("covariance: this surface was not fitted to points, so its uncertainty is not known.")
        return self.fit.covariance(self.grid, points(u, 2, "u"))

    def distance(self, x_mm: ArrayLike, camera: AffineCamera, *, iterations: int = 20) -> ToolDistance:
        """Distance of points, such as tool tips, to the surface along the view and along the surface's normal.

        Parameters
        ----------
        x_mm:
            (n, 3) in the frame of the surface; NaN rows stay NaN.
        camera:
            The left camera, whose image parametrises the surface.
        iterations:
            Gauss-Newton steps towards the nearest point; each stays inside the domain.
        """
        x = points(x_mm, 3, "x_mm")
        start = camera.project(x)
        along_view = (self(start) - x) @ camera.viewing_direction
        low, high = np.reshape(self.grid.domain, (2, 2))
        u = np.clip(start, low, high)
        seen = np.isfinite(u).all(axis=1)
        for _ in range(iterations):
            jacobian = np.stack([self.derivative(u[seen], (1, 0)), self.derivative(u[seen], (0, 1))], axis=2)
            gap = x[seen] - self(u[seen])
            normal = np.einsum("nki,nkj->nij", jacobian, jacobian)
            # Second-order term of the distance: keeps steps right where the tool is far above a curved surface.
            second = [[self.derivative(u[seen], (2 - i - j, i + j)) for j in (0, 1)] for i in (0, 1)]
            hessian = normal - np.einsum("ijnk,nk->nij", np.array(second), gap)
            convex = (np.linalg.det(hessian) > 0) & (hessian[:, 0, 0] > 0)
            hessian[~convex] = normal[~convex]
            step = np.linalg.solve(hessian, np.einsum("nki,nk->ni", jacobian, gap)[..., None])[..., 0]
            u[seen] = np.clip(u[seen] + step, low, high)
            if not step.size or np.abs(step).max() < 1e-9:
                break
        nearest = self(u)
        # At the domain's border the nearest point may lie beyond it: then there is none to name.
        beyond = ~np.isfinite(along_view)
        nearest[beyond], u[beyond] = np.nan, np.nan
        along_normal = np.full(len(x), np.nan)
        ok = ~beyond
        along_normal[ok] = np.einsum("nk,nk->n", x[ok] - nearest[ok], self.normal(u[ok]))
        return ToolDistance(along_view, along_normal, nearest, u)

    def transformed(self, target_from_source) -> BSplineSurface:
        """The surface in another frame: a rigid motion of the control points is a rigid motion of the surface.

        The fit's report stays with the original.
        """
        moved = target_from_source.apply(self.control_points_mm.reshape(-1, 3)).reshape(self.control_points_mm.shape)
        return replace(self, control_points_mm=moved, fit=None)

    # Shorthands for what callers ask most.

    @property
    def objective(self) -> float:
        """Eq. (6) at this surface over the final inliers, in mm and px (NaN for a surface that was not fitted)."""
        return self.fit.objective if self.fit else float("nan")

    @property
    def inliers(self) -> np.ndarray | None:
        """Which of the given points (n,) the final fit used."""
        return self.fit.inliers if self.fit else None
