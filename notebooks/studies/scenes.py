"""Scenes for studies: a checkerboard in any pose, and everyday objects of about 1 cm."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy import ndimage

from lib.geometry import RigidTransform
from lib.simulator.texture import GAMMA, smooth_noise


@dataclass(frozen=True)
class Checkerboard:
    """A planar board of `columns` x `rows` squares, black at its first corner, on a matt white plate.

    Attributes
    ----------
    microscope_from_board:
        Pose; the board's origin is its middle, x along the columns, z into the plate.
    """

    microscope_from_board: RigidTransform = RigidTransform.identity()  # noqa: RUF009 - immutable
    columns: int = 14
    rows: int = 10
    square_mm: float = 0.5
    gloss: float = 0.0
    step_px: int = 8

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 2 or not self.square_mm > 0:
            raise ValueError(
                f"columns, rows, square_mm: at least 2 x 2 squares of positive size, got {self.columns} x {self.rows}, "
                f"{self.square_mm}."
            )
        if abs(self.microscope_from_board.R[2, 2]) < 0.3:
            raise ValueError("microscope_from_board: the board is seen from its edge; tilt it by less than 70 degrees.")

    @property
    def corners_mm(self) -> np.ndarray:
        """Inner corners ((rows - 1) * (columns - 1), 3) in the microscope frame, row by row."""
        x = (np.arange(1, self.columns) - self.columns / 2) * self.square_mm
        y = (np.arange(1, self.rows) - self.rows / 2) * self.square_mm
        grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        return self.microscope_from_board.apply(np.column_stack([grid, np.zeros(len(grid))]))

    @property
    def extent_mm(self) -> float:
        """Side of the textured square."""
        return (max(self.columns, self.rows) + 3) * self.square_mm

    @property
    def texture_from_surface(self) -> np.ndarray:
        """(2, 3): board coordinates (mm) of the surface point over (x, y)."""
        R, t = self.microscope_from_board.R, self.microscope_from_board.t
        inverse = np.linalg.inv(R[:2, :2])
        return np.column_stack([inverse, -inverse @ t[:2]])

    @cached_property
    def texture(self) -> np.ndarray:
        """(n, n, 3) uint8, white outside the squares."""
        square = 64
        n = (max(self.columns, self.rows) + 3) * square
        texture = np.full((n, n), 195, np.uint8)
        x0, y0 = (n - self.columns * square) // 2, (n - self.rows * square) // 2
        parity = np.add.outer(np.arange(self.rows), np.arange(self.columns)) % 2
        squares = np.where(parity, 195, 28).astype(np.uint8)
        texture[y0 : y0 + self.rows * square, x0 : x0 + self.columns * square] = np.kron(
            squares, np.ones((square, square), np.uint8)
        )
        # Soften the edges by a texel, so that sampling at about one texel per pixel keeps them in place.
        return np.repeat(cv2.GaussianBlur(texture, (0, 0), 0.7)[..., None], 3, axis=2)

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """z of the plane at (x, y)."""
        normal, t = self.microscope_from_board.R[:, 2], self.microscope_from_board.t
        return t[2] - (normal[0] * (x - t[0]) + normal[1] * (y - t[1])) / normal[2]


def checkerboard_poses(
    n: int,
    rng: np.random.Generator,
    *,
    max_tilt_rad: float = 0.35,
    half_size_mm: tuple[float, float, float] = (3.5, 1.8, 1.0),
) -> list[RigidTransform]:
    """`n` poses of a board within the field and depth of field."""
    poses = []
    for _ in range(n):
        spin = RigidTransform.from_rotation_vector((0, 0, rng.uniform(-np.pi, np.pi)))
        axis = rng.uniform(-np.pi, np.pi)
        tilt = rng.uniform(0, max_tilt_rad) * np.array([np.cos(axis), np.sin(axis), 0])
        poses.append(RigidTransform.from_rotation_vector(tilt, rng.uniform(-1, 1, 3) * half_size_mm).compose(spin))
    return poses


def _encode(linear: np.ndarray) -> np.ndarray:
    return np.round(255 * np.clip(linear, 0, 1) ** (1 / GAMMA)).astype(np.uint8)


@dataclass(frozen=True)
class Relief:
    """An everyday object of about 1 cm on a table, as a smooth height field: one of `OBJECTS`.

    Attributes
    ----------
    table_z_mm:
        z of the table; the object rises from it towards the microscope.
    """

    name: str = "leaf"
    seed: int = 0
    table_z_mm: float = 0.7
    gloss: float = 0.15
    extent_mm: float = 26.0
    step_px: int = 2

    def __post_init__(self) -> None:
        if self.name not in OBJECTS:
            raise ValueError(f"name: unknown object {self.name!r}; one of {', '.join(OBJECTS)}.")

    @cached_property
    def _made(self) -> tuple[np.ndarray, np.ndarray]:
        n = 1300
        axis = (np.arange(n) + 0.5) * (self.extent_mm / n) - self.extent_mm / 2
        x, y = np.meshgrid(axis, axis)
        rng = np.random.default_rng([self.seed, 43])
        rise, colour = OBJECTS[self.name](x, y, rng)
        rise = cv2.GaussianBlur(rise, (0, 0), 0.07 * n / self.extent_mm)
        grain = np.exp(0.16 * smooth_noise(rng, n, 160, 3, 0.8))[..., None]
        return ndimage.spline_filter(-rise, order=3, mode="nearest"), _encode(colour * grain)

    @property
    def texture(self) -> np.ndarray:
        """(n, n, 3) uint8."""
        return self._made[1]

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """z at (x, y)."""
        coefficients = self._made[0]
        scale = len(coefficients) / self.extent_mm
        place = np.stack([(y + self.extent_mm / 2) * scale - 0.5, (x + self.extent_mm / 2) * scale - 0.5])
        return self.table_z_mm + ndimage.map_coordinates(coefficients, place, order=3, mode="nearest", prefilter=False)


def _step(value: np.ndarray, width: float = 0.05) -> np.ndarray:
    """0 below, 1 above zero, softened over `width` mm."""
    return 1 / (1 + np.exp(-np.clip(value / width, -50, 50)))


def _mix(share: np.ndarray, inside: tuple, outside: tuple) -> np.ndarray:
    return np.array(outside) + share[..., None] * (np.array(inside) - np.array(outside))


def _screw(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    core = np.sqrt(np.maximum(0.75**2 - y**2, 0))
    thread = 0.16 * np.cos(2 * np.pi * (x + 0.12 * y) / 0.7) * (np.abs(y) < 0.8)
    along = _step(x + 4.2) * _step(3.0 - x)
    head = np.sqrt(np.maximum(1.5**2 - y**2, 0)) * _step(x - 3.0) * _step(4.6 - x)
    rise = np.maximum(along * np.where(core > 0, 0.75 + core + thread, 0), head + 0.3 * (head > 0.02)) * 0.85
    share = _step(rise - 0.15)
    return rise, _mix(share, (0.42, 0.40, 0.36), (0.30, 0.22, 0.15))


def _leaf(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    half_width = 2.9 * np.sqrt(np.clip(1 - (x / 5.6) ** 2, 0, 1)) * (1 + 0.12 * x / 5.6)
    share = _step(half_width - np.abs(y), 0.04) * _step(5.5 - np.abs(x), 0.04)
    middle = np.exp(-((y / 0.09) ** 2))
    side = np.exp(-((((np.abs(y) * 0.8 - x) / 1.1 + 100) % 1 - 0.5) ** 2) / 0.004)
    veins = np.clip(middle + 0.55 * side, 0, 1)
    rise = share * (0.35 + 0.5 * np.cos(x / 3.2) * np.cos(y / 2.6) + 0.12 * np.sin(1.4 * x + y) + 0.07 * veins)
    green = _mix(veins, (0.36, 0.46, 0.16), (0.10, 0.28, 0.06))
    return rise, green * share[..., None] + (1 - share[..., None]) * np.array([0.62, 0.60, 0.56])


def _coin(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    rho, n = np.hypot(x, y), len(x)
    share = _step(4.5 - rho)
    rim = np.exp(-(((rho - 4.15) / 0.2) ** 2))
    stamp = np.zeros((n, n), np.uint8)
    per_mm = n / 26.0
    cv2.putText(stamp, "5", (round(n / 2 - 1.3 * per_mm), round(n / 2 + 1.5 * per_mm)), 3, 6.4 * per_mm / 50, 255, 18)
    for angle in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        centre = (round(n / 2 + 3.4 * per_mm * np.cos(angle)), round(n / 2 + 3.4 * per_mm * np.sin(angle)))
        cv2.circle(stamp, centre, round(0.22 * per_mm), 255, -1)
    emboss = cv2.GaussianBlur(stamp, (0, 0), 3).astype(float) / 255
    rise = share * (0.8 + 0.16 * rim + 0.22 * emboss)
    return rise, _mix(share, (0.55, 0.40, 0.18), (0.18, 0.17, 0.20)) * (1 - 0.35 * emboss[..., None] * share[..., None])


def _pebble(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    bumps = smooth_noise(rng, len(x), 12, 2)
    rho2 = (x / 4.6) ** 2 + (y / 3.4) ** 2 + 0.04 * bumps
    rise = 1.7 * np.sqrt(np.maximum(1 - rho2, 0)) + 0.05 * bumps * (rho2 < 1)
    bands = 0.5 + 0.5 * np.sin(3 * y + 1.5 * x + smooth_noise(rng, len(x), 8, 3) * 1.2)
    stone = _mix(bands, (0.52, 0.46, 0.40), (0.26, 0.24, 0.24))
    share = _step(rise - 0.1)[..., None]
    return rise, stone * share + (1 - share) * np.array([0.50, 0.36, 0.22])


#: name -> function of (x, y, rng) giving the rise above the table (mm) and the linear colour.
OBJECTS = {"screw": _screw, "leaf": _leaf, "coin": _coin, "pebble": _pebble}
