"""A window of a camera's image: the rays of its pixels, their intersections with a smooth height field, and blur.

The intersections are found by a few fixed-point steps on a coarse grid of pixels, and interpolated for the others.
"""

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Self

import cv2
import numpy as np

from lib.cameras import AffineCamera, NearAffineCamera
from lib.simulator.eye import Scene

_Camera = AffineCamera | NearAffineCamera


@dataclass(frozen=True, eq=False)
class Window:
    """The part of a camera's image that is rendered; `camera` maps the microscope frame to the window's square pixels.

    `field_px` is the size (w, h) of the whole image (None = the window's), `origin_px` the window's first pixel in it.
    `R` is the rotation (3, 3) camera_from_microscope, whose third row is the viewing direction; `zoom` is px per mm.
    """

    camera: _Camera
    size_px: tuple[int, int]
    field_px: tuple[int, int] | None = None
    origin_px: tuple[float, float] = (0.0, 0.0)
    R: np.ndarray = field(init=False)
    zoom: float = field(init=False)

    def __post_init__(self) -> None:
        found = self.camera.resect()
        for name, value in (("field_px", self.field_px or self.size_px), ("R", found.R), ("zoom", float(found.K[1, 1]))):
            object.__setattr__(self, name, value)
        if not np.allclose(found.K, self.zoom * np.eye(2), atol=1e-6 * self.zoom):
            raise ValueError("camera: the renderer needs square pixels without skew.")

    @classmethod
    def around(
        cls, camera: _Camera, u: np.ndarray, size_px: tuple[int, int], field_px: tuple[int, int] | None = None
    ) -> Self:
        """Make the window of `size_px` around pixel `u` (2,) of a camera whose whole image has the size `field_px`."""
        origin = np.round(np.asarray(u) - np.array(size_px) / 2)
        moved = {"matrix": camera.matrix - [[0, 0, 0, origin[0]], [0, 0, 0, origin[1]]]}
        if isinstance(camera, NearAffineCamera):
            moved["centre_px"] = camera.centre_px - origin
        return cls(replace(camera, **moved), size_px, field_px, tuple(origin))

    def seen(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Transform points (n, 3) mm to the camera frame; also returns the perspective scale (n,) of lengths there.

        In the camera frame pixel = zoom * (x, y), and z is the depth along the viewing direction.
        """
        homogeneous = np.column_stack([x, np.ones(len(x))]) @ self.camera.projection_matrix.T
        shrink = 1 / homogeneous[:, 2]
        return np.column_stack([homogeneous[:, :2] * (shrink / self.zoom)[:, None], x @ self.R[2]]), shrink

    def rays(self, u: tuple[np.ndarray, np.ndarray], z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(x, y) mm where the rays of pixels u reach z of the microscope frame; all arrays have one shape."""
        *rows, last = self.camera.projection_matrix
        # (row - u * last) @ [x, y, z, 1] = 0.  Zeros in the last row are skipped: an affine camera has three.
        equations = ([m - u[k] * n if n else m for m, n in zip(row, last, strict=True)] for k, row in enumerate(rows))
        (a, b, c, s), (d, e, f, t) = equations
        right, determinant = (-s - c * z, -t - f * z), a * e - b * d
        return (e * right[0] - b * right[1]) / determinant, (a * right[1] - d * right[0]) / determinant


def intersect(scene: Scene, window: Window, u: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, ...]:
    """Points (x, y, z) mm of the scene at pixels u = (columns, rows).  On an eye each step divides the error by about 30."""
    z = np.zeros_like(u[0])
    for _ in range(40):
        before, z = z, scene.height(*window.rays(u, z))
        if np.abs(z - before).max() < 1e-6:
            break
    return *window.rays(u, z), z


@lru_cache(maxsize=8)
def _interpolation(size: int, step: int) -> np.ndarray:
    """Weights (size, n) of cubic interpolation from four neighbours on the coarse grid -step, 0, step, ..."""
    n = size // step + 4
    position = np.arange(size) / step + 1
    first = np.clip(np.floor(position).astype(int) - 1, 0, n - 4)
    t = position - first  # in 1..2
    weights = np.zeros((size, n))
    for j in range(4):
        weights[np.arange(size), first + j] = np.prod([(t - k) / (j - k) for k in range(4) if k != j], axis=0)
    return weights.astype(np.float32)


class Grid:
    """A coarse grid of an image: `u` are the pixels of its nodes, `full` interpolates to full resolution."""

    def __init__(self, size_px: tuple[int, int], step: int) -> None:
        self.columns, self.rows = (_interpolation(side, step) for side in size_px)
        self.u = np.meshgrid(*((np.arange(weights.shape[1]) - 1.0) * step for weights in (self.columns, self.rows)))

    def full(self, values: np.ndarray) -> np.ndarray:
        """Interpolate values on the coarse grid to (h, w) float32; rounding errors are 1e-6 for values of order one."""
        offset = float(values.mean())
        return self.rows @ ((values - offset).astype(np.float32) @ self.columns.T) + np.float32(offset)


def surface_grid(
    scene: Scene, camera: _Camera, size_px: tuple[int, int], step_px: int = 8
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The true surface: columns (a,) px, rows (b,) px, and the points (b, a, 3) mm there, in the microscope frame.

    For eyes, at the default step, linear interpolation between the points is exact to 1 um.
    """
    x_px, y_px = (np.append(np.arange(0, side - 1, step_px), side - 1).astype(float) for side in size_px)
    return x_px, y_px, np.stack(intersect(scene, Window(camera, size_px), tuple(np.meshgrid(x_px, y_px))), axis=-1)


def blur(image: np.ndarray, sigma_px: float) -> np.ndarray:
    """Gaussian blur; a width too small to see leaves the image unchanged."""
    return cv2.GaussianBlur(image, (0, 0), sigma_px) if sigma_px > 0.15 else image


def blur_by_depth(image: np.ndarray, sigma_px: np.ndarray, grid: Grid | None = None) -> np.ndarray:
    """Gaussian blur of slowly varying width, given on `grid` or for every pixel: blends up to three blurs, by variance."""
    low, high = float(sigma_px.min()), float(sigma_px.max())
    if high - low < 0.15:
        return blur(image, (low + high) / 2)
    levels = np.linspace(low, high, 3 if high - low > 0.8 else 2)
    result = blur(image, low)
    for k in range(1, len(levels)):
        share = (sigma_px**2 - levels[k - 1] ** 2) / (levels[k] ** 2 - levels[k - 1] ** 2)
        share = np.clip(grid.full(share) if grid else share, 0, 1).astype(np.float32)[..., None]
        result = result + share * (blur(image, levels[k]) - result)
    return result


def motion_blur(image: np.ndarray, shift_px: np.ndarray) -> np.ndarray:
    """Centred blur along the motion (2,) px during the exposure; one too short to see leaves the image unchanged."""
    if (length := float(np.hypot(*shift_px))) < 0.3:
        return image
    half = int(np.ceil(length / 2)) + 1
    t = np.linspace(-0.5, 0.5, 4 * half + 1)[:, None]
    # At each t the kernel is a point at t * shift_px, shared between its four pixels in proportion (bilinear).
    x, y = (np.clip(1 - np.abs(np.arange(-half, half + 1) - t * along), 0, 1) for along in shift_px)
    return cv2.filter2D(image, -1, np.float32(y.T @ x / len(t)))
