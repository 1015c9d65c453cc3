"""Uniform bicubic B-splines over an image: basis, control grid, exact bending energy.

The domain (x0, y0, x1, y1) px has (n_x - 3) x (n_y - 3) cells; ``control = (n_x, n_y)`` points cover it and a cell around it.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse


def cubic_basis(t: np.ndarray, derivative: int = 0) -> np.ndarray:
    """Values (..., 4) at t in [0, 1] of the four uniform cubic B-splines that are not zero on a span, or of a derivative."""
    s = 1.0 - t
    if derivative == 0:
        return np.stack([s**3, (3 * t - 6) * t**2 + 4, (3 * s - 6) * s**2 + 4, t**3], axis=-1) / 6
    if derivative == 1:
        return np.stack([-(s**2), (3 * t - 4) * t, (4 - 3 * s) * s, t**2], axis=-1) / 2
    if derivative == 2:
        return np.stack([s, 3 * t - 2, 3 * s - 2, t], axis=-1)
    raise ValueError(f"derivative: 0, 1 or 2, got {derivative}.")


def _gram(n: int, derivative: int) -> sparse.csr_matrix:
    """Integrals (n, n) over the domain of products of the n basis functions' derivatives, for spans of width 1."""
    cell = np.arange(n - 3)[:, None, None]
    row, column = np.broadcast_arrays(cell + np.arange(4)[:, None], cell + np.arange(4))
    t, weight = np.polynomial.legendre.leggauss(4)  # exact for products of two cubics
    basis = cubic_basis((t + 1) / 2, derivative)
    values = np.broadcast_to(basis.T * (weight / 2) @ basis, row.shape)
    return sparse.csr_matrix((values.ravel(), (row.ravel(), column.ravel())), shape=(n, n))


@dataclass(frozen=True)
class SplineGrid:
    """The grid of control points of a bicubic spline.

    `domain` is (x0, y0, x1, y1) px, `control` (n_x, n_y), each at least 4.  Coefficients are flat (n_x n_y,).  The index
    along the shorter side varies fastest, which gives the matrices of the fit the smallest bandwidth.
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
        """Number of cells along x and y, (n_x - 3, n_y - 3)."""
        return self.control[0] - 3, self.control[1] - 3

    @property
    def cell_px(self) -> np.ndarray:
        """Width and height (2,) of a cell."""
        return np.subtract(self.domain[2:], self.domain[:2]) / self.cells

    @property
    def stride(self) -> tuple[int, int]:
        """Steps of the flat index from a control point to the next one on the right, and to the next one below."""
        n_x, n_y = self.control
        return (1, n_x) if n_x <= n_y else (n_y, 1)

    @property
    def bandwidth(self) -> int:
        """Number of non-zero diagonals below the main one in matrices of this grid."""
        return 3 * sum(self.stride)

    def inside(self, u: np.ndarray) -> np.ndarray:
        """(n,) bool: True for points (n, 2) in the domain or on its border, False for NaN."""
        return ((u >= self.domain[:2]) & (u <= self.domain[2:])).all(axis=1)

    def locate(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cell (n, 2) int of each point, and its position (n, 2) in that cell, in [0, 1] for points inside the domain."""
        position = (u - self.domain[:2]) / self.cell_px
        cell = np.clip(np.floor(position), 0, np.array(self.cells) - 1).astype(np.intp)
        return cell, position - cell

    def design(self, u: np.ndarray, derivative: tuple[int, int] = (0, 0)) -> sparse.csr_matrix:
        """B (n, size) with 16 entries a row: B @ coefficients is the spline, or its derivative per px, at u (n, 2)."""
        cell, t = self.locate(u)
        scale = self.cell_px ** -np.array(derivative, dtype=float)
        along_x, along_y = (cubic_basis(t[:, i], derivative[i]) * scale[i] for i in (0, 1))
        step_x, step_y = self.stride
        offset = np.arange(4, dtype=np.int32)[:, None] * step_y + np.arange(4, dtype=np.int32) * step_x
        columns = (cell @ self.stride).astype(np.int32)[:, None, None] + offset
        values = along_y[:, :, None] * along_x[:, None, :]
        indptr = np.arange(0, 16 * len(u) + 1, 16, dtype=np.int32)
        return sparse.csr_matrix((values.ravel(), columns.ravel(), indptr), shape=(len(u), self.size))

    @cached_property
    def bending(self) -> sparse.csr_matrix:
        """R (size, size): c.R.c is the exact integral over the domain of s_xx^2 + 2 s_xy^2 + s_yy^2, lengths in px.

        Its null space consists of the linear functions and has dimension 3.
        """
        along = zip(self.control, self.cell_px, strict=True)
        gram_x, gram_y = ([_gram(n, k) * h ** (1 - 2 * k) for k in range(3)] for n, h in along)
        slow, fast = (gram_y, gram_x) if self.stride[0] == 1 else (gram_x, gram_y)
        terms = ((1.0, 2, 0), (2.0, 1, 1), (1.0, 0, 2))
        bending = sum(factor * sparse.kron(slow[p], fast[q], format="csr") for factor, p, q in terms).tocsr()
        bending.eliminate_zeros()  # kron stores whole blocks
        return bending

    def flatten(self, control_points: np.ndarray) -> np.ndarray:
        """Coefficients (size, k) of control points (n_y, n_x, k)."""
        return (control_points if self.stride[0] == 1 else control_points.swapaxes(0, 1)).reshape(self.size, -1)

    def unflatten(self, coefficients: np.ndarray) -> np.ndarray:
        """Control points (n_y, n_x, k) of coefficients (size, k)."""
        n_x, n_y = self.control
        return coefficients.reshape(n_y, n_x, -1) if n_x <= n_y else coefficients.reshape(n_x, n_y, -1).swapaxes(0, 1)

    @property
    def sites(self) -> np.ndarray:
        """Image points (n_y, n_x, 2) of the control points: control points f(sites) reproduce a linear f exactly."""
        return self.domain[:2] + (np.stack(np.meshgrid(*map(np.arange, self.control)), axis=-1) - 1) * self.cell_px
