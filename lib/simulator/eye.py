"""Scenes: a smooth height field z(x, y) in the microscope frame with a texture on it.  The eye is the main one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np

from lib.simulator.texture import EXTENT_MM, fundus_texture, photograph_texture

__all__ = ["Eye", "Scene"]


class Scene(Protocol):
    """What the renderer needs of a surface.  Lengths are mm in the microscope frame (z into the eye).

    `height(x, y)` is the surface z, `texture` its reflectance (n, n, 3) uint8 over a square of side `extent_mm`
    round the origin, `gloss` the strength of the wet film's mirror image, 0 for a matt surface.  Optional:
    `texture_from_surface` (2, 3), where on the texture (x, y) lies, and `step_px`, the grid on which the
    surface is solved for (8; a rough surface needs less).
    """

    gloss: float

    @property
    def texture(self) -> np.ndarray: ...

    @property
    def extent_mm(self) -> float: ...

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True)
class Eye:
    """An open-sky eye: a soft bowl with folds and tilt, the cut rim at the border of the field.

    Attributes
    ----------
    seed:
        Draws folds, tilt and the procedural texture.
    radius_mm:
        Of the cut rim.
    depth_mm:
        From the rim down to the deepest point.
    fold_mm:
        Amplitude of the folds of the collapsed retina.
    tilt_rad:
        Standard deviation of the tilt about x and y.
    centre_z_mm:
        Height of the deepest point; 0 is the focal plane, positive is deeper.
    texture_path:
        A photograph to put on the retina in place of the procedural fundus.
    gloss:
        Strength of the reflection of the wet surface, 0 to switch it off.
    turn_rad:
        Turns the texture on the surface: more eyes from one texture.
    """

    seed: int = 0
    radius_mm: float = 9.3
    depth_mm: float = 2.2
    fold_mm: float = 0.10
    tilt_rad: float = 0.04
    centre_z_mm: float = 1.1
    texture_path: str | Path | None = None
    texture_px: int = 2048
    gloss: float = 1.0
    turn_rad: float = 0.0

    def __post_init__(self) -> None:
        if not self.radius_mm > 0:
            raise ValueError(f"radius_mm: the eye's radius must be positive, got {self.radius_mm}.")
        if not 0 <= self.depth_mm < self.radius_mm:
            raise ValueError(f"depth_mm: must lie between 0 and the radius {self.radius_mm}, got {self.depth_mm}.")
        if not 0 <= self.fold_mm <= 0.5:
            raise ValueError(f"fold_mm: must lie between 0 and 0.5 so that no fold hides another, got {self.fold_mm}.")
        if not 0 <= self.tilt_rad <= 0.3:
            raise ValueError(f"tilt_rad: must lie between 0 and 0.3, got {self.tilt_rad}.")
        if self.gloss < 0:
            raise ValueError(f"gloss: must not be negative, got {self.gloss}.")
        if self.texture_px < 64:
            raise ValueError(f"texture_px: must be at least 64, got {self.texture_px}.")

    @property
    def extent_mm(self) -> float:
        """Side of the textured square."""
        return EXTENT_MM

    @property
    def texture_from_surface(self) -> np.ndarray:
        """(2, 3): texture coordinates (mm from its middle) of the surface point over (x, y)."""
        cosine, sine = np.cos(self.turn_rad), np.sin(self.turn_rad)
        return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0]])

    @property
    def texture(self) -> np.ndarray:
        """Reflectance (n, n, 3) uint8 RGB."""
        if self.texture_path is not None:
            return photograph_texture(self.texture_path, self.texture_px)
        return fundus_texture(self.seed, self.texture_px, self.radius_mm)

    @cached_property
    def _shape(self) -> tuple[np.ndarray, np.ndarray]:
        """Tilt (2,) and folds (k, 4): wave vector x, y in 1/mm, phase, amplitude mm."""
        rng = np.random.default_rng([self.seed, 11])
        tilt = rng.normal(0, self.tilt_rad, 2).clip(-2.5 * self.tilt_rad, 2.5 * self.tilt_rad)
        wavelength = rng.uniform(3.5, 9.0, 7)
        direction, phase = rng.uniform(0, 2 * np.pi, (2, 7))
        amplitude = self.fold_mm * rng.uniform(0.3, 1.0, 7) * (wavelength / 9.0)
        wave = 2 * np.pi / wavelength
        return tilt, np.column_stack([wave * np.cos(direction), wave * np.sin(direction), phase, amplitude])

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Surface z in mm at (x, y) in mm, any shape."""
        tilt, folds = self._shape
        t = (x * x + y * y) / self.radius_mm**2
        # Parabola inside the rim, level outside it.
        z = self.centre_z_mm - self.depth_mm * t / np.cbrt(1 + (t / 1.25) ** 3) + tilt[0] * x + tilt[1] * y
        for wave_x, wave_y, phase, amplitude in folds:
            z = z + amplitude * (np.sin(wave_x * x + wave_y * y + phase) - np.sin(phase))
        return z
